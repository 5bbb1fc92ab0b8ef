"""Controllers as one C99 file: weights, bounds and one function, for any compiler."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import quad_gym
from baselines.exporting.controller import Controller
from baselines.mlp import MlpPolicy

_ACTIVATIONS = {
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
        layers += f"        out[i] = {_ACTIVATIONS[policy.activations[k]]};\n    }}\n"
        if k + 1 < len(policy.weights):
            layers += f"    for (i = 0; i < {outputs}; i++)\n        in[i] = out[i];\n"
    arrays |= {"low": low, "high": high}
    more = _normalization(policy)
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


def _normalization(policy: MlpPolicy) -> dict[str, Any]:
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
