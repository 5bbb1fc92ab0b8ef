"""`Controller`: a trained network with all information for running it as C99 or ONNX."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

import quad_gym
from baselines.mlp import MlpPolicy, mlp_of
from baselines.normalization import Normalization, NormalizedPolicy
from baselines.policies import is_included, load_policy, pretrained_file, record_of
from quad_gym.envs import keywords_of
from quad_gym.envs.config import env_option
from quad_gym.envs.spaces import ObservationField, layout_bounds
from quad_gym.packing import params_record
from quad_gym.params import checks as check

# --------------------------------------------------------------------------------------------------
# `Controller`: a trained network with all information for running it elsewhere.
# --------------------------------------------------------------------------------------------------

_OUR_PACKAGES = ("quad_gym", "baselines")  #: packages that are imported already
_AGREEMENT = 1e-4
"""Largest difference accepted between a network and the policy that it represents."""


class ActionField(NamedTuple):
    """Component a of an action: `quantity = offset + scale a`, limited to `most`."""

    name: str  #: name of the quantity, such as "thrust"
    offset: float  #: quantity for a = 0 [unit]
    scale: float  #: change of the quantity per unit of a [unit]
    unit: str  #: unit of the quantity
    frame: str
    """Frame. B: body; H: level, x along the body's heading, y to its left, z up; "-": none"""
    most: float | None = None  #: limit on the magnitude of the quantity [unit]; None: no limit

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
            ActionField(f"voltage of rotor {i}", hover, hover, "V", "-", most) for i in range(4)
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
    policy: str | Path,
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
    policy = str(policy)
    if policy == "pd" or policy.startswith("pd:"):
        raise ValueError(f"policy must be a trained network, got {policy!r}")
    if is_included(policy) and env_id is None:
        raise ValueError(f"policy {policy} needs an ENV_ID: several tasks have one")
    if env_id is not None:
        keywords_of(env_id)  # rejects unknown ids
    file = pretrained_file(env_id, policy) if is_included(policy) and env_id else Path(policy)
    if not file.exists():
        meant = check.did_you_mean(policy, ("pretrained", "filter"))
        raise ValueError(f"policy file not found: {file}{meant}")
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
        # keywords that are given replace all of the record, so a user must name all of them
        given = env_option(keywords).lstrip()
        for name, value in keywords.items():
            _require_no_module(file, given, value)
            if name not in ("task", "estimator"):  # which name modules
                _require_no_file(file, given, value)
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


# --------------------------------------------------------------------------------------------------
# Controllers as one C99 file: weights, bounds and one function, for any compiler.
# --------------------------------------------------------------------------------------------------

_ACTIVATIONS_IN_C = {
    "none": "x",
    "relu": "x > 0.0f ? x : 0.0f",
    "tanh": "tanhf(x)",
    "elu": "x > 0.0f ? x : expm1f(x)",
}


def filled(name: str, values: Mapping[str, Any]) -> str:
    """Template with the values of its @NAMES@; @IF NAME@ to @END@ is left out for a false value."""
    text = (Path(__file__).parent / "templates" / name).read_text(encoding="utf-8")
    text = re.sub(
        r"@IF (\w+)@\n(.*?)@END@\n", lambda m: m[2] if values[m[1]] else "", text, flags=re.DOTALL
    )
    return re.sub(r"@([A-Z_]+)@", lambda m: str(values[m[1]]), text)


