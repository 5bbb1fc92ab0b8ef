"""A policy for an exported filter: its observation from the estimate, as text of C sources."""

import re
from typing import Any

from baselines.exporting.controller import Controller
from baselines.exporting.source import c_source, descriptions

_SIGMAS = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
_FIELDS = {
    "position_error": "o = qgi_seen(o, e.R_BI, reference->position, e.position);",
    "velocity_error": "o = qgi_seen(o, e.R_BI, reference->velocity, e.velocity);",
    "up": "o = qgi_seen(o, e.R_BI, up, zero);",
    "heading": "o = qgi_seen(o, e.R_BI, reference->heading, zero);",
    "body_rates": "for (int i = 0; i < 3; i++)\n"
    "        *o++ = (float)(f->window.gyro[i] - e.gyro_bias[i]);",
    "reference_acceleration": "o = qgi_seen(o, e.R_BI, reference->acceleration, zero);",
    "preview_1": "o = qgi_seen(o, e.R_BI, reference->preview[0], reference->position);",
    "preview_2": "o = qgi_seen(o, e.R_BI, reference->preview[1], reference->position);",
    "last_action": "for (int i = 0; i < 4; i++)\n        *o++ = f->last_action[i];",
    **{
        f"{name}_sigma": f"for (int i = {3 * k}; i < {3 * k + 3}; i++)\n"
        "        *o++ = (float)e.sigma[i];"
        for k, name in enumerate(_SIGMAS)
    },
}
"""C code that writes each part of an observation."""


def policy_values(controller: Controller) -> dict[str, Any]:
    """Return the values of a policy for the templates of an exported filter.

    Raises a ValueError if its observation has parts that do not follow from the estimate.
    """
    names = [field.name for field in controller.table]
    unknown = [name for name in names if name not in _FIELDS]
    frames = {field.name: field.frame for field in controller.table}
    if unknown or frames.get("preview_1", "B") != "B":
        raise ValueError(
            "policy must have observation='estimate' and layout='relative' to be exported with a "
            f"filter, got an observation of {', '.join(unknown or names)}"
        )
    network = re.sub(
        r"\b([Wb]\d+|low|high|mean|deviation|dot)\b", r"qgi_\1", c_source(controller, "qg_policy")
    )
    fields = "\n    ".join(_FIELDS[name] for name in names)
    return {**descriptions(controller), "POLICY": True, "FIELDS": fields, "NETWORK": network}
