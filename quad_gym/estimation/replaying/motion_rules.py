"""Rules of the verdict on the motion: what the IMU does not explain, biases, and headings."""

import math
from collections.abc import Iterator

import numpy as np

from quad_gym.estimation.logs.clocks import PAUSE
from quad_gym.estimation.replaying.cases import FALSE_ALARM, Case, lost, note, uncertain
from quad_gym.estimation.replaying.dead_reckoning import (
    SETTLED,
    Change,
    changes,
    increments,
    small_rotations,
)
from quad_gym.estimation.replaying.findings import Finding
from quad_gym.rotations import quaternion_to_dcm

SUDDEN = 4.0
"""Ratio of true and assumed standard deviations of dead reckoning over seconds [-]: measurements
correct a filter more often, so that noise of the IMU matters less."""
SMALL = {"attitude": math.radians(1.0), "heading": math.radians(2.0)}
"""Changes of the attitude that do not matter [rad]: mounting is no more accurate."""
MAX_BIAS = {"accel": 2.0, "gyro": 0.2}
"""Biases that no sensor has [m/s^2], [rad/s]: data sheets of cheap parts admit 0.5 m/s^2 and 0.09
rad/s (TDK ICM-20948)."""
WRONG = math.radians(20.0)  #: error of a heading at the start that matters [rad]
CERTAIN = 4.0  #: standard deviations beyond which such an error is no chance
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


def first_heading(case: Case) -> Iterator[Finding]:
    """A heading at the start that the flight contradicts.

    The gyro, with the bias of a later estimate, turns that estimate back to the start. The heading
    there has the error of the estimate, and of the turn.
    """
    result = case.result
    pause = np.flatnonzero(np.diff(result.time) > PAUSE)
    rows = slice(0, int(pause[0]) + 1 if len(pause) else len(result))
    time, known = result.time[rows], np.asarray(result.heading_known, bool)[rows]
    if not known[0] or len(time) < 3 or not np.isfinite(result.sigma[rows]).all():
        return
    T = time - time[0]
    white = result.sensors.imu.gyro_noise_density**2 * T
    spread = np.sqrt(result.sigma[rows, 8] ** 2 + (T * result.sigma[rows, 14]) ** 2 + white)
    last = len(T) - 1  # an estimate that was thrown by a wrong start has recovered by then
    if T[last] < SETTLED or spread[last] > WRONG:
        return
    turns = increments(case.log, result, "gyro")[:last]
    turns = turns - result.gyro_bias[last] * np.diff(time[: last + 1])[:, np.newaxis]
    R_BI = quaternion_to_dcm(result.quaternion[[0, last]])
    back = R_BI[1]
    for step in small_rotations(turns[::-1]):
        back = step @ back
    headings = [math.atan2(R[0, 1], R[0, 0]) for R in (R_BI[0], back)]
    off = math.remainder(headings[0] - headings[1], 2.0 * math.pi)
    if abs(off) < max(WRONG, CERTAIN * math.hypot(spread[last], float(result.sigma[0, 8]))):
        return
    text = f"the heading at the start is off by about {math.degrees(abs(off)):.0f} degrees"
    given = case.start.get("heading")
    if given is not None:
        text = (
            f"the given heading at the start (--heading {math.degrees(given):.0f}) is off by about "
            f"{math.degrees(abs(off)):.0f} degrees, as the motion shows"
        )
        other = math.remainder(0.5 * math.pi - given - headings[1], 2.0 * math.pi)
        if abs(other) < WRONG:
            text += ": it counts from east toward north, not from north (--heading-from-north)"
    yield lost("heading", text)


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
