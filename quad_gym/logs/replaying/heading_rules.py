"""Rules of the verdict on the heading, by the motion and by the compass alone."""

import itertools
import math
from collections.abc import Iterator
from functools import cache

import numpy as np

from quad_gym.logs.formats import Floats
from quad_gym.logs.replaying.results import Finding, Replay, Severity
from quad_gym.logs.replaying.rules import Evidence, lost, note, uncertain
from quad_gym.rotations import euler_to_dcm

# --------------------------------------------------------------------------------------------------
# The heading of the motion contradicts a compass or a start.
# --------------------------------------------------------------------------------------------------

LARGE, SURE = math.radians(10.0), 4.0
"""Difference of two headings that matters [rad], and its least number of standard deviations."""
KNOWN = math.radians(15.0)  #: standard deviation below which the motion shows a heading [rad]
LASTING = 2.0
"""Time of a disturbance, and for which headings contradict each other without a reset of the filter
[s]."""
FEW_FIELDS, CONTRADICTED = 10, 0.2
"""Number of fields that show whether a compass agrees, and the share beyond the gate with which it
does not."""
_TURNS = (45.0, 90.0, 135.0, 180.0)  #: angles by which autopilots assume compasses turned


def contradicted(case: Evidence) -> Iterator[Finding]:
    """Headings that the GNSS velocities contradict, and compasses that were left out."""
    log, suite, result = case.log, case.suite, case.result
    apart, sigma = np.abs(result.heading_apart), np.asarray(result.motion_sigma)
    compass = suite.magnetometer is not None and "magnetometer" in log.streams
    known = (sigma < KNOWN) & np.asarray(result.heading_known, bool)
    wrong = known & (apart > np.maximum(LARGE, SURE * sigma))
    out = np.asarray(result.compass_out, bool)
    rises = np.flatnonzero(out[1:] & ~out[:-1]) + 1
    for first, last in _runs(wrong):
        begin, end = float(result.time[first]), float(result.time[last])
        reset = any(first <= k <= last + 1 for k in rises)
        if reset or end - begin >= LASTING:
            k = first + int(np.argmax((apart / sigma)[first : last + 1]))
            yield _contradiction(result, compass, begin, end, k, reset)
            return
    unknown = [k for k in rises if not result.heading_known[k]]
    if unknown and _agrees(case, out):
        yield _wrong_start(result, int(unknown[0]))
    elif unknown:
        yield _thrown(result, compass, int(unknown[0]))
    elif compass and len(rises):
        text, time = _left_out(result, out, int(rises[0])), result.time[rises[0]]
        why = "it contradicts the motion. It is turned, near iron, frozen or disturbed"
        if _agrees(case, out):
            why = f"the heading was wrong until {time:.1f} s. It agrees with the later one"
        yield uncertain("heading", f"the magnetometer {text}: {why}")
    elif compass and len(sigma) and np.isfinite(sigma).any() and not (sigma < KNOWN).any():
        yield Finding(
            quantity="heading",
            severity=Severity.NOTE,
            text="no motion shows the heading: the magnetometer alone determines it",
        )


def _agrees(case: Evidence, out: np.ndarray) -> bool:
    """Return True if a compass agrees with the estimate while it is left out.

    The heading that was wrong is then not the compass's. A filter waits before it trusts a compass
    again, until the vehicle has turned.
    """
    m = case.sensors.get("magnetometer")
    if m is None or not len(m.time):
        return False
    rows = np.interp(m.time, case.result.time, out.astype(np.float64)) > 0.5
    rows &= np.isfinite(m.nis)
    return rows.sum() >= FEW_FIELDS and float(m.rejected[rows].mean()) < CONTRADICTED


def _wrong_start(result: Replay, k: int) -> Finding:
    """A heading that was found wrong in row k, while the compass agrees with the later one."""
    later = np.flatnonzero(np.asarray(result.heading_known, bool)[k:])
    until = f"until {result.time[k + later[0]]:.1f} s" if len(later) else "until the end"
    text = (
        f"the heading tilted the estimate: it was wrong until {result.time[k]:.1f} s, and unknown "
        f"{until}. The magnetometer agrees with the later one"
    )
    return lost("heading", text) if not len(later) else uncertain("heading", text)


def _thrown(result: Replay, compass: bool, k: int) -> Finding:
    """A heading that was found wrong in row k, before the motion showed the right one."""
    later = np.flatnonzero(np.asarray(result.heading_known, bool)[k:])
    until = f"until {result.time[k + later[0]]:.1f} s" if len(later) else "until the end"
    what = "the heading of the magnetometer" if compass else "the given heading (--heading)"
    return lost(
        "heading",
        f"{what} contradicts the GNSS velocities, as it tilts the estimate: it was wrong until "
        f"{result.time[k]:.1f} s, and unknown {until}",
    )


