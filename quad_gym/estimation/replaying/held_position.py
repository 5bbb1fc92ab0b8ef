"""A fictitious position for logs in which nothing measures position or velocity.

Roll and pitch are then dead reckoning, and drift. As EKF2 and EKF3 do, the filter assumes that the
vehicle stays near its first place, with a wide standard deviation: specific force is then gravity
on average, which keeps roll and pitch. The estimated position itself has no meaning.

Source: PX4, EKF2_NOAID_NOISE, 10 m.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from quad_gym.estimation.logs import Log, Stream
from quad_gym.params.aid_table import AID_PARAMS
from quad_gym.params.gnss import GnssParams
from quad_gym.params.sensors import SensorSuite

SIGMA, PERIOD = 10.0, 1.0  #: standard deviation [m], and time between measurements [s]
SENTENCE = (
    f"nothing measures the position: a fictitious one, with a standard deviation of {SIGMA:g} m, "
    "keeps roll and pitch; the estimated position and velocity have no meaning"
)


def lacks_position(log: Log, suite: SensorSuite) -> bool:
    """Return True if no sensor of a filter measures position or velocity in a log."""
    moving = [n for n, kind in AID_PARAMS.items() if {"position", "velocity"} & {*kind.observes}]
    return not any(
        getattr(suite, name) is not None and name in log.streams
        for name in ("gnss", "camera", *moving)
    )


def held(log: Log, suite: SensorSuite, place: Any) -> tuple[Log, SensorSuite]:
    """Return a log with fictitious positions at a place (3,) in I, and a suite that uses them.

    With a barometer or range finder, they are level only.
    """
    heights = any(
        getattr(suite, name) is not None and name in log.streams
        for name, kind in AID_PARAMS.items()
        if "height" in kind.observes
    )
    time = np.arange(log.imu.time[0], log.imu.time[-1], PERIOD)
    sigma = np.tile([SIGMA, SIGMA, np.inf if heights else SIGMA], (len(time), 1))
    places = np.tile(np.asarray(place, np.float64), (len(time), 1))
    reference = GnssParams() if suite.gnss is None else suite.gnss
    gnss = GnssParams(
        rate=suite.imu.rate,
        primary_antenna_B=(0.0, 0.0, 0.0),
        secondary_antenna_B=None,
        reference_antenna_G=reference.reference_antenna_G,
        position_sigma_I=(SIGMA, SIGMA, SIGMA),
    )
    values = {"position_I": places, "position_sigma_I": sigma}
    return replace(log, gnss=Stream(time, time, values)), suite.replace(gnss=gnss)
