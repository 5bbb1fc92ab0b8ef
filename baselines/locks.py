"""Lock on the folder of a run, so that only one process at a time trains in it.

The operating system releases the lock when the process ends for any reason. The lock also works
between machines on a shared file system that supports locks (NFS, and Lustre if it is mounted with
`flock`).
"""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from baselines.keeping import RunError

LOCK = "training.lock"
"""Name of the lock file in the folder."""

HOLDER = "training.process"
"""Name of the file with the process that has or had the lock."""

PATIENCE = 0.5
"""Time to wait for a lock [s]; checking for a lock takes it briefly."""


class BusyError(RunError):
    """Error raised when another process trains in the folder."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the existing folder of a run, or raise a `BusyError` if another process has the lock."""
    lock = FileLock(folder / LOCK, timeout=PATIENCE)
    try:
        lock.acquire()
    except Timeout:
        raise BusyError(f"folder {folder} is in use by {holder(folder)}") from None
    try:
        with suppress(OSError):  # a full disk
            (folder / HOLDER).write_text(f"process {os.getpid()} on {socket.gethostname()}\n")
        yield
    finally:
        lock.release()


def is_locked(folder: Path) -> bool:
    """True if a process trains in the folder now."""
    if not (folder / LOCK).exists():  # never begun
        return False
    try:
        with FileLock(folder / LOCK, timeout=0.0):
            return False
    except Timeout:
        return True


def holder(folder: Path) -> str:
    """Process that has the lock of a folder, or had it last."""
    try:
        return (folder / HOLDER).read_text(encoding="utf-8").strip() or "another process"
    except OSError:
        return "another process"
