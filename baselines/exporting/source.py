"""Controllers as one C99 file: weights, bounds and one function, for any compiler."""

import re
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

import quad_gym
from baselines.exporting.controller import Controller

_ACTIVATIONS = {
    "none": "x",
    "relu": "x > 0.0f ? x : 0.0f",
    "tanh": "tanhf(x)",
    "elu": "x > 0.0f ? x : expm1f(x)",
}

_DOT = """\
static float dot(const float *w, const float *x, int n)
{
    float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f;

    for (; n >= 4; n -= 4, w += 4, x += 4) {
        s0 += w[0] * x[0];
        s1 += w[1] * x[1];
        s2 += w[2] * x[2];
        s3 += w[3] * x[3];
    }
    for (; n > 0; n--)
        s0 += *w++ * *x++;
    return (s0 + s1) + (s2 + s3);
}
"""
"""Dot product with four partial sums, which have smaller rounding errors than one."""


def c_source(controller: Controller, name: str) -> str:
    """Generate C99 code of a controller that requires only the math library.

    It has no state and allocates no memory; arithmetic is single precision, as on processors of
    autopilots.

    Args:
        controller: Controller to convert.
        name: Name of the function.

    Returns:
        Text of the file.

    Raises:
        ValueError: If `name` is not a C identifier.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"name must be a C identifier, got {name!r}")
    policy = controller.policy
    low, high = controller.bounds
    widest = max(len(b) for b in policy.biases)
    parts = [
        _comment(controller, name),
        "#include <math.h>\n",
        *(
            _array(f"{kind}{i}", values)
            for i, (W, b) in enumerate(zip(policy.weights, policy.biases, strict=True))
            for kind, values in (("W", W), ("b", b))
        ),
        _array("low", low),
        _array("high", high),
        _DOT,
        _function(controller, name, widest),
    ]
    return "\n".join(parts)


def observation_lines(controller: Controller) -> Iterator[str]:
    """Describe each part of an observation: indices, name, unit, frame."""
    rows = []
    for field in controller.table:
        last = field.slice.stop - 1
        where = f"[{field.slice.start}..{last}]" if last > field.slice.start else f"[{last}]"
        rows.append((where, field.name, field.unit, field.frame))
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()


def about(controller: Controller) -> str:
    """Origin of a controller: policy, environment and version."""
    keywords = "".join(f" {key}={value}" for key, value in controller.keywords.items())
    return f"{controller.source}, {controller.env_id}{keywords}; quad_gym {quad_gym.__version__}"


def _comment(controller: Controller, name: str) -> str:
    lines = [
        f"Controller of a quadrotor: {about(controller)}",
        "",
        f"int {name}(const float observation[{controller.policy.inputs}], float action[4])",
        "",
        "returns 0, or 1 with an action of zeros if the observation is not finite.",
        f"Call it {controller.control_rate:g} times per second.",
        "",
        "Observation (SI units; I: inertial, east, north, up; B: body, x ahead, y left, z up;",
        "values are clipped to the bounds low and high below):",
        *(f"  {line}" for line in observation_lines(controller)),
        "",
        "Action, each component a in [-1, 1]:",
        *(f"  {field.formula(i)}" for i, field in enumerate(controller.action_fields)),
    ]
    return "/*\n" + "".join(f" * {line}".rstrip() + "\n" for line in lines) + " */\n"


def _number(value: float) -> str:
    """Format a float so that C reads the same bits."""
    text = f"{np.float32(value):.9g}"
    return text + ("f" if set(text) & set(".e") else ".0f")


def _rows(numbers: Iterable[float]) -> str:
    words = [_number(value) for value in numbers]
    lines = [", ".join(words[k : k + 6]) for k in range(0, len(words), 6)]
    return "{\n    " + ",\n    ".join(lines) + "\n}"


def _array(name: str, values: NDArray[np.float32]) -> str:
    """Define a constant array; matrices are stored row by row."""
    return f"static const float {name}[{values.size}] = {_rows(values.ravel().tolist())};\n"


def _function(controller: Controller, name: str, widest: int) -> str:
    policy = controller.policy
    text = f"int {name}(const float observation[{policy.inputs}], float action[4])\n{{\n"
    text += f"    float in[{max(widest, policy.inputs)}], out[{widest}];\n    int i;\n\n"
    text += "    for (i = 0; i < 4; i++)\n        action[i] = 0.0f;\n"
    text += f"    for (i = 0; i < {policy.inputs}; i++) {{\n"
    text += "        const float x = observation[i];\n"
    text += "        if (!isfinite(x))\n            return 1;\n"
    text += "        in[i] = x < low[i] ? low[i] : x > high[i] ? high[i] : x;\n    }\n"
    for k, (W, activation) in enumerate(zip(policy.weights, policy.activations, strict=True)):
        outputs, inputs = W.shape
        text += f"    for (i = 0; i < {outputs}; i++) {{\n"
        text += f"        const float x = b{k}[i] + dot(W{k} + {inputs} * i, in, {inputs});\n"
        text += f"        out[i] = {_ACTIVATIONS[activation]};\n    }}\n"
        if k + 1 < len(policy.weights):
            text += f"    for (i = 0; i < {outputs}; i++)\n        in[i] = out[i];\n"
    text += "    for (i = 0; i < 4; i++)\n"
    text += "        action[i] = out[i] < -1.0f ? -1.0f : out[i] > 1.0f ? 1.0f : out[i];\n"
    return text + "    return 0;\n}\n"
