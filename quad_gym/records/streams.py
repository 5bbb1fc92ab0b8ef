"""Indices of all random draws in one table, so that no two quantities share a draw.

A flight's random stream is counter-based: draw n of an instant is a function of the flight's key,
the instant and n. Each quantity has a range of indices. A draw yields two random numbers.
"""

from typing import NamedTuple

from quad_gym.records.enums import AID_MOST, Aid
from quad_gym.records.params import DRAWN_SIZE
from quad_gym.records.sizes import *

# --------------------------------------------------------------------------------------------------
# Heights of drawn references, constants that checks of the ground can import without kernels.
# --------------------------------------------------------------------------------------------------

LOWEST_GATE, GATE_SPREAD = 0.7, 0.6
"""Lowest height of a gate, and range of heights above it, divided by `TaskParams.height`."""
RANDOM_RISE = 0.3
"""Ratio of vertical to horizontal coefficients of a random trajectory before scaling. Its vertical
extent is typically below this share of `TaskParams.radius`."""


# --------------------------------------------------------------------------------------------------
# Indices of all random draws in one table, so that no two quantities share a draw.
# --------------------------------------------------------------------------------------------------

DRAWS_OF_FAULT = 8
"""Draws for a kind of fault: its times (2), size and direction (2), effect on one sample (4)."""


class DrawRange(NamedTuple):
    """Range of one quantity's draws within an instant."""

    quantity: str
    first: int
    draws: int


DRAW_RANGES: list[DrawRange] = []  #: all ranges; no two overlap


def _claim(quantity: str, first: int, count: int) -> int:
    """Reserve a range of draws that no other quantity has; return the first."""
    for other in DRAW_RANGES:
        if first < other.first + other.draws and other.first < first + count:
            raise ValueError(f"draws of {quantity!r} overlap those of {other.quantity!r}")
    DRAW_RANGES.append(DrawRange(quantity, first, count))
    return first


_SHARING = 4
"""Number of aiding sensors, the first ones, that share ranges of draws. Each further one has a separate
range, so that a new sensor changes no draw of another."""
_FIRST_OWN, _OWN, _OF_BLOCKS = 4096, 64, 16
"""First of these ranges, their size, and the part for the blocks of a sensor."""
_FIRST_LARGE, _LARGE = 1 << 16, 1 << 12  #: the same for sensors with more blocks


def _claim_aids(
    quantity: str, first: int, draws: int, place: int, each_block: bool = False
) -> tuple[int, ...]:
    """Reserve draws of a quantity of all aiding sensors; return the first of each.

    Args:
        quantity: The quantity.
        first: First draw of the range that the first sensors share.
        draws: Number of draws of a sensor, or of each of its blocks.
        place: Place of the quantity in the range that a further sensor has for itself.
        each_block: True: draws of each block.
    """
    _claim(quantity, first, draws * _SHARING)
    found = [first + draws * aid for aid in range(_SHARING)]
    for aid in list(Aid)[_SHARING:]:
        own = _FIRST_OWN + _OWN * (aid - _SHARING) + place
        count = draws * AID_MOST[aid] if each_block else draws
        if each_block and count > _OF_BLOCKS:
            own = _FIRST_LARGE + _LARGE * (aid - _SHARING)
        found.append(_claim(f"{quantity}: {aid.name}", own, count))
    return tuple(found)


# at every instant
DRAW_BIAS = _claim("driving noise of the IMU biases", 0, 3)
DRAW_IMU = _claim("white noise of the IMU", 3, 3)
DRAW_GNSS = _claim("white noise of GNSS position and baseline", 6, 3)
DRAW_NOISY = _claim("noise of noisy observations", 9, 6)
DRAW_FEATURE = _claim("noise of pixels", 16, MAX_FEATURES)
DRAW_GUST = _claim("gusts", 192, 3)
DRAW_DRIFT = _claim("slow error of GNSS positions", 512, 3)
DRAW_VELOCITY = _claim("noise of the GNSS velocity", 516, 3)
DRAW_FAULTS = _claim("faults", 1024, DRAWS_OF_FAULT * FAULT_KINDS)
DRAW_HIDDEN = _claim("features that an occlusion hides", 2048, MAX_FEATURES)
DRAW_VIBRATION = _claim("vibration of the IMU", 576, 3)
DRAW_BLUR = _claim("places in blurred images", 592, MAX_FEATURES)
DRAW_AID = _claim_aids("white noise of aiding sensors", 720, 2, 0, each_block=True)
DRAW_AID_DRIFT = _claim_aids("slow errors of aiding sensors", 736, 1, 16)
DRAW_AID_VECTOR = _claim_aids("slow errors of aiding sensors, of three numbers", 740, 3, 24)
# at an episode's first instant
DRAW_COURSE = _claim("phase, radius, period and sense of the reference", 64, 2)
DRAW_START = _claim("start", 66, 5)
DRAW_FIRST_BIASES = _claim("IMU biases at the start", 71, 3)
DRAW_GROUND = _claim("whether a mixed start is on the ground", 74, 1)
DRAW_MOTION = _claim("velocity and body rates of a moving start", 75, 3)
DRAW_SERIES = _claim("coefficients of a random trajectory", 80, 3 * MAX_HARMONICS)
DRAW_GATES = _claim("gates", 128, 1 + 2 * MAX_GATES)
DRAW_PARAMETERS = _claim("randomized parameters", 256, DRAWN_SIZE)
DRAW_PHASE = _claim("phases of GNSS and camera", 515, 1)
DRAW_MARK = _claim("heading that the mark of the start tells", 519, 1)
DRAW_PATH = _claim("which trajectory, where on it, and which way it is turned", 520, 2)
DRAW_WARM = _claim("errors of a warm start", 544, 8)
DRAW_IMU_ERRORS = _claim("errors of scale and alignment of the IMU", 640, 9)
DRAW_HEADING = _claim("constant error of the baseline", 649, 1)
DRAW_SLOW = _claim("slow errors of aiding sensors at the start", 656, MAX_SLOW)
DRAW_AID_MATRIX = _claim_aids("errors of scale and alignment of aiding sensors", 672, 5, 32)
DRAW_AID_PHASE = _claim_aids("phases of aiding sensors", 704, 1, 56)
DRAW_OBSTACLES = _claim("shifts of obstacles", 768, 2 * MAX_OBSTACLES)
DRAW_WARM_DRIFT = _claim("slow error of GNSS positions at a warm start", 552, 3)
