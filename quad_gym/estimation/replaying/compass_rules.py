"""Rules of the verdict on a compass: its strength, and its axes against those of the IMU.

Neither needs an estimate. The strength of the Earth's field does not change in a flight, however
the vehicle turns; and while it turns by theta, the field in B changes by -theta x B.
"""

import itertools
import math
from collections.abc import Iterator
from functools import cache

import numpy as np

from quad_gym.logs.formats import Floats
from quad_gym.logs.replaying.results import Finding
from quad_gym.logs.replaying.rules import Evidence, lost, note, uncertain
from quad_gym.rotations import euler_to_dcm

STRENGTH = 0.1  #: relative change of the strength that iron and currents make, at least [-]
OF_IRON = 4.0  #: standard deviations of the suite's hard iron that are no finding
LASTING = 2.0  #: time of a disturbance [s]
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
