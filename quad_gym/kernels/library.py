"""The library of compiled kernels for this machine, without Numba, and its cores.

`quad-gym compile --library` makes one for each number of lanes, which wheels hold. It belongs to
sources, whose digest it holds: with other sources it is not used. Without one, Numba compiles.
"""

import ctypes
import functools
import importlib.util
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from quad_gym.kernels.sources import digest_in, sources_digest
from quad_gym.records.sizes import SINGLE, WIDTH, require_double, runs_lanes

# --------------------------------------------------------------------------------------------------
# Number of cores that this process may use.
# --------------------------------------------------------------------------------------------------


def available_cores() -> int:
    """Number of cores that this process may use, by its affinity, quota and NUMBA_NUM_THREADS."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    quota = _cgroup_cores()
    if quota is not None:
        cores = min(cores, quota)
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    return max(1, min(cores, int(limit))) if limit.isdigit() and int(limit) > 0 else cores


def _cgroup_cores() -> int | None:
    """Number of whole cores that a container's quota allows, if there is one."""
    try:
        with open("/sys/fs/cgroup/cpu.max", encoding="ascii") as file:
            quota, period = file.read().split()
        return None if quota == "max" else max(1, int(quota) // int(period))
    except (OSError, ValueError):
        return None


# --------------------------------------------------------------------------------------------------
# The library of compiled kernels for this machine, without Numba.
# --------------------------------------------------------------------------------------------------

FOLDER = Path(__file__).with_name("libraries")
DEVICE_KERNEL = "qg_fly"  #: kernel of a module for a GPU: call (address), blocks, command
_CHOICES = ("", "library", "numba")


def machine() -> str:
    """Return the family of this machine's processor."""
    name = platform.machine().lower()
    return {"amd64": "x86_64", "arm64": "aarch64"}.get(name, name)


def file_of(lanes: int, family: str = "") -> Path:
    """Return the file of the library for this system, a family of processors and lanes."""
    return FOLDER / f"kernels_{sys.platform}_{family or machine()}_{lanes}.so"


def core_symbol(name: str) -> str:
    """Return the symbol of a compiled function, by its name "module:function"."""
    return f"qg_core_{name.partition(':')[2]}"


def entry_symbol(name: str) -> str:
    """Return the symbol through which Python calls an entry."""
    return f"qg_{name.partition(':')[2]}"


def say(text: str, end: str = "\n") -> None:
    """Write a line to standard error, if there is one."""
    if sys.stderr is not None:
        print(text, file=sys.stderr, end=end, flush=True)


class NoKernelsError(ImportError):
    """There is no library of compiled kernels for this machine, and no Numba."""


class Library:
    """A loaded library."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._loaded = ctypes.CDLL(str(file))  # which releases the GIL in calls

    def address_of(self, stage: str) -> int:
        """Return the address of a stage, by its name "module:function"."""
        address = ctypes.cast(self._loaded[core_symbol(stage)], ctypes.c_void_p).value
        assert address is not None
        return address

    def function_of(self, name: str, words: int, returns: type[float] | None) -> Callable[..., Any]:
        """Return an entry that takes integers: numbers, and for an array its address and shape.

        Args:
            name: "module:function".
            words: Number of its integers.
            returns: Type of its result.
        """
        function = self._loaded[entry_symbol(name)]
        function.argtypes = [ctypes.c_int64] * words
        function.restype = {None: None, bool: ctypes.c_bool, float: ctypes.c_double}[returns]
        return function


@functools.cache
def library() -> Library | None:
    """Return the library for this machine and these sources; None: Numba compiles.

    QUAD_GYM_KERNELS selects one of both, "library" or "numba".
    """
    choice = os.environ.get("QUAD_GYM_KERNELS", "")
    if choice not in _CHOICES:
        raise ValueError(f"QUAD_GYM_KERNELS must be library or numba, got {choice!r}")
    if choice == "numba":
        return None
    if SINGLE and choice == "library":
        require_double("the library of compiled kernels")
    if SINGLE and importlib.util.find_spec("numba") is None:
        raise NoKernelsError(
            "Numba compiles the kernels in single precision, and it is not installed: "
            'pip install "quad-gym[compile]"'
        )
    if SINGLE:
        return None
    file = file_of(WIDTH)
    found = _load(file)
    if isinstance(found, Library):
        return found
    if choice == "library":
        raise NoKernelsError(f"the library of compiled kernels cannot be used: {found}")
    if importlib.util.find_spec("numba") is None:
        raise NoKernelsError(
            "quad_gym has no compiled kernels for this machine, and Numba, which would compile "
            f'them, is not installed ({found}): pip install "quad-gym[compile]"'
        )
    if file.is_file():
        say(f"quad_gym: Numba compiles, as {found}")
    return None


def _load(file: Path) -> Library | str:
    """Return a library, or why it cannot be used."""
    if not file.is_file():
        return f"there is no {file.name}"
    if not runs_lanes(WIDTH):
        return f"this processor does not run {file.name}"
    if digest_in(file.read_bytes()) != sources_digest(Path(__file__).parents[1]):
        return f"{file.name} belongs to other sources; `quad-gym compile --library` renews it"
    try:
        return Library(file)
    except OSError as error:  # such as a folder from which no code may be executed
        return f"{file.name} cannot be loaded: {error}"
