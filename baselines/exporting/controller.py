"""`Controller`: a trained network with all information for running it elsewhere."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from baselines.mlp import MlpPolicy, mlp_of
from baselines.normalization import NormalizedPolicy
from baselines.policies import is_included, load_policy, pretrained_file, record_of
from quad_gym.envs import keywords_of
from quad_gym.envs.spaces import ObservationField, layout_bounds
from quad_gym.packing.flight import params_record
from quad_gym.params import checks as check

_OUR_PACKAGES = ("quad_gym", "baselines")  #: packages that are imported already
_AGREEMENT = 1e-4
"""Largest difference accepted between a network and the policy that it represents."""


class ActionField(NamedTuple):
    """Component a of an action: `quantity = offset + scale a`, limited to `most`."""

    name: str
    offset: float
    scale: float
    unit: str
    frame: str
    """Frame. B: body; H: level, x along the body's heading, y to its left, z up; "-": none"""
    most: float | None = None

    def formula(self, number: int) -> str:
        """Formula for the quantity, such as `thrust = 7.644 (1 + a[0]) N`."""
        a = f"a[{number}]"
        value = f"{self.scale:.6g} {a}"
        if self.offset == self.scale:
            value = f"{self.scale:.6g} (1 + {a})"
        frame = "" if self.frame == "-" else f" in {self.frame}"
        limit = "" if self.most is None else f", at most {self.most:g} {self.unit}"
        return f"{self.name} = {value} {self.unit}{frame}{limit}"


def action_fields(action: str, params: Any) -> tuple[ActionField, ...]:
    """Describe the four components of an action, the keyword `action` of an environment.

    `params` are nominal parameters, one scalar PARAMS record (`packing.flight.params_record`).
    """
    check.choice("action", action, ("ctbr", "motor", "wrench", "attitude", "velocity"))
    weight = float(params["mass"] * params["gravity"])
    thrust = ActionField("thrust", weight, weight, "N", "B")
    rates = [float(rate) for rate in params["rate_scale"]]
    yaw_rate = ActionField("yaw rate", 0.0, rates[2], "rad/s", "B")
    if action == "ctbr":
        axes = zip("xyz", rates, strict=True)
        return thrust, *(ActionField(f"body rate {a}", 0.0, w, "rad/s", "B") for a, w in axes)
    if action == "motor":
        hover, most = float(params["hover_voltage"]), float(params["max_voltage"])
        return tuple(
            ActionField(f"voltage of rotor {i}", hover, hover, "V", "-", most) for i in range(1, 5)
        )
    if action == "wrench":
        axes = zip("xyz", map(float, params["torque_scale"]), strict=True)
        return thrust, *(ActionField(f"torque {a}", 0.0, t, "N m", "B") for a, t in axes)
    if action == "attitude":
        tilt = float(params["tilt_scale"])
        angles = (ActionField(name, 0.0, tilt, "rad", "B") for name in ("roll", "pitch"))
        return thrust, *angles, yaw_rate
    speed = float(params["velocity_scale"])
    names = ("velocity ahead", "velocity to the left", "velocity up")
    return *(ActionField(name, 0.0, speed, "m/s", "H") for name in names), yaw_rate


