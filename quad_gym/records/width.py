"""How many flights fly side by side: as many float64 as a vector register of this machine holds."""

import os

WIDTHS = (2, 4, 8)
"""Numbers of lanes that there can be."""


def lanes_of_machine() -> int:
    """Lanes: 8 with AVX-512, 4 with AVX2, else 2; QUAD_GYM_LANES overrides it.

    Raises:
        ValueError: If QUAD_GYM_LANES is not one of WIDTHS.
    """
    wanted = os.environ.get("QUAD_GYM_LANES")
    if wanted:
        if wanted not in map(str, WIDTHS):
            raise ValueError(f"QUAD_GYM_LANES must be 2, 4 or 8, got {wanted!r}")
        return int(wanted)
    features = _features()
    if "avx512f" in features:
        return 8
    return 4 if "avx2" in features else 2


def _features() -> set[str]:
    """The processor's features for which Numba compiles, as LLVM calls them.

    As NumPy knows them: importing Numba for this takes a second.
    """
    if os.environ.get("NUMBA_CPU_FEATURES"):
        names = os.environ["NUMBA_CPU_FEATURES"].split(",")
        return {name[1:] for name in names if name.startswith("+")}
    if os.environ.get("NUMBA_CPU_NAME"):  # compiled for another one: only what all of its kind have
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
"""Flights in a block. What a flight does depends on it in no bit."""
