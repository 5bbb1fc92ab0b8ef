"""A lock on the folder of a run, so that no two processes ever train in it.

The system releases the lock when its process ends, however it ends. On a file system that several
machines share, the lock holds between them, too, if the file system supports locks (NFS does, and
Lustre if it is mounted with `flock`).
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
"""In the folder; it names the process that has or had it."""

PATIENCE = 0.5
"""How long to try [s]: who only asks whether a folder is locked holds the lock for a moment."""


class BusyError(RunError):
    """Another process trains in the folder."""


@contextmanager
def locked(folder: Path, patience: float = PATIENCE) -> Iterator[None]:
    """Be the only one who trains in a folder.

    Args:
        folder: Of the run; it is there.
        patience: How long to try [s].

    Raises:
        ValueError: If another process has the lock (BusyError).
        OSError: If the file system has no locks, or nothing can be written to the folder.
    """
    file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if not _take(file, patience):
            raise BusyError(f"folder {folder} is in use by {holder(folder)}")
        with suppress(OSError):  # a full disk: the lock holds without words
            os.ftruncate(file, 0)
            os.pwrite(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        yield
    finally:
        os.close(file)  # which gives the lock back


def is_locked(folder: Path) -> bool:
    """Whether a process trains in a folder now."""
    try:
        file = os.open(folder / LOCK, os.O_RDWR)
    except OSError:  # never begun
        return False
    try:
        return not _take(file, 0.0)
    finally:
        os.close(file)


def holder(folder: Path) -> str:
    """The process that has the lock of a folder, or had it last."""
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
