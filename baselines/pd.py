"""PD controller of the report, as a policy that computes actions only from observations."""

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from quad_gym.envs.spaces import policy_size
from quad_gym.params import checks as check
from quad_gym.params.vehicle import PDGains, pd_gains

Array = NDArray[np.float64]

MIN_LIFT, MAX_TILT = 0.3, 1.2
"""Limits of the desired force: minimum upward part as a share of the weight, and maximum ratio of
horizontal to vertical part (50 degrees), so that steps of the reference do not flip the vehicle."""


PACES = ("steady", "waiting")  #: modes of PD control at gaps

REACH_OF_GAPS = 1.5
"""Limit of position errors on courses with gaps, which gives a speed of 4.7 m/s [m]."""

WAITS_BEFORE = 6.0
"""Distance before a gap at which mode "waiting" waits, on OutageDash halfway between gaps [m]."""

SIGMAS, MARGIN = 2.0, 0.5
"""Criterion of mode "waiting": it waits while this number of standard deviations of the position
exceeds half the width of the next gap minus this margin, slightly more than the vehicle's radius
[m]."""

FACES = ("reference", "features", "features_when_uncertain")
"""Directions in which PD control can point body x."""

_REQUIRED = {
    'faces="features"': ("features_direction",),
    'faces="features_when_uncertain"': ("features_direction", "position_sigma"),
    'pace="waiting"': ("gap_width", "position_sigma"),
}
"""Fields of the observation that modes require."""

UNCERTAIN = 0.1
"""Standard deviation of the position above which "features_when_uncertain" faces features [m]."""


class _Seen(NamedTuple):
    """Parts of an observation that the controller uses, (n, 3) each in the body frame."""

    position_error: Array
    velocity_error: Array
    up: Array
    heading: Array
    body_rates: Array
    reference_acceleration: Array
    velocity: Array | None  #: velocity; None if the observation does not contain it


_RELATIVE_FIELDS = _Seen._fields[:-1]
_ABSOLUTE_FIELDS = (
    "position",
    "velocity",
    "R_BI",
    "body_rates",
    "reference_position",
    "reference_velocity",
    "reference_heading",
    "reference_acceleration",
)


def require_plain_observations(env: Any) -> None:
    """Reject environments with wrappers that change observations or their space."""
    kinds = (gymnasium.ObservationWrapper, gymnasium.vector.VectorObservationWrapper)
    layer = env
    while inner := getattr(layer, "env", None) or getattr(layer, "venv", None):
        normalizes = getattr(layer, "norm_obs", False)  # VecNormalize of Stable-Baselines3
        same = layer.observation_space == inner.observation_space
        if isinstance(layer, kinds) or normalizes or not same:
            raise ValueError(
                "env must return its original observations, in meters and radians: "
                f"{type(layer).__name__} changes them"
            )
        layer = inner


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def _cross(a: Array, b: Array) -> Array:
    """Cross products of vectors (n, 3), in a tenth of the time of `numpy.cross` for n = 1."""
    return a.take(_NEXT, 1) * b.take(_LAST, 1) - a.take(_LAST, 1) * b.take(_NEXT, 1)