def _contradiction(
    result: Replay, compass: bool, begin: float, end: float, k: int, reset: bool
) -> Finding:
    """A heading that contradicts the motion, most clearly in row k."""
    angle = math.degrees(abs(result.heading_apart[k]))
    ratio = abs(result.heading_apart[k]) / result.motion_sigma[k]
    what = "the heading" if compass else "the given heading (--heading)"
    text = (
        f"{what} contradicts the GNSS velocities by {angle:.0f} degrees ({ratio:.0f} standard "
        f"deviations) from {begin:.1f} to {end:.1f} s"
    )
    if reset:
        text += "; it was wrong before, and was reset to that of the motion"
    if compass:
        text += ". The magnetometer is turned, near iron, or disturbed: check its orientation"
        near = [turn for turn in _TURNS if abs(angle - turn) < 10.0]
        if near:
            text += f" (turned by about {near[0]:.0f} degrees about the vertical axis?)"
        out = np.asarray(result.compass_out, bool)
        if out.any():
            text += f". It {_left_out(result, out, int(np.argmax(out)))}"
    return lost("heading", text)


def _left_out(result: Replay, out: np.ndarray, first: int) -> str:
    """Say for how long a compass was left out from a row on."""
    back = np.flatnonzero(~out[first:])
    last = first + int(back[0]) if len(back) else len(out) - 1
    time = float(result.time[last] - result.time[first])
    return f"was rejected for {time:.0f} s" + ("" if len(back) else ", until the end")


