"""Controllers as ONNX models, checked with onnxruntime against the policy."""

import json
from pathlib import Path
from typing import Any

import numpy as np

import quad_gym
from baselines.exporting.controller import Controller
from baselines.normalization import Normalization
from quad_gym.params import checks as check

OPSET = 17  #: version of the operator set, old enough for runtimes on companion computers
_IR_VERSION = 8  #: corresponding version of the file format

AGREEMENT = 1e-4
"""Largest difference accepted between actions of the model and of the policy; saturated actions are
differences of large sums."""

_ACTIVATIONS = {"relu": "Relu", "tanh": "Tanh", "elu": "Elu"}


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
        more, steps = _normalization(controller.policy.normalization)
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
            nodes.append(helper.make_node(_ACTIVATIONS[activation], [linear], [f"x{k + 1}"]))
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


def _normalization(found: Normalization) -> tuple[dict[str, Any], list[Any]]:
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