@dataclass(frozen=True, kw_only=True)
class Controller:
    """Network with descriptions of its observations and actions."""

    policy: MlpPolicy
    source: str
    """Name or file of the policy"""
    env_id: str
    keywords: Mapping[str, Any]
    """Keywords of the environment for which it was trained"""
    table: tuple[ObservationField, ...]
    action: str
    """Keyword `action` of the environment"""
    action_fields: tuple[ActionField, ...]
    control_rate: float
    """[Hz]"""

    @property
    def bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lower and upper bounds to which observations are clipped, (n,) float32 each."""
        low, high = layout_bounds(self.table)
        return low.astype(np.float32), high.astype(np.float32)

    def act(self, observations: Any) -> NDArray[np.float32]:
        """Return the actions (..., 4) in [-1, 1] that an exported controller must return.

        Observations (..., n), described by `table`, are clipped to bounds.
        """
        within = np.clip(np.asarray(observations, np.float32), *self.bounds)
        return self.policy.predict(within)[0]

    def samples(self, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Draw observations (count, n) for comparing controllers.

        Half of them have typical magnitudes of flights, the others exceed the bounds.
        """
        low, high = self.bounds
        near = rng.standard_normal((count - count // 2, len(low)))
        far = rng.uniform(1.2 * low, 1.2 * high, (count // 2, len(low)))
        return np.concatenate([near, far]).astype(np.float32)


def controller_of(
    policy: str,
    env_id: str | None = None,
    keywords: Mapping[str, Any] | None = None,
    normalization: Any = None,
) -> Controller:
    """Load a trained policy with descriptions of its observations and actions.

    Args:
        policy: "pretrained", or a file: `.npz` (written by the compiled engine, or `quad-gym train
            --export`) or `.zip` of Stable-Baselines3, which can run code while it is loaded.
        env_id: Id of the environment; None: from the training record.
        keywords: Keywords of the environment; None: from the training record.
        normalization: As in `load_policy`; the exported controller contains it.

    Raises:
        ValueError: If the policy does not exist, is no multilayer perceptron, has no training
            record while `env_id` is None, or does not fit the environment; or its record names
            modules or files, which are used only if `env_id` or `keywords` name them.
        ImportError: If a `.zip` is to be loaded and Stable-Baselines3 is not installed.
    """
    if policy == "pd" or policy.startswith("pd:"):
        raise ValueError(f"policy must be a trained network, got {policy!r}")
    if is_included(policy) and env_id is None:
        raise ValueError(f"policy {policy} needs an ENV_ID: several tasks have one")
    if env_id is not None:
        keywords_of(env_id)  # rejects unknown ids
    file = pretrained_file(env_id, policy) if is_included(policy) and env_id else Path(policy)
    if not file.exists():
        meant = check.did_you_mean(policy, ("pretrained", "filter"))
        raise ValueError(f"there is no policy {file}{meant}")
    if file.suffix not in (".npz", ".zip"):
        raise ValueError(f"policy must be pretrained, or a .npz or .zip file, got {policy!r}")
    record: dict[str, Any] = {}  # in a .npz, or next to a .zip
    if file.suffix == ".npz":
        record = MlpPolicy.load(file).record
    elif (stored := file.parent / "training.json").exists():
        record = record_of(stored)
    plan = record.get("plan", {})
    if env_id is None:
        if "env_id" not in plan:
            raise ValueError(f"{file} has no training record with an ENV_ID: specify ENV_ID")
        env_id = plan["env_id"]
        _require_no_module(file, "ENV_ID", env_id)
    if keywords is None:
        keywords = plan.get("environment", {}) if plan.get("env_id") == env_id else {}
        for name, value in keywords.items():
            _require_no_module(file, f"--env {name}", value)
            if name not in ("task", "estimator"):  # which name modules
                _require_no_file(file, f"--env {name}", value)
    env = gymnasium.make_vec(env_id, num_envs=1, threads=1, **keywords)
    try:
        found: Any = load_policy(str(file), env, normalization)
        flights = env.unwrapped.flights  # type: ignore[attr-defined]
        if not isinstance(env.single_observation_space, gymnasium.spaces.Box):
            raise ValueError(
                f"{file} observes the truth (privileged=True), which no vehicle can measure"
            )
        batch = flights.batch
        params = params_record(batch.vehicle, batch.sensors, action_params=batch.action_params)[0]
        controller = Controller(
            policy=_network_of(found, record),
            source=policy if is_included(policy) else file.name,
            env_id=env_id,
            keywords=dict(keywords),
            table=flights.table,
            action=flights.action,
            action_fields=action_fields(flights.action, params),
            control_rate=flights.control_rate,
        )
    finally:
        env.close()
    _require_same(controller, found, file)
    return controller


def _network_of(found: Any, record: Mapping[str, Any]) -> MlpPolicy:
    """Network of a policy, with its normalization."""
    statistics = None
    if isinstance(found, NormalizedPolicy):
        found, statistics = found.model, found.normalization
    if not isinstance(found, MlpPolicy):
        return mlp_of(found, record, statistics)
    if statistics is None:
        return found
    layers = found.weights, found.biases, found.activations
    return MlpPolicy(*layers, found.record, statistics)


def _require_no_file(file: Path, what: str, value: Any) -> None:
    """Refuse a path in a training record: the error of a reader would show its contents."""
    for name in value if isinstance(value, list | tuple) else (value,):
        if isinstance(name, str) and (Path(name).suffix or len(Path(name).parts) > 1):
            raise ValueError(
                f"{file} names a file, {name}: if you trust it, specify {what} yourself"
            )


def _require_no_module(file: Path, what: str, name: Any) -> None:
    """Refuse a module of others in a training record: importing it would run its code."""
    ours = isinstance(name, str) and name.partition(".")[0] in _OUR_PACKAGES
    if isinstance(name, str) and ":" in name and not ours:
        raise ValueError(f"{file} names a module, {name}: if you trust it, specify {what} yourself")


def _require_same(controller: Controller, model: Any, file: Path) -> None:
    """Reject a network that is only a part of the policy, as with a feature extractor."""
    low, high = controller.bounds
    seen = np.clip(controller.samples(256, np.random.default_rng(0)), low, high)
    error = np.abs(controller.policy.predict(seen)[0] - model.predict(seen, deterministic=True)[0])
    if not error.max() <= _AGREEMENT:
        raise ValueError(f"{file} is not a plain network: its layers alone act differently")
