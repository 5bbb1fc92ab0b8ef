"""Controllers as ONNX models, checked with onnxruntime against the policy."""

import json
from pathlib import Path
from typing import Any

import numpy as np

import quad_gym
from baselines.exporting.controller import Controller
from baselines.gru import GruPolicy
from quad_gym.params import checks as check

OPSET = 17  #: version of the operator set, old enough for runtimes on companion computers
_IR_VERSION = 8  #: corresponding version of the file format

AGREEMENT = 1e-4
"""Largest difference accepted between actions of the model and of the policy; saturated actions are
differences of large sums."""

_ACTIVATIONS = {"relu": "Relu", "tanh": "Tanh", "elu": "Elu"}


def onnx_model(controller: Controller) -> Any:
    """Convert a controller to an `onnx.ModelProto`, from `observation` (batch, n) to `action`.

    A recurrent policy also has the input `memory` (batch, units), zeros at the start of a flight,
    and the output `next_memory`. The metadata describe observation and action, as JSON.
    """
    onnx = check.package("onnx", "ONNX", "export")
    from onnx import TensorProto, helper, numpy_helper

    low, high = controller.bounds
    constants = {"low": low, "high": high, "least": np.float32(-1.0), "most": np.float32(1.0)}
    nodes = [
        helper.make_node("Max", ["observation", "low"], ["above"]),
        helper.make_node("Min", ["above", "high"], ["x0"]),
    ]
    sizes_in, sizes_out = {"observation": controller.policy.inputs}, {"action": 4}
    if (gru := controller.gru) is not None:
        sizes_in["memory"] = sizes_out["next_memory"] = gru.units
        constants |= _gru_constants(gru)
        nodes[1] = helper.make_node("Min", ["above", "high"], ["within"])
        nodes += [
            helper.make_node("Unsqueeze", ["within", "time"], ["sequence"]),
            helper.make_node("Unsqueeze", ["memory", "time"], ["before"]),
            helper.make_node(
                "GRU",
                ["sequence", "W", "U", "biases", "", "before"],
                ["", "after"],
                hidden_size=gru.units,
                linear_before_reset=1,
            ),
            helper.make_node("Squeeze", ["after", "time"], ["next_memory"]),
            helper.make_node("Concat", ["within", "next_memory"], ["x0"], axis=1),
        ]
    policy = controller.layers
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
    given, wanted = {"observation": seen}, [controller.act(seen)]
    if controller.gru is not None:
        shape = (len(seen), controller.gru.units)
        given["memory"] = np.random.default_rng(1).uniform(-1.0, 1.0, shape).astype(np.float32)
        wanted = list(controller.step(seen, given["memory"]))
    found = session.run(None, given)
    error = max(float(np.abs(a - b).max()) for a, b in zip(found, wanted, strict=True))
    if not error <= AGREEMENT:
        raise RuntimeError(f"the ONNX model's actions differ from the policy's by {error:.1e}")
    file.write_bytes(content)
    return error


def _gru_constants(gru: GruPolicy) -> dict[str, Any]:
    """Constants of the operator GRU, whose gates have the order update, reset, candidate."""
    k = gru.units
    order = np.r_[k : 2 * k, :k, 2 * k : 3 * k]
    biases = np.concatenate([gru.b[order], gru.c[order]])
    return {
        "time": np.array([0]),
        **{"W": gru.W[np.newaxis, order], "U": gru.U[np.newaxis, order]},
        "biases": biases[np.newaxis],
    }


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
