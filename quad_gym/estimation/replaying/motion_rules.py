"""Rules of the verdict on the motion: what the IMU does not explain, biases, and headings."""

import math
from collections.abc import Iterator

import numpy as np

from quad_gym.estimation.replaying.cases import FALSE_ALARM, Case, lost, note, uncertain
from quad_gym.estimation.replaying.dead_reckoning import SETTLED, Change, changes
from quad_gym.estimation.replaying.findings import Finding

SUDDEN = 4.0
"""Ratio of true and assumed standard deviations of dead reckoning over seconds [-]: measurements
correct a filter more often, so that noise of the IMU matters less."""
SMALL = {"attitude": math.radians(1.0), "heading": math.radians(2.0)}
"""Changes of the attitude that do not matter [rad]: mounting is no more accurate."""
MAX_BIAS = {"accel": 2.0, "gyro": 0.2}
"""Biases that no sensor has [m/s^2], [rad/s]: data sheets of cheap parts admit 0.5 m/s^2 and 0.09
rad/s (TDK ICM-20948)."""
BEYOND = 4.0  #: ratio of a bias and its standard deviation in the suite that is worth a note [-]


def unexplained(case: Case) -> Iterator[Finding]:
    """Changes of the estimate that the IMU does not explain."""
    from scipy.stats import norm

    result = case.result
    known = result.time[np.asarray(result.heading_known, bool)]
    if not len(known):
        return
    found, count = changes(case.log, result, float(known[0]) + SETTLED)
    if not found:
        return
    limit = SUDDEN * float(norm.isf(0.5 * FALSE_ALARM / count))
    worst: dict[str, Change] = {}
    for each in found:
        quantity = {"tilt": "attitude", "velocity": "position"}.get(each.quantity, each.quantity)
        least = SMALL.get(quantity, 0.0)
        if each.size > least and each.ratio > max(
            limit, getattr(worst.get(quantity), "ratio", 0.0)
        ):
            worst[quantity] = each
    for quantity, each in worst.items():
        size = f"{each.size:.3g} m"
        if each.quantity == "velocity":
            size = f"{each.size:.3g} m/s of velocity"
        elif quantity != "position":
            size = f"{math.degrees(each.size):.3g} degrees"
        yield lost(
            quantity,
            f"the estimate changes by {size} at about {each.time:.1f} s, {each.ratio:.0f} standard "
            "deviations, which the IMU does not explain: the filter was wrong before, or follows "
            "wrong measurements",
        )


def unknown_heading(case: Case) -> Iterator[Finding]:
    """A heading that no sensor and no motion shows until the end."""
    if not case.result.heading_known[-1]:
        yield uncertain(
            "heading",
            "unknown until the end: no sensor measures it, and the motion does not show it; "
            "give a heading or the course (--heading, --course)",
        )


def biases(case: Case) -> Iterator[Finding]:
    """Biases of the IMU that the suite, or any sensor, does not admit."""
    result, suite = case.result, case.suite
    for name, unit in (("accel", "m/s^2"), ("gyro", "rad/s")):
        found = np.sqrt((getattr(result, f"{name}_bias") ** 2).mean(axis=0)).max()
        sigma = getattr(suite.imu, f"{name}_bias_sigma")
        text = (
            f"{'accelerometer' if name == 'accel' else 'gyro'}: estimated bias {found:.2g} {unit}"
        )
        if not found <= max(MAX_BIAS[name], BEYOND * sigma):
            yield lost(
                "attitude",
                f"{text}, which no sensor has: check the suite's magnetic field, time stamps, "
                "mounting and noise",
            )
        elif found > BEYOND * sigma:
            yield note("attitude", f"{text}, {sigma:.2g} expected by the suite")
