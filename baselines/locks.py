"""Lock on the folder of a run, so that only one process at a time trains in it.

The operating system releases the lock when the process ends for any reason. The lock also works
between machines on a shared file system that supports locks (NFS, and Lustre if it is mounted with
`flock`).
"""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType

from baselines.keeping import RunError

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None

LOCK = "training.lock"
"""Name of the lock file in the folder; it contains the process that has or had the lock."""

PATIENCE = 0.5
"""Time to wait for a lock [s]; checking for a lock takes it briefly."""


class BusyError(RunError):
    """Error raised when another process trains in the folder."""


@contextmanager
def locked(folder: Path, patience: float = PATIENCE) -> Iterator[None]:
    """Lock the folder of a run.

    Args:
        folder: Existing folder of the run.
        patience: Time to wait for the lock [s].

    Raises:
        ValueError: If another process has the lock (`BusyError`).
        OSError: If the file system has no locks, or the folder is not writable.
    """
    file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if not _take(file, patience):
            raise BusyError(f"folder {folder} is in use by {holder(folder)}")
        with suppress(OSError):  # on a full disk the lock file stays empty
            os.ftruncate(file, 0)
            os.pwrite(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        yield
    finally:
        os.close(file)  # releases the lock


def is_locked(folder: Path) -> bool:
    """True if a process trains in the folder now."""
    try:
        file = os.open(folder / LOCK, os.O_RDWR)
    except OSError:  # never begun
        return False
    try:
        return not _take(file, 0.0)
    finally:
        os.close(file)


def holder(folder: Path) -> str:
    """Process that has the lock of a folder, or had it last."""
    try:
        return (folder / LOCK).read_text(encoding="utf-8").strip() or "another process"
    except OSError:
        return "another process"


def _take(file: int, patience: float) -> bool:
    if fcntl is None:
        return True
    end = time.monotonic() + patience
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end:
                return False
            time.sleep(0.02)
        else:
            return True
