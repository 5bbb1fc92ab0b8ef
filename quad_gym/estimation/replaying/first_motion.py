"""Logs that begin in motion: level and at rest is then a rough guess, as its spread must show.

The spread is the start's alone: a later reset has the suite's own numbers.
"""

import math

import numpy as np

from quad_gym.estimation.logs import Log
from quad_gym.params.sensors import SensorSuite

SPAN = 1.0  #: time after the first fix whose positions show the speed at the first one [s]
TURNING, FAST = 0.3, 1.0
"""Angular rate [rad/s] and speed [m/s] at the first fix of a vehicle that moves."""
CERTAIN = 4.0  #: standard deviations of a speed from positions beyond which it is no noise
TILT = 0.3  #: standard deviation of roll and pitch of a vehicle that maneuvers [rad]


def wide_start(suite: SensorSuite, log: Log) -> dict[str, float]:
    """Return keywords of `initialize` for a large uncertainty, if a log begins in motion.

    A filter that solves Wahba's problem for its start keeps it: there are none.
    """
    speed = _first_speed(log, suite)
    own = suite.estimator
    if speed is None or own.initial_tilt_sigma is None:
        return {}
    at_rest = math.sqrt(own.initial_velocity_variance)
    return {
        "tilt_sigma": max(own.initial_tilt_sigma, TILT),
        "rest_sigma": max(at_rest, 1.0 + round(speed)),
    }


def _first_speed(log: Log, suite: SensorSuite) -> float | None:
    """Return the speed of a vehicle that moves at the first fix [m/s]; None: it hardly does."""
    gnss = log.gnss
    if gnss is None or suite.gnss is None:
        return None
    known = (gnss.values[n] for n in ("position_G", "position_I") if n in gnss.values)
    positions = next(known, np.empty((len(gnss), 0)))
    rows = np.isfinite(positions).all(axis=1) & (positions.shape[1] > 0)
    if not rows.any():
        return None
    time, positions = gnss.time[rows], positions[rows]
    rows = time < time[0] + SPAN
    nearest = int(np.argmin(np.abs(log.imu.time - time[0])))
    turning = float(np.linalg.norm(log.imu.values["gyro"][nearest]))
    speed, spread = 0.0, np.inf
    if rows.sum() > 3:  # at the first fix, with a constant acceleration
        powers = np.vander(time[rows] - time[0], 3)
        fit = np.linalg.pinv(powers)[1]
        speed = float(np.linalg.norm(fit @ positions[rows]))
        spread = max(suite.gnss.position_sigma_I) * float(np.linalg.norm(fit))
    moving = speed > max(FAST, CERTAIN * spread)
    return speed if moving or turning > TURNING else None
