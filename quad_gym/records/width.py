"""Number of flights in a block, and of those that a kernel computes at once."""

import os

WIDTHS = (1, 2, 4, 8)  #: supported numbers of lanes; 1 is for filters on other processors
WARP = 32  #: number of flights in a block on a GPU, whose threads fly one each
RESIDENT = 8  #: blocks that a multiprocessor of a GPU flies at once, with 255 registers a thread
_NEEDED = {
    8: {"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"},
    4: {"avx2"},
}
"""Features of a processor of the x86 family with as many lanes in a register."""


def lanes_of_machine() -> int:
    """Return QUAD_GYM_LANES, or 8 lanes with AVX-512, 4 with AVX2, else 2."""
    wanted = os.environ.get("QUAD_GYM_LANES")
    if wanted:
        if wanted not in map(str, (*WIDTHS, WARP)):
            raise ValueError(f"QUAD_GYM_LANES must be 2, 4 or 8, got {wanted!r}")
        return int(wanted)
    features = _features()
    return next((lanes for lanes, needed in _NEEDED.items() if needed <= features), 2)


def runs_lanes(lanes: int) -> bool:
    """Return True if registers of this processor hold as many lanes."""
    return _NEEDED.get(lanes, set()) <= _features()


def _features() -> set[str]:
    """Return the features of the processor for which Numba compiles, in the names of LLVM.

    NumPy provides them, because importing Numba takes a second.
    """
    if os.environ.get("NUMBA_CPU_FEATURES"):
        names = os.environ["NUMBA_CPU_FEATURES"].split(",")
        return {name[1:] for name in names if name.startswith("+")}
    if os.environ.get("NUMBA_CPU_NAME"):  # code for another processor: baseline features only
        return set()
    try:
        from numpy._core._multiarray_umath import (  # type: ignore[import-not-found]
            __cpu_features__ as features,
        )
    except ImportError:
        from llvmlite.binding import get_host_cpu_features

        features = get_host_cpu_features()
    return {name.lower() for name, present in features.items() if present}


WIDTH = lanes_of_machine()
"""Number of flights in a block: as many as the float64 in a vector register of this machine, or
WARP. No result depends on it, not even in the last bit."""

REGISTER = 1 if WIDTH == WARP else WIDTH
"""Number of flights that a kernel computes at once."""
