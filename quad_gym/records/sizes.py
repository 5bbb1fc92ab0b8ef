"""Description of a field of a record, sizes of the contents of records, and lanes per block."""

import os
from typing import NamedTuple

from quad_gym.records.enums import (
    AID_TRIPLES,
    ALLOWED_BLOCKS,
    DIRECTIONS,
    GROUP_COUNT,
    GROUP_FREEDOMS,
    LENGTHS,
    MOST_BLOCKS,
    OWN_ERRORS,
    READINGS,
    ROOM,
    Aid,
    FaultKind,
    Sensor,
)

# --------------------------------------------------------------------------------------------------
# Precision of the numbers of flights, the number of flights in a block, and of those that a kernel
# computes at once.
# --------------------------------------------------------------------------------------------------

PRECISIONS = ("double", "single")


def precision_of_process() -> str:
    """Return QUAD_GYM_PRECISION, or "double"."""
    wanted = os.environ.get("QUAD_GYM_PRECISION") or "double"
    if wanted not in PRECISIONS:
        raise ValueError(f"QUAD_GYM_PRECISION must be double or single, got {wanted!r}")
    return wanted


PRECISION = precision_of_process()
"""Precision of the numbers in blocks of flights, and of all that kernels compute with lanes."""

SINGLE = PRECISION == "single"  #: the numbers of flights are float32, in place of float64
REAL = "f4" if SINGLE else "f8"  #: kind of these numbers
REAL_BYTES = 4 if SINGLE else 8


def require_double(what: str) -> None:
    """Refuse a call that does not work in single precision.

    Raises:
        ValueError: If the process computes in single precision.
    """
    if SINGLE:
        raise ValueError(f"{what} needs double precision, got QUAD_GYM_PRECISION=single")


WIDTHS = (1, 2, 4, 8)  #: supported numbers of lanes; 1 is for filters on other processors
SINGLE_WIDTHS = (1, 2, 4, 8, 16)  #: the same in single precision
WARP = 32  #: number of flights in a block on a GPU, whose threads fly one each
ALIGNED = 4 * WARP
"""Bytes of which the addresses of records are multiples: two cache lines, and a number of all flights
of a block on a GPU in single precision (`kernels/numbers/blocks.py`)."""
RESIDENT = 8  #: blocks that a multiprocessor of a GPU flies at once, with 255 registers a thread
_NEEDED = {
    64: {"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"},
    32: {"avx2"},
}
"""Features of a processor of the x86 family with as many bytes in a register."""


def lanes_of_machine() -> int:
    """Return QUAD_GYM_LANES, or as many as fill a register: in double precision 8, 4 or 2.

    Registers have 64 bytes with AVX-512, 32 with AVX2, else 16.
    """
    wanted = os.environ.get("QUAD_GYM_LANES")
    if wanted:
        if wanted not in map(str, (*(SINGLE_WIDTHS if SINGLE else WIDTHS), WARP)):
            known = "2, 4, 8 or 16 in single precision" if SINGLE else "2, 4 or 8"
            raise ValueError(f"QUAD_GYM_LANES must be {known}, got {wanted!r}")
        return int(wanted)
    features = _features()
    return next((size for size, needed in _NEEDED.items() if needed <= features), 16) // REAL_BYTES


def runs_lanes(lanes: int) -> bool:
    """Return True if registers of this processor hold as many lanes."""
    return _NEEDED.get(lanes * REAL_BYTES, set()) <= _features()


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
"""Number of flights in a block: as many as the numbers in a vector register of this machine, or
WARP. No result depends on it, not even in the last bit."""

REGISTER = 1 if WIDTH == WARP else WIDTH
"""Number of flights that a kernel computes at once."""


# --------------------------------------------------------------------------------------------------
# Description of a field of a record, and sizes of the contents of records.
# --------------------------------------------------------------------------------------------------

