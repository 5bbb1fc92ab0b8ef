"""PD control that plans where to look, and when to continue, by predicted covariances; no learning.

Certainty equivalence, control on the estimate as if it were the state, is optimal where actions do
not affect the covariance (linear systems). Where they do, a planner can penalize the trace of the
covariance that it predicts for each sequence of actions: S. Patil, G. Kahn, M. Laskey, J. Schulman,
K. Goldberg and P. Abbeel, Scaling up Gaussian belief space planning, WAFR 2014; see also Revisiting
Certainty Equivalence, arXiv:2607.07276.

The observation is that of the other arms with standard deviations. The model of the covariance has
three states per axis, the errors of position, velocity and acceleration (tilt and bias), from the
observed standard deviations, without their correlations.
"""

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from baselines.pd import MARGIN, WAITS_BEFORE, PDPolicy
from quad_gym.params import checks as check
from quad_gym.params.vehicle import GRAVITY
from quad_gym.tasks.look_around import HEADING_WEIGHT
from quad_gym.tasks.outage_dash import CRASH_COST, PROGRESS_WEIGHT

Array = NDArray[np.float64]

SEGMENTS = (0.5, 1.0, 1.5)
"""Durations of the parts of a plan, each with one direction of body x [s]."""
STEP = 0.25  #: time between two instants of a prediction [s]
TURN_RATE = 2.5  #: assumed rate at which PD control turns to another heading [rad/s]
EDGE = 0.35
"""Angle between body x and the markers at which most of them are still in view [rad]."""
TRACE_WEIGHT = 1.0  #: cost of the trace of the covariance of the position per step [1/m^2]

WAITS = (0.0, 1.0, 2.0, 4.0, 8.0)  #: times for which a plan waits before the next gap [s]
TIME_PRICE = 1.0  #: cost of waiting, little because time that remains is not rewarded [1/s]
COURSE = 132.0  #: length of the course of `OutageDash` [m]
SPEED = 4.7  #: speed of PD control between gaps [m/s]
GROWTH = ((0.25, 0.8, 2.0, 4.0, 6.0), (2.0, 5.0, 8.0, 12.0, 15.0))
"""Errors of the position [m] after times without GNSS [s], as in `OutageDash`."""
LOST = 0.1  #: standard deviation of the velocity that is only reached without GNSS [m/s]
LONGEST_OUTAGE, SHORTEST_OUTAGE = 15.0, 5.0  #: of `OutageDash` [s]


