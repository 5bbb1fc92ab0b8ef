"""Locks between processes: a file that one process at a time holds."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

try:
    import fcntl as _fcntl
except ImportError:  # not a POSIX system
    _fcntl = None  # type: ignore[assignment]
fcntl: Any = _fcntl


@contextlib.contextmanager
def locked(path: Path | None, waiting: str = "") -> Iterator[None]:
    """Hold a lock between processes; a process that dies releases it.

    Where the system or the folder supports no locks, two processes may do the same work.

    Args:
        path: The file that represents the lock; None: no lock.
        waiting: Message on standard error if another process holds it.
    """
    file = None if path is None or fcntl is None else _held(path, waiting)
    if file is None:
        yield
        return
    with file:
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                os.unlink(file.name)
            with contextlib.suppress(OSError):  # closing is not enough if a fork has the file, too
                fcntl.flock(file, fcntl.LOCK_UN)


def _held(path: Path, waiting: str) -> IO[bytes] | None:
    """The locked file; None if it cannot be locked."""
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = open(path, "ab")  # noqa: SIM115 - the caller closes it
        except OSError:
            return None
        try:
            _lock(file, waiting)
            if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                return file
        except FileNotFoundError:
            pass
        except OSError:  # some network file systems have no locks
            file.close()
            return None
        except BaseException:  # Ctrl-C while it waits
            file.close()
            raise
        file.close()  # its former holder has deleted it: others lock a new file


def _lock(file: IO[bytes], waiting: str) -> None:
    if waiting:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say(waiting)
        else:
            return
    fcntl.flock(file, fcntl.LOCK_EX)


def say(text: str, end: str = "\n") -> None:
    """Write a line to standard error, if there is one."""
    if sys.stderr is not None:
        print(text, file=sys.stderr, end=end, flush=True)
