"""Checks of the units and axes of a log, as plain sentences.

Each sentence states a number, the expected one, and the likely cause.
"""

import math
from collections.abc import Iterator

import numpy as np

from quad_gym.estimation.logs import Floats, Log

MIN_FORCE, MAX_FORCE = 5.0, 20.0
"""Median specific force of a flight [m/s^2], near gravity; a crash hardly changes it."""
FORCE_CAUSES = (
    (0.5, "gravity subtracted from the accelerometer?"),
    (2.0, "accelerometer in g?"),
    (25.0, "unit or scale of the accelerometer?"),
    (50.0, "accelerometer in ft/s^2?"),
    (500.0, "unit or scale of the accelerometer?"),
    (math.inf, "accelerometer in milli-g or cm/s^2?"),
)
"""Likely causes of other values, each up to a median specific force [m/s^2]."""
MAX_RATE = 35.0  #: largest angular rate that gyros measure [rad/s]: 2000 deg/s
MAX_MEAN_RATE = 10.0
"""Mean angular rate of a vehicle over a log [rad/s]: one and a half turns per second."""


class MisfitError(ValueError):
    """The suite cannot be used with the log."""


def implausible(log: Log, body: str) -> Iterator[str]:
    """Yield sentences on units and axes of the IMU of a log."""
    gyro, accel = (log.imu.values[name] for name in ("gyro", "accel"))
    yield from _force(accel, body)
    yield from _rates(gyro)


def nothing_in_common(unused: tuple[str, ...]) -> str:
    """Return a sentence on a suite that has none of the sensors of a log."""
    return f"this suite uses no measurement of this log, which has {', '.join(unused)}"


def _force(accel: Floats, body: str) -> Iterator[str]:
    """Units and axes of the accelerometer, by gravity."""
    size, upward = float(np.median(np.linalg.norm(accel, axis=1))), np.median(accel, axis=0)
    if not MIN_FORCE <= size <= MAX_FORCE:
        cause = next(cause for most, cause in FORCE_CAUSES if size <= most)
        yield f"median specific force is {size:.1f} m/s^2, 9.8 expected: {cause}"
    axis = int(np.argmax(np.abs(upward)))
    if abs(upward[axis]) < 0.5 * size or (axis == 2 and upward[2] > 0.0):
        return
    sign = "+" if upward[axis] > 0.0 else "-"
    pointing = f"median specific force points along the body's {sign}{'xyz'[axis]}"
    if axis == 2:
        other = {"flu": "frd", "frd": "flu"}[body]
        yield f"{pointing} axis, +z expected: body='{other}' (--body {other})?"
    else:
        yield f"{pointing} axis, +z expected: axes of the IMU other than forward, left and up?"


def _rates(gyro: Floats) -> Iterator[str]:
    """Units of the gyro."""
    sizes = np.linalg.norm(gyro, axis=1)
    if np.abs(gyro).max() > MAX_RATE:
        yield (
            f"angular rates reach {np.abs(gyro).max():.3g} rad/s, gyros measure up to "
            f"{MAX_RATE:g} rad/s: gyro in deg/s?"
        )
    elif sizes.mean() > MAX_MEAN_RATE:
        yield (
            f"mean angular rate is {sizes.mean():.3g} rad/s, at most {MAX_MEAN_RATE:g} expected: "
            "gyro in deg/s?"
        )