# fmt: off
MAX_HARMONICS = 6  #: largest number of terms in the Fourier series of a reference
FOLLOWED = -1  #: number of terms that denotes a user's trajectory instead of a series
TERMS = 8  #: coefficients of a segment of a user's trajectory, a polynomial of degree 7
HEADING_TOWARD, HEADING_ALONG, HEADING_VELOCITY, HEADING_GIVEN = 0.0, 1.0, 2.0, 3.0
"""Rules of a reference's heading: toward a point, along a direction, along the velocity, by yaw."""
MAX_GATES = 8  #: largest number of gates on a course
MAX_START_VELOCITY, MAX_START_RATE = 1.5, 2.0  #: largest velocity and body rate of a moving start on each axis: [m/s], [rad/s]
MAX_OBSTACLES = 32  #: largest number of obstacles in a world
MAX_UNDER_WAY = 2  #: longest latency of a sensor in its periods, and so the most measurements in transit
DELAY_SLOTS = MAX_UNDER_WAY + 1
"""Slots for delayed measurements: at a latency of MAX_UNDER_WAY periods, one is taken at the
instant at which another arrives."""
MAX_ACTION_DELAY = 10  #: longest delay of an action, in control steps
SENSORS = len(Sensor)  #: number of sensors other than the IMU
KINDS = 1 << SENSORS  #: number of sets of sensors that can measure at an instant, the empty set included
AIDS = len(Aid)  #: number of sensors with parameters in the fields `aid_...`, which come last
FIRST_AID = SENSORS - AIDS  #: first sensor with parameters in the fields `aid_...`
SENSOR_GROUPS = len(READINGS)  #: number of groups of the gate: positions, baselines, velocities, images, other sensors
FIRST_GROUP = tuple(sum(GROUP_COUNT[:sensor]) for sensor in Sensor)  #: first group of each sensor
AID_GROUPS = FIRST_GROUP[FIRST_AID]  #: first group of the sensors with parameters in the fields `aid_...`
GROUP_BLOCK = tuple(sum(MOST_BLOCKS[:group]) for group in range(SENSOR_GROUPS))  #: first block of each group in a flight's fields of measurements and innovations
MAX_BLOCKS = sum(MOST_BLOCKS)  #: number of blocks: antenna position, baseline, velocity, features, other sensors
FIRST_BLOCK = tuple(GROUP_BLOCK[group] for group in FIRST_GROUP)  #: first block of each sensor
BLOCKS_OF = {name: slice(first, first + most) for name, first, most in zip(READINGS, GROUP_BLOCK, MOST_BLOCKS, strict=True)}
"""Blocks by the names of readings."""
POSITION_BLOCK, BASELINE_BLOCK, VELOCITY_BLOCK, FEATURE_BLOCKS = (
    BLOCKS_OF[name].start for name in ("gnss_position", "gnss_baseline", "gnss_velocity", "pixels"))
"""Blocks of GNSS, and the first of the camera; feature i is FEATURE_BLOCKS + i."""
FEATURE_SLICE = BLOCKS_OF["pixels"]  #: blocks of the features
MAX_FEATURES = FEATURE_SLICE.stop - FEATURE_SLICE.start  #: largest number of a camera's features
AID_BLOCK = FIRST_BLOCK[FIRST_AID:]  #: first block of each aiding sensor
AID_BLOCKS = AID_BLOCK[0]  #: first of their blocks
AID_NUMBERS = tuple(sum(AID_TRIPLES[:aid]) for aid in Aid)  #: first row of each aiding sensor in `aid_numbers`
ALLOWED_TOGETHER = max(
    sum(ALLOWED_BLOCKS[:AID_GROUPS]) + 4, FEATURE_BLOCKS + sum(ALLOWED_BLOCKS[AID_GROUPS:])
)
"""Largest number of blocks of an instant in a suite: all of GNSS and camera and four more, or all
of the other sensors and GNSS."""
MAX_TOGETHER = ROOM[-2] if ROOM else ALLOWED_TOGETHER  #: the same for which records have room
MAX_MEASUREMENTS = 3 * MAX_TOGETHER  #: largest length of the stacked measurement; a direction has three numbers
SEVERAL = tuple(group for group in range(SENSOR_GROUPS) if MOST_BLOCKS[group] > 1)
"""Groups of several blocks, which support each other: images, for example."""
WITH_OWN_ERROR = tuple(AID_GROUPS + aid for aid in Aid if OWN_ERRORS[aid])
"""Groups of sensors whose own error is among the states."""
_GROUP_OF = tuple(group for group in range(SENSOR_GROUPS) for _ in range(MOST_BLOCKS[group]))
FREEDOMS = tuple(GROUP_FREEDOMS[group] for group in _GROUP_OF)  #: degrees of freedom of the blocks: a direction has two
BLOCK_NUMBERS = tuple(3 if DIRECTIONS[group] else LENGTHS[group] for group in FIRST_GROUP)
"""Numbers of a block of each sensor in the stacked measurement: a direction is a unit vector."""
DIRECTION_BLOCKS = tuple((GROUP_BLOCK[g], GROUP_BLOCK[g] + MOST_BLOCKS[g]) for g in range(SENSOR_GROUPS) if DIRECTIONS[g])
"""First and end of each range of blocks that are directions."""
MAX_OBSERVATION = 512  #: largest length of an observation
WARM_DRAWS = 21  #: standard normals for the errors of a warm start: 15 for the states, 6 for the true biases
MAX_SLOW = ROOM[-1] if ROOM else 9
"""Largest number of slow sensor errors among a filter's states, a multiple of three: the drift of
GNSS positions, the hard iron of a magnetometer, and one number for each other sensor."""
MAX_STATES = 15 + MAX_SLOW  #: number of states of a filter with all slow errors
WARM_SLOW_DRAWS = 2 * MAX_SLOW
"""Further standard normals for the slow errors of a warm start: for every three
errors, three for the estimate, then three for the true values."""
STAMP = 31  #: length of a time stamp: the tick; C, V, X and B of the IMU's sums; body rates; sums in N
FAULT_KINDS = len(FaultKind)  #: number of kinds of faults
NEVER = 1e18  #: a tick that no flight reaches
# fmt: on


class Field(NamedTuple):
    """One named quantity in a record."""

    name: str
    shape: tuple[int, ...]
    unit: str
    meaning: str
    kind: str = "f8"