def _runs(rows: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the last row of each run of True."""
    steps = np.diff(np.concatenate([[0], rows.astype(np.int8), [0]]))
    firsts, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    return list(zip(firsts.tolist(), (ends - 1).tolist(), strict=True))


# --------------------------------------------------------------------------------------------------
# Strength of the field, and axes of a compass against those of the IMU.
#
# Neither needs an estimate. The strength of the Earth's field does not change in a flight, however
# the vehicle turns; and while it turns by theta, the field in B changes by -theta x B.
# --------------------------------------------------------------------------------------------------

STRENGTH = 0.1  #: relative change of the strength that iron and currents make, at least [-]
OF_IRON = 4.0  #: standard deviations of the suite's hard iron that are no finding
OTHER = 0.15  #: relative difference of the median strength from the suite's worth a note [-]
TURN, LONGEST = 0.3, 0.6  #: time of turns that are compared with changes of the field [s]
SMALL_ANGLE = 0.5  #: largest turn in this time, beyond which changes are not linear [rad]
MIN_TURNS = 30  #: number of turns
EXPLAINED, BETTER = 0.3, 4.0
"""Share of the squared changes that the right axes leave unexplained, at most, and how many times
more the wrong ones leave."""
JUMP, OF_USUAL, RARE = 0.2, 6.0, 0.1
"""Jump of the field over its strength, over the median of what turns do not explain, at least; and
the share of such changes, at most [-]."""
STEP = math.radians(15.0)  #: step of the angles about the vertical axis


def strength(case: Evidence) -> Iterator[Finding]:
    """A field whose strength changes: iron and currents, or power lines."""
    compass, params = case.log.magnetometer, case.suite.magnetometer
    if compass is None or params is None or len(compass) < MIN_TURNS:
        return
    time = compass.time
    sizes = np.linalg.norm(compass.values["magnetometer"], axis=1)
    middle = float(np.median(sizes))
    change = _smoothed(time, sizes / middle - 1.0)
    limit = max(STRENGTH, OF_IRON * params.hard_iron_sigma / params.strength)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.abs(change) > limit, [0]])))
    spans = [
        (float(time[b]), float(time[e - 1])) for b, e in zip(edges[::2], edges[1::2], strict=True)
    ]
    long = [(since, until) for since, until in spans if until - since >= LASTING]
    if long:
        since, until = long[0][0], long[-1][1]
        inside = (time >= since) & (time <= until)
        most = 100.0 * float(np.abs(change[inside]).max())
        yield uncertain(
            "heading",
            f"the strength of the magnetic field changes by {most:.0f} % from {since:.1f} s to "
            f"{until:.1f} s: iron, currents or a power line near the magnetometer disturb it",
        )
    if abs(middle / params.strength - 1.0) > OTHER:
        yield note(
            "heading",
            f"the magnetic field has {1e6 * middle:.1f} uT in the median, "
            f"{1e6 * params.strength:.1f} uT expected at this place: calibrate the magnetometer",
        )


def _smoothed(time: Floats, values: Floats) -> Floats:
    """Return medians over a second around each time."""
    low, high = np.searchsorted(time, time - 0.5), np.searchsorted(time, time + 0.5, "right")
    return np.array([np.median(values[a:b]) for a, b in zip(low, high, strict=True)])


def axes(case: Evidence) -> Iterator[Finding]:
    """Axes of the IMU and of the magnetometer that differ."""
    turns = _turns(case)
    if turns is None:
        return
    theta, changed, middle, _ = turns
    total = float((changed**2).sum())
    left = {
        name: float(((changed + np.cross(theta @ R.T, middle)) ** 2).sum()) / total
        for name, R in _rotations().items()
    }
    best = min(left, key=left.__getitem__)
    if best and left[best] < EXPLAINED and left[""] > BETTER * left[best]:
        yield lost(
            "heading",
            "the magnetic field turns as if the axes of the magnetometer and the IMU differed by "
            f"{best}: check the orientation of both in the log (log_compass_rotation, "
            "log_rotation)",
        )


def jumps(case: Evidence) -> Iterator[Finding]:
    """A field that jumps as no turn explains, and stays there."""
    turns = _turns(case)
    if turns is None or case.suite.magnetometer is None:
        return
    theta, changed, middle, time = turns
    rest = changed + np.cross(theta, middle)
    sizes = np.linalg.norm(rest, axis=1)
    limit = max(JUMP * case.suite.magnetometer.strength, OF_USUAL * float(np.median(sizes)))
    far = np.flatnonzero(sizes > limit)
    if not len(far) or (sizes > limit).mean() > RARE:
        return
    first, last = time[far[0]], time[far[-1]]
    if last - first < LASTING:
        return  # an outlier, whose jumps cancel each other
    k = int(far[np.argmax(sizes[far])])
    yield uncertain(
        "heading",
        f"the magnetic field jumps by {1e6 * sizes[k]:.0f} uT at {time[k]:.1f} s, which no turn of "
        f"the IMU explains, and does so until {last:.1f} s: iron, currents or a power line near "
        "the magnetometer disturb it",
    )


def _turns(case: Evidence) -> tuple[Floats, Floats, Floats, Floats] | None:
    """Return turns of the IMU (n, 3) [rad], changes of the field, mean fields [T], and times.

    None: the log has none.
    """
    compass, imu = case.log.magnetometer, case.log.imu
    if compass is None or case.suite.magnetometer is None:
        return None
    order = np.argsort(compass.time, kind="stable")
    time, field = compass.time[order], compass.values["magnetometer"][order]
    steps = np.minimum(np.diff(imu.time), LONGEST)[:, np.newaxis]
    angles = np.vstack([np.zeros(3), np.cumsum(imu.values["gyro"][1:] * steps, axis=0)])
    at = np.column_stack([np.interp(time, imu.time, axis) for axis in angles.T])
    later = np.searchsorted(time, time + TURN)
    first = np.flatnonzero(later < len(time))
    later = later[first]
    near = time[later] - time[first] < LONGEST
    first, later = first[near], later[near]
    theta = at[later] - at[first]
    small = np.linalg.norm(theta, axis=1) < SMALL_ANGLE
    if small.sum() < MIN_TURNS:
        return None
    first, later = first[small], later[small]
    both = field[later] - field[first], 0.5 * (field[later] + field[first])
    return theta[small], *both, time[first]


@cache
def _rotations() -> dict[str, Floats]:
    """Return rotations (3, 3) of one sensor against the other, by their descriptions.

    All that map axes to axes, and those about the vertical axis in steps; "" is none.
    """
    found = {"": np.eye(3)}
    for k in range(1, 24):
        degrees = 15 * k if k <= 12 else 15 * k - 360
        words = f"{abs(degrees)} degrees about the vertical axis"
        found.setdefault(
            f"{words}{' to the other side' if degrees < 0 else ''}",
            euler_to_dcm((0.0, 0.0, STEP * k)),
        )
    for places in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), places] = signs
            if np.linalg.det(R) > 0.0 and R[2, 2] <= 0.0:
                listed = ", ".join(
                    f"{'-' if s < 0.0 else ''}{'xyz'[p]}"
                    for s, p in zip(signs, places, strict=True)
                )
                found[f"a rotation that makes (x, y, z) to ({listed})"] = R
    return found