def c_source(controller: Controller, name: str) -> str:
    """Generate C99 code of a controller that requires only the math library.

    It has no static state and allocates no memory; arithmetic is single precision, as on processors
    of autopilots. `name` of the function must be a C identifier.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"name must be a C identifier, got {name!r}")
    policy, (low, high) = controller.policy, controller.bounds
    arrays: dict[str, NDArray[Any]] = {}
    layers = ""
    for k, (W, b) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays |= {f"W{k}": W, f"b{k}": b}
        outputs, inputs = W.shape
        layers += f"    for (i = 0; i < {outputs}; i++) {{\n"
        layers += f"        const float x = b{k}[i] + dot(W{k} + {inputs} * i, in, {inputs});\n"
        layers += f"        out[i] = {_ACTIVATIONS_IN_C[policy.activations[k]]};\n    }}\n"
        if k + 1 < len(policy.weights):
            layers += f"    for (i = 0; i < {outputs}; i++)\n        in[i] = out[i];\n"
    arrays |= {"low": low, "high": high}
    more = _normalization_in_c(policy)
    if policy.normalization is not None:
        arrays |= {"mean": policy.normalization.mean, "deviation": policy.normalization.deviation}
    widest = max(len(b) for b in policy.biases)
    values = {
        **descriptions(controller),
        **more,
        "NAME": name,
        "ARRAYS": "\n".join(_array(name, values) for name, values in arrays.items()),
        "LAYERS": layers,
        "LONGEST": max(widest, policy.inputs),
        "WIDEST": widest,
    }
    return filled("controller.c", values)


def _normalization_in_c(policy: MlpPolicy) -> dict[str, Any]:
    """Values of the template that normalize observations, in the type of the statistics."""
    found = policy.normalization
    if found is None:
        return {"NORMALIZED": False}
    clip = _number(found.mean.dtype.type(found.clip)) if np.isfinite(found.clip) else ""
    limited = f"z < -{clip} ? -{clip} : z > {clip} ? {clip} : z" if clip else "z"
    return {"NORMALIZED": True, "KIND": _kind(found.mean), "LIMITED": limited}


def descriptions(controller: Controller) -> dict[str, Any]:
    """Origin, rate, observation and action of a controller, as values of templates."""
    keywords = "".join(f" {key}={value}" for key, value in controller.keywords.items())
    rows = []
    for field in controller.table:
        first, last = field.slice.start, field.slice.stop - 1
        where = f"[{first}..{last}]" if last > first else f"[{last}]"
        rows.append((where, field.name, field.unit, field.frame))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)
    actions = (field.formula(i) for i, field in enumerate(controller.action_fields))
    return {
        "ABOUT": f"{controller.source}, {controller.env_id}{keywords}; "
        f"quad_gym {quad_gym.__version__}",
        "RATE": f"{controller.control_rate:g}",
        "SIZE": controller.policy.inputs,
        "LINES": "\n".join(f" *   {line}" for line in lines),
        "ACTIONS": "\n".join(f" *   {action}" for action in actions),
    }


def _kind(values: NDArray[Any]) -> str:
    """Type of numbers in C."""
    return "double" if values.dtype == np.float64 else "float"


def _number(value: np.floating[Any]) -> str:
    """Format a number of single or double precision so that C reads the same bits."""
    wide = value.dtype == np.float64
    text = f"{value:.17g}" if wide else f"{value:.9g}"
    return text + ("" if set(text) & set(".e") else ".0") + ("" if wide else "f")


def _array(name: str, values: NDArray[Any]) -> str:
    """Define a constant array; matrices are stored row by row."""
    words = [_number(value) for value in values.ravel()]
    lines = [", ".join(words[k : k + 6]) for k in range(0, values.size, 6)]
    rows = ",\n    ".join(lines)
    return f"static const {_kind(values)} {name}[{values.size}] = {{\n    {rows}\n}};\n"


# --------------------------------------------------------------------------------------------------
# Controllers as ONNX models, checked with onnxruntime against the policy.
# --------------------------------------------------------------------------------------------------

OPSET = 17  #: version of the operator set, old enough for runtimes on companion computers
_IR_VERSION = 8  #: corresponding version of the file format

AGREEMENT = 1e-4
"""Largest difference accepted between actions of the model and of the policy; saturated actions are
differences of large sums."""

_ACTIVATIONS_IN_ONNX = {"relu": "Relu", "tanh": "Tanh", "elu": "Elu"}


def onnx_model(controller: Controller) -> Any:
    """Convert a controller to an `onnx.ModelProto`, from `observation` (batch, n) to `action`.

    The metadata describe observation and action, as JSON.
    """
    onnx = check.package("onnx", "ONNX", "export")
    from onnx import TensorProto, helper, numpy_helper

    low, high = controller.bounds
    constants = {"low": low, "high": high, "least": np.float32(-1.0), "most": np.float32(1.0)}
    nodes = [
        helper.make_node("Max", ["observation", "low"], ["above"]),
        helper.make_node("Min", ["above", "high"], ["x0"]),
    ]
    if controller.policy.normalization is not None:
        more, steps = _normalization_in_onnx(controller.policy.normalization)
        constants |= more
        nodes[-1] = helper.make_node("Min", ["above", "high"], ["within"])
        nodes += [helper.make_node(kind, *names, **said) for kind, *names, said in steps]
    sizes_in, sizes_out = {"observation": controller.policy.inputs}, {"action": 4}
    policy = controller.policy
    layers = zip(policy.weights, policy.biases, policy.activations, strict=True)
    for k, (W, b, activation) in enumerate(layers):
        constants |= {f"W{k}": W, f"b{k}": b}
        linear = f"x{k + 1}" if activation == "none" else f"z{k}"
        nodes.append(helper.make_node("Gemm", [f"x{k}", f"W{k}", f"b{k}"], [linear], transB=1))
        if activation != "none":
            nodes.append(
                helper.make_node(_ACTIVATIONS_IN_ONNX[activation], [linear], [f"x{k + 1}"])
            )
    last = f"x{len(policy.weights)}"
    nodes.append(helper.make_node("Clip", [last, "least", "most"], ["action"]))
    inputs, outputs = (
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
            for name, size in sizes.items()
        ]
        for sizes in (sizes_in, sizes_out)
    )
    arrays = {name: np.asarray(value) for name, value in constants.items()}
    stored = [numpy_helper.from_array(value, name) for name, value in arrays.items()]
    graph = helper.make_graph(nodes, "controller", inputs, outputs, stored)
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=_IR_VERSION,
        producer_name="quad_gym",
        producer_version=quad_gym.__version__,
    )
    helper.set_model_props(model, {k: json.dumps(v) for k, v in _metadata(controller).items()})
    onnx.checker.check_model(model, full_check=True)
    return model


def _normalization_in_onnx(found: Normalization) -> tuple[dict[str, Any], list[Any]]:
    """Constants and nodes that normalize "within" to "x0", in the type of the statistics."""
    from onnx import TensorProto

    kind = found.mean.dtype.type
    wide = TensorProto.DOUBLE if found.mean.dtype == np.float64 else TensorProto.FLOAT
    constants = {
        "mean": found.mean,
        "deviation": found.deviation.astype(kind),
        "lowest": kind(-found.clip),
        "highest": kind(found.clip),
    }
    return constants, [
        ("Cast", ["within"], ["wide"], {"to": wide}),
        ("Sub", ["wide", "mean"], ["centered"], {}),
        ("Div", ["centered", "deviation"], ["scaled"], {}),
        ("Max", ["scaled", "lowest"], ["above_lowest"], {}),
        ("Min", ["above_lowest", "highest"], ["normalized"], {}),
        ("Cast", ["normalized"], ["x0"], {"to": TensorProto.FLOAT}),
    ]


def save_onnx(controller: Controller, file: Path) -> float:
    """Write a controller as ONNX, after a comparison with the policy in onnxruntime.

    Returns:
        Largest difference of an action over 1,000 observations.

    Raises:
        RuntimeError: If the actions of model and policy differ.
    """
    content = onnx_model(controller).SerializeToString()
    runtime = check.package("onnxruntime", "ONNX", "export")
    session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
    seen = controller.samples(1000, np.random.default_rng(0))
    (found,) = session.run(None, {"observation": seen})
    error = float(np.abs(found - controller.act(seen)).max())
    if not error <= AGREEMENT:
        raise RuntimeError(f"the ONNX model's actions differ from the policy's by {error:.1e}")
    file.write_bytes(content)
    return error


def _metadata(controller: Controller) -> dict[str, Any]:
    return {
        "source": controller.source,
        "env_id": controller.env_id,
        "control_rate_hz": controller.control_rate,
        "action_kind": controller.action,
        "observation": [
            {
                "name": f.name,
                "first": f.slice.start,
                "size": f.slice.stop - f.slice.start,
                "unit": f.unit,
                "frame": f.frame,
            }
            for f in controller.table
        ],
        "action": [field.formula(i) for i, field in enumerate(controller.action_fields)],
    }
