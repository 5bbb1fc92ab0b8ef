"""Heading of a trajectory: from the arguments of users to polynomials, and its angles."""

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check

if TYPE_CHECKING:
    from quad_gym.params.trajectories.trajectory import Trajectory

Floats = NDArray[np.float64]
HeadingRule = Literal["given", "along", "toward"]

LEAST_SPEED = 1e-3  # horizontal speed below which a heading along the path is held [m/s]


def heading_choice(yaw: Any, look_at: Any) -> tuple[HeadingRule, tuple[float, float], Any]:
    """Return the rule that a heading follows, `Trajectory.heading`, and its point (2,).

    The third value is the source of the angles: a number, or `yaw` itself if it is a function or an
    array.
    """
    if look_at is not None:
        if yaw is not None:
            raise ValueError("yaw must not be given with look_at, which sets the heading")
        size = np.size(look_at)
        point = check.vector("look_at", look_at, length=3 if size == 3 else 2)
        return "toward", (point[0], point[1]), 0.0
    if isinstance(yaw, str):
        check.choice("yaw", yaw, ("along",))
        return "along", (0.0, 0.0), 0.0
    if yaw is None:
        return "given", (0.0, 0.0), 0.0
    if callable(yaw) or np.ndim(yaw) > 0:
        return "given", (0.0, 0.0), yaw
    return "given", (0.0, 0.0), check.angle("yaw", yaw)


def yaw_angles(trajectory: "Trajectory", times: Floats) -> tuple[Floats, Floats, Floats]:
    """The angle of the heading [rad] and its first two derivatives, of the shape of `times`."""
    inside, beyond = trajectory._within(times)
    if trajectory.heading == "given":
        yaw = trajectory._polynomials(3, 4)
        found = [np.asarray(yaw(inside, k))[..., 0] for k in range(3)]
        if trajectory.closed:  # each round adds the turns of one
            turns = yaw(trajectory.duration)[0] - yaw(0.0)[0]
            found[0] = found[0] + np.round(turns / (2 * np.pi)) * 2 * np.pi * np.floor(
                times / trajectory.duration
            )
        return found[0], np.where(beyond, 0.0, found[1]), np.where(beyond, 0.0, found[2])
    if trajectory.heading == "along":
        d, d1, d2 = (trajectory(times, k)[..., :2] for k in (1, 2, 3))
        begin, end = trajectory.end_headings
        held = np.stack([times <= 0.0, times >= trajectory.duration])
        held &= not trajectory.closed
        d = np.where(held[0][..., np.newaxis], begin, d)
        d = np.where(held[1][..., np.newaxis], end, d)
        still = held.any(axis=0) | (np.hypot(d[..., 0], d[..., 1]) < LEAST_SPEED)
    else:
        d = np.array(trajectory.point) - trajectory(times)[..., :2]
        d1, d2 = (-trajectory(times, k)[..., :2] for k in (1, 2))
        still = np.hypot(d[..., 0], d[..., 1]) < 1e-9
    return _angles(d, d1, d2, still)


def _angles(
    d: Floats, d1: Floats, d2: Floats, still: NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats]:
    """The angle of horizontal vectors and its derivatives, which are 0 where it stands still."""
    square = np.where(still, 1.0, (d * d).sum(axis=-1))
    cross = d[..., 0] * d1[..., 1] - d[..., 1] * d1[..., 0]
    bend = d[..., 0] * d2[..., 1] - d[..., 1] * d2[..., 0]
    rate = cross / square
    change = (bend - 2.0 * rate * (d * d1).sum(axis=-1)) / square
    angle = np.arctan2(d[..., 1], d[..., 0])
    return angle, np.where(still, 0.0, rate), np.where(still, 0.0, change)