def _unit(vectors: Array) -> Array:
    """Vectors (n, 3) divided by their lengths."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


class PDPolicy:
    """Proportional-derivative control of position and attitude (report section 4.2).

    `F = k (r* - r) + kd (v* - v) + m g e3 + m a*`, `z* = F/|F|`, thrust `F . z`; with `b = unit(z*
    x x*)`, `R_E = [b x z*, b, z*]^T` in body axes and `[e x] = R_E^T - R_E` (e is twice the vector
    of an antisymmetric part), `N = K e - Kd w + w x J w`. The environment's `action` determines the
    command:

    | `action` | command |
    |---|---|
    | "motor" | voltages of the allocation, with the largest alpha that saturates no rotor |
    | "wrench" | thrust and torque N |
    | "ctbr" | thrust and the body rates (K/Kd) e, at which N is zero except for w x J w |
    | "attitude" | thrust, roll and pitch of z*, yaw rate (K/Kd) e |
    | "velocity" | velocity whose error the inner loop converts to F; requires `layout="absolute"` |

    On courses with gaps, such as OutageDash, "velocity" also works with the relative layout.

    F is prevented from pointing down or far sideways (`MIN_LIFT`, `MAX_TILT`), as it otherwise
    would between gates; on the report's circle these limits are never reached.

    Args:
        env: A `QuadGym` environment: single, vector or Stable-Baselines3. Its observation must be
            "estimate", "truth" or "noisy".
        gains: "lab" (the report's gains) or "tuned", scaled to the vehicle, or `PDGains`.
        max_position_error: Limit of the norm of position errors [m], which determines the speed.
            None: 1 m on `Waypoints`, whose gates are far apart, `REACH_OF_GAPS` if the environment
            observes gaps, as OutageDash does, and unlimited otherwise.
        faces: Direction of body x. "reference": desired heading; "features": toward the features,
            if the environment observes their direction, as LookAround does;
            "features_when_uncertain": toward the features while the filter's largest standard
            deviation of the position is above `UNCERTAIN` (requires `include_std=True`), else the
            desired heading.
        pace: "steady", or "waiting": wait `WAITS_BEFORE` a gap that is too narrow for the filter's
            uncertainty (requires `include_std=True`).

    Raises:
        ValueError: If the controller does not support the environment's observation or action, or
            a wrapper changes the observations, such as `NormalizeObservation`.
    """

    def __init__(
        self,
        env: Any,
        gains: PDGains | str = "tuned",
        max_position_error: float | None = None,
        faces: str = "reference",
        pace: str = "steady",
    ) -> None:
        flights = getattr(getattr(env, "unwrapped", env), "flights", None)
        if flights is None:
            raise ValueError(f"env must be a QuadGym environment, got {type(env).__name__}")
        require_plain_observations(env)
        if flights.observation == "measurements":
            raise ValueError('env must observe a state: observation="measurements" contains none')
        needed = _ABSOLUTE_FIELDS if flights.layout == "absolute" else _RELATIVE_FIELDS
        self._faces = check.choice("faces", faces, FACES)
        self._waits = check.choice("pace", pace, PACES) == "waiting"
        shown = {field.name for field in flights.table}
        for mode in (f'faces="{faces}"', f'pace="{pace}"'):
            for name in _REQUIRED.get(mode, ()):
                if name not in shown:
                    how = ": make it with include_std=True" if "sigma" in name else ""
                    raise ValueError(f"env must observe {name} for {mode}{how}")
        # observations of tasks with a reference at rest may lack its acceleration
        self._gaps = "gap_width" in shown
        spared = {"reference_acceleration"} if self._gaps else set()
        missing = sorted(set(needed) - shown - spared)
        if missing:
            raise ValueError(
                f"env must observe {missing[0]}: its task replaces the built-in observation"
            )
        if flights.action == "velocity" and flights.layout != "absolute" and not self._gaps:
            raise ValueError(
                'env must have layout="absolute" for action="velocity", because the relative '
                "layout contains no velocity"
            )
        vehicle = flights.batch.vehicle
        named = pd_gains(gains, vehicle) if isinstance(gains, str) else gains
        self.gains = check.instance("gains", named, PDGains)
        if flights.action in ("motor", "wrench"):
            self._warn_if_too_slow(flights.control_rate, vehicle.inertia)
        self._vehicle, self._scales = vehicle, flights.batch.action_params
        self._action, self._absolute = flights.action, flights.layout == "absolute"
        self._slices = {field.name: field.slice for field in flights.table}
        self._widths = policy_size(flights.table), flights.table[-1].slice.stop
        on_course = flights.task.kind == "waypoints"
        usual = 1.0 if on_course else REACH_OF_GAPS if self._gaps else np.inf
        self._reach = usual
        if max_position_error is not None:
            self._reach = check.positive_or_infinite("max_position_error", max_position_error)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return the action for an observation, with the signature of Stable-Baselines3.

        The observation is (n_observation,) or (n, n_observation), or a dictionary with the key
        "policy". Further arguments are not used, because the controller has no memory and is always
        deterministic.

        Returns:
            Action (4,) or (n, 4) in [-1, 1], and None.
        """
        flat = observation["policy"] if isinstance(observation, dict) else observation
        rows = np.atleast_2d(np.asarray(flat, np.float64))
        if rows.ndim != 2 or rows.shape[1] not in self._widths:
            raise ValueError(
                f"observation must be (..., {self._widths[0]}), as in the environment for which "
                f"the policy was made, got shape {np.shape(flat)}"
            )
        action = self._act(self._read(rows))
        clipped = np.clip(action, -1.0, 1.0).astype(np.float32)
        return (clipped if np.ndim(flat) == 2 else clipped[0]), None

    def _warn_if_too_slow(self, control_rate: float, inertia: Any) -> None:
        """Warn if the sampled rate loop w+ = (1 - Kd/(J f)) w is unstable, Kd/(J f) > 2."""
        gain = float(np.max(np.array(self.gains.body_rates) / np.diag(inertia))) / control_rate
        if gain > 1.0:
            warnings.warn(
                f"PD control of torques needs {gain * control_rate:.0f} Hz with these gains, but "
                f"the control rate is {control_rate:g} Hz: expect oscillations or a crash",
                UserWarning,
                stacklevel=3,
            )

    # ---- from observation to force and torque -------------------------------------------------

    def _read(self, rows: Array) -> _Seen:
        part = {name: rows[:, where] for name, where in self._slices.items()}
        seen = self._read_state(part)
        if self._gaps:  # aim beyond the center, to fly through
            ahead = (seen.position_error * seen.heading).sum(axis=1, keepdims=True)
            beyond = np.maximum(REACH_OF_GAPS - ahead, 0.0) * seen.heading
            seen = seen._replace(position_error=seen.position_error + beyond)
        if self._waits:
            sigma = part["position_sigma"].max(axis=1, keepdims=True)
            unsure = SIGMAS * sigma > 0.5 * part["gap_width"] - MARGIN
            before = part["position_error"] - WAITS_BEFORE * seen.heading
            error = np.where(unsure, before, seen.position_error)
            seen = seen._replace(position_error=error)
        if self._faces == "reference":
            return seen
        toward = part["features_direction"]
        toward = _unit(toward - (toward * seen.up).sum(axis=1, keepdims=True) * seen.up)
        if self._faces == "features":
            return seen._replace(heading=toward)
        unsure = part["position_sigma"].max(axis=1, keepdims=True) > UNCERTAIN
        return seen._replace(heading=np.where(unsure, toward, seen.heading))

    def _read_state(self, part: Mapping[str, Array]) -> _Seen:
        if not self._absolute:
            at_rest = {"reference_acceleration": np.zeros_like(part["up"])}
            parts = {**at_rest, **part}
            velocity = -part["velocity_error"] if self._gaps else None  # gaps are at rest
            return _Seen(**{name: parts[name] for name in _RELATIVE_FIELDS}, velocity=velocity)
        R_BI = part["R_BI"].reshape(-1, 3, 3)

        def in_body(v_I: Array) -> Array:
            return np.einsum("nij,nj->ni", R_BI, v_I)

        return _Seen(
            position_error=in_body(part["reference_position"] - part["position"]),
            velocity_error=in_body(part["reference_velocity"] - part["velocity"]),
            up=R_BI[:, :, 2],
            heading=in_body(part["reference_heading"]),
            body_rates=part["body_rates"],
            reference_acceleration=in_body(part["reference_acceleration"]),
            velocity=in_body(part["velocity"]),
        )

    def _force(self, seen: _Seen) -> Array:
        """Desired force F, (n, 3) in B [N]."""
        g, vehicle = self.gains, self._vehicle
        distance = np.linalg.norm(seen.position_error, axis=1, keepdims=True)
        error = seen.position_error * np.minimum(1.0, self._reach / np.maximum(distance, 1e-9))
        force = (
            g.position * error
            + g.velocity * seen.velocity_error
            + vehicle.mass * (vehicle.gravity * seen.up + seen.reference_acceleration)
        )
        lift = (force * seen.up).sum(axis=1, keepdims=True)
        sideways = force - lift * seen.up
        lift = np.maximum(lift, MIN_LIFT * vehicle.mass * vehicle.gravity)
        push = np.linalg.norm(sideways, axis=1, keepdims=True)
        return lift * seen.up + sideways * np.minimum(1.0, MAX_TILT * lift / np.maximum(push, 1e-9))

    @staticmethod
    def _attitude_error(z_wanted: Array, heading: Array) -> Array:
        """Return e (n, 3), `[e x] = R_E^T - R_E`: twice the rotation vector of small errors [-]."""
        b = _unit(_cross(z_wanted, heading))
        a = _cross(b, z_wanted)
        return np.stack(
            [b[:, 2] - z_wanted[:, 1], z_wanted[:, 0] - a[:, 2], a[:, 1] - b[:, 0]], axis=1
        )

    # ---- from force and torque to action ------------------------------------------------------

    def _act(self, seen: _Seen) -> Array:
        vehicle, g = self._vehicle, self.gains
        weight = vehicle.mass * vehicle.gravity
        F = self._force(seen)
        z_wanted = _unit(F)
        e = self._attitude_error(z_wanted, seen.heading)
        thrust = F[:, 2]
        rates = np.array(g.attitude) / np.maximum(g.body_rates, 1e-9) * e
        collective = (thrust / weight - 1.0)[:, np.newaxis]

        if self._action == "ctbr":
            return np.hstack([collective, rates / self._scales.rate_scale])
        if self._action == "attitude":
            return np.hstack([collective, self._tilt(z_wanted, seen.up), self._yaw(rates)])
        if self._action == "velocity":
            return np.hstack([self._velocity(F, seen), self._yaw(rates)])
        w = seen.body_rates
        gyroscopic = _cross(w, w @ np.array(vehicle.inertia).T)
        torque = np.array(g.attitude) * e - np.array(g.body_rates) * w + gyroscopic
        if self._action == "wrench":
            return np.hstack([collective, torque / vehicle.hover_torques])
        return self._voltages(thrust, torque) / vehicle.hover_voltage - 1.0

    def _yaw(self, rates: Array) -> Array:
        return rates[:, 2:] / self._scales.rate_scale[2]

    @staticmethod
    def _level_axes(up: Array) -> tuple[Array, Array]:
        """Horizontal unit vectors ahead and to the left, in B."""
        ahead = _unit(np.array([1.0, 0.0, 0.0]) - up[:, :1] * up)
        return ahead, _cross(up, ahead)

    def _tilt(self, z_wanted: Array, up: Array) -> Array:
        """Roll and pitch of the desired thrust axis, scaled, (n, 2)."""
        ahead, left = self._level_axes(up)
        x, y = (z_wanted * ahead).sum(axis=1), (z_wanted * left).sum(axis=1)
        z = (z_wanted * up).sum(axis=1)
        roll, pitch = np.arctan2(-y, z), np.arcsin(np.clip(x, -1.0, 1.0))
        return np.stack([roll, pitch], axis=1) / self._scales.tilt_scale

    def _velocity(self, F: Array, seen: _Seen) -> Array:
        """Velocity in level axes whose error times m k_v is F minus the weight, scaled, (n, 3)."""
        vehicle = self._vehicle
        if seen.velocity is None:
            raise ValueError('action="velocity" needs layout="absolute"')
        wanted = seen.velocity + (F - vehicle.mass * vehicle.gravity * seen.up) / (
            vehicle.mass * self._scales.velocity_bandwidth
        )
        ahead, left = self._level_axes(seen.up)
        level = [(wanted * axis).sum(axis=1) for axis in (ahead, left, seen.up)]
        return np.stack(level, axis=1) / self._scales.velocity_scale

    def _voltages(self, thrust: Array, torque: Array) -> Array:
        """Motor voltages by the allocation of the report, (n, 4)."""
        vehicle = self._vehicle
        limit = vehicle.max_rotor_force
        allocation = np.linalg.inv(vehicle.effectiveness)
        base = np.minimum(thrust, 3.6 * limit)[:, np.newaxis] * allocation[:, 0]
        turn = torque @ allocation[:, 1:].T
        room = (limit - base) / np.where(turn > 0.0, turn, np.inf)
        alpha = np.where(turn > 0.0, room, 1.0).min(axis=1, keepdims=True).clip(0.0, 1.0)
        forces = np.maximum(base + alpha * turn, 0.0)
        return np.sqrt(forces / vehicle.thrust_coefficient) / vehicle.motor_speed_per_volt