class PlanningPolicy(PDPolicy):
    """PD control on a plan, chosen in each step from some sequences by cost.

    In LookAround, a plan faces the rewarded heading, the markers, or the direction between them
    from which the markers are at the edge of the image, in each of `SEGMENTS`. The filter's model
    predicts which images will have markers, and the covariance; the cost is the lost reward for the
    heading plus `TRACE_WEIGHT` times the trace of the position's covariance.

    In OutageDash no action changes the covariance, so its trace cannot choose: a plan waits for a
    time before the gap, and the cost is the probability of a crash, from the standard deviation
    predicted for the gap, times the reward that a crash forfeits, plus a price for time. How long
    the outage has lasted follows from the standard deviation, how long it will from the task.

    Args:
        env: Environment with `include_std=True` that observes features, or gaps.
        weight: Instead of `TRACE_WEIGHT`, or of `TIME_PRICE` where there are gaps.

    Raises:
        ValueError: If the environment does not observe these, or as `PDPolicy`.
    """

    def __init__(self, env: Any, weight: float | None = None) -> None:
        gaps = any(f.name == "gap_width" for f in env.unwrapped.flights.table)
        if gaps:
            super().__init__(env, pace="waiting")
        else:
            super().__init__(env, faces="features_when_uncertain")
        self._waits, self._faces = False, "reference"  # the plan decides
        given = (TIME_PRICE if gaps else TRACE_WEIGHT) if weight is None else weight
        self._weight = check.number("weight", given, least=0.0)
        suite = env.unwrapped.flights.batch.sensors
        self._white = suite.imu.accel_noise_density**2
        if not gaps:
            self._rate, (self._view, self._variance) = suite.camera.rate, _markers(suite.camera)
            self._plans = np.array(list(product(range(3), repeat=len(SEGMENTS))))

    def _read(self, rows: Array) -> Any:
        seen = super()._read(rows)
        part = {name: rows[:, where] for name, where in self._slices.items()}
        if self._gaps:
            wait = self._waits_now(part)[:, np.newaxis]
            before = part["position_error"] - WAITS_BEFORE * seen.heading
            return seen._replace(position_error=np.where(wait, before, seen.position_error))
        return seen._replace(heading=self._chosen_heading(part, seen))

    # ---- LookAround ----------------------------------------------------------------------------

    def _chosen_heading(self, part: dict[str, Array], seen: Any) -> Array:
        """Direction of body x in the first segment of the cheapest plan, (n, 3) in B."""
        ahead, left = self._level_axes(seen.up)

        def azimuth(vector: Array) -> Array:
            x, y = (vector * ahead).sum(axis=1), (vector * left).sum(axis=1)
            return np.asarray(np.arctan2(y, x))

        wall, wanted = azimuth(part["features_direction"]), azimuth(seen.heading)
        away = _wrapped(wanted - wall)
        edge = wall + np.sign(away) * np.minimum(np.abs(away), EDGE)
        options = np.stack([wanted, wall, edge], axis=1)  # (n, 3), from body x
        targets = options[:, self._plans]  # (n, plans, segments)
        cost, P = np.zeros(targets.shape[:2]), self._start(part)[..., np.newaxis]
        yaw = np.zeros_like(cost)
        for segment, duration in enumerate(SEGMENTS):
            for _ in range(round(duration / STEP)):
                turn = _wrapped(targets[:, :, segment] - yaw)
                yaw = yaw + np.clip(turn, -TURN_RATE * STEP, TURN_RATE * STEP)
                images = self._rate * STEP * np.interp(_angle(yaw - wall[:, None]), *self._view)
                P = _measured(self._moved(P), self._variance, images)
                lost = 1.0 - np.cos(yaw - wanted[:, np.newaxis])
                cost += STEP * (HEADING_WEIGHT * lost + self._weight * 3.0 * P[0])
        first = self._plans[cost.argmin(axis=1), 0]
        angle = options[np.arange(len(options)), first][:, np.newaxis]
        return np.asarray(np.cos(angle) * ahead + np.sin(angle) * left)

    def _start(self, part: dict[str, Array], axis: int | None = None) -> Array:
        """Covariances of an axis, of the worst if None: the elements of `_moved`, (6, n)."""
        names = ("position", "velocity", "attitude", "accel_bias")
        sigmas = (part[f"{name}_sigma"] for name in names)
        r, v, e, b = (x.max(axis=1) if axis is None else x[:, axis] for x in sigmas)
        none = np.zeros_like(r)
        return np.stack([r**2, none, none, v**2, none, (GRAVITY * e) ** 2 + b**2])

    def _moved(self, P: Array, T: Any = STEP) -> Array:
        """Covariances a time T later, without measurements.

        P has the elements rr, rv, ra, vv, va and aa of position, velocity and acceleration.
        """
        rr, rv, ra, vv, va, aa = P
        rr = rr + T * (2.0 * rv + T * (ra + vv + T * (va + T / 4.0 * aa)))
        rv = rv + T * (ra + vv + T * (1.5 * va + T / 2.0 * aa))
        ra, vv = ra + T * (va + T / 2.0 * aa), vv + T * (2.0 * va + T * aa)
        white = self._white * T  # held for T
        return np.stack(
            [rr + T**2 / 4.0 * white, rv + T / 2.0 * white, ra, vv + white, va + T * aa, aa]
        )

    # ---- OutageDash ----------------------------------------------------------------------------

    def _waits_now(self, part: dict[str, Array]) -> Array:
        """Return True where the cheapest plan waits before the next gap, (n,)."""
        sigma = part["position_sigma"][:, 1]  # across the course
        lasted = np.interp(sigma, *GROWTH)
        lost = part["velocity_sigma"][:, :2].max(axis=1) > LOST
        distance = np.maximum((part["position_error"] * part["heading"]).sum(axis=1), 0.0)
        room = 0.5 * part["gap_width"][:, 0] - MARGIN
        P, costs = self._start(part, axis=1), []
        at_stake = CRASH_COST + PROGRESS_WEIGHT * COURSE
        for wait in WAITS:
            way = distance if wait == 0.0 else np.maximum(distance, WAITS_BEFORE)
            arrival = wait + way / SPEED
            later = np.sqrt(self._moved(P, arrival)[0])
            shortest = np.maximum(lasted, SHORTEST_OUTAGE)
            left = np.maximum(LONGEST_OUTAGE - shortest, 1e-3)
            over = np.clip((lasted + arrival - shortest) / left, 0.0, 1.0)
            over = np.where(lost, over, 1.0)
            known = np.where(lost, GROWTH[0][0], sigma)
            crash = over * _outside(room, known) + (1.0 - over) * _outside(room, later)
            costs.append(at_stake * crash + self._weight * wait)
        return np.asarray(np.argmin(costs, axis=0) > 0)


def _outside(room: Array, sigma: Array) -> Array:
    """Probability that a normal error exceeds the room on either side."""
    return np.asarray(2.0 * ndtr(-np.maximum(room, 0.0) / sigma))


def _wrapped(angle: Array) -> Array:
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _angle(angle: Array) -> Array:
    """Sizes of angles, in [0, pi]."""
    return np.abs(_wrapped(angle))


def _measured(P: Array, variance: float, count: Array) -> Array:
    """Covariances after a number of measurements of the position."""
    rr, rv, ra = P[:3]
    gain = count / (variance + count * rr)
    return P - gain * np.stack([rr * rr, rr * rv, rr * ra, rv * rv, rv * ra, ra * ra])


def _markers(camera: Any) -> tuple[tuple[Array, Array], float]:
    """Return the geometry of the markers, as seen from the origin.

    Returns:
        Angles between body x and the center of the markers [rad], and the share of the markers in
        the image there; and the variance of a position from one image [m^2].
    """
    places = np.array(camera.features_I)
    center = places.mean(axis=0)
    distance = float(np.hypot(*center[:2]))
    across = np.array([-center[1], center[0], 0.0]) / distance
    offsets = (places - center) @ across
    half = np.arctan(camera.image_size[0] / 2.0 / camera.focal_length)
    angles = np.linspace(0.0, np.pi, 721)
    share = (np.abs(np.arctan(offsets / distance) - angles[:, np.newaxis]) < half).mean(axis=1)
    depth = distance**2 / np.abs(offsets).mean()  # the largest of the three errors
    sigma = camera.pixel_sigma / camera.focal_length * depth / np.sqrt(len(places))
    return (angles, share), float(sigma**2)
