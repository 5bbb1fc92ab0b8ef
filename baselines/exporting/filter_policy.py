"""A policy for an exported filter: its observation from the estimate, as text of C sources."""

import re
from typing import NamedTuple

from baselines.exporting.controller import Controller
from baselines.exporting.source import about, c_source, observation_lines

_SIGMAS = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
_FIELDS = {
    "position_error": "o = qgi_seen(o, e.R_BI, reference->position, e.position);",
    "velocity_error": "o = qgi_seen(o, e.R_BI, reference->velocity, e.velocity);",
    "up": "o = qgi_seen(o, e.R_BI, up, zero);",
    "heading": "o = qgi_seen(o, e.R_BI, reference->heading, zero);",
    "body_rates": "for (int i = 0; i < 3; i++)\n"
    "        *o++ = (float)(f->gyro[i] - e.gyro_bias[i]);",
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

_API = """
/* ---- policy: ABOUT ---- */

typedef struct {
    double position[3], velocity[3], acceleration[3]; /* of the reference, in I */
    double heading[3];    /* level unit vector in I along which body x is to point */
    double preview[2][3]; /* positions 0.2 s and 0.4 s later, in I; on a course: the next gates */
} qg_reference;

/* Action of the policy for the present estimate, RATE times per second. Observation:
LINES
 *
 * Action, each component a in [-1, 1]:
ACTIONS */
int qg_action(qg_filter *filter, const qg_reference *reference, float action[4]);

/* The network alone: 0, or 1 with an action of zeros if the observation is not finite. */
int qg_policy(const float observation[SIZE], float action[4]);
"""

_SOURCE = """
static float *qgi_seen(float *o, const double R[9], const double x[3], const double y[3])
{
    for (int i = 0; i < 3; i++)
        *o++ = (float)(R[3 * i] * (x[0] - y[0]) + R[3 * i + 1] * (x[1] - y[1]) +
                       R[3 * i + 2] * (x[2] - y[2]));
    return o;
}

int qg_action(qg_filter *f, const qg_reference *reference, float action[4])
{
    static const double zero[3] = {0.0, 0.0, 0.0}, up[3] = {0.0, 0.0, 1.0};
    float observation[SIZE], *o = observation, found[4];
    qg_estimate e;
    if (qg_state(f, &e) != QG_OK || !f->has_gyro)
        return QG_NOT_STARTED;
    (void)zero, (void)up;
    FIELDS
    if (qg_policy(observation, found))
        return QG_NOT_FINITE;
    for (int i = 0; i < 4; i++)
        action[i] = f->last_action[i] = found[i];
    return QG_OK;
}
"""


class PolicySources(NamedTuple):
    """Text for the header of an exported filter; empty without a policy."""

    declarations: str = ""
    network: str = ""
    """code that does not need the filter"""
    action: str = ""
    """code after the filter's"""


def policy_sources(controller: Controller) -> PolicySources:
    """Return the text for a policy.

    Raises:
        ValueError: If its observation has parts that do not follow from the estimate.
    """
    names = [field.name for field in controller.table]
    unknown = [name for name in names if name not in _FIELDS]
    frames = {field.name: field.frame for field in controller.table}
    if unknown or frames.get("preview_1", "B") != "B":
        raise ValueError(
            "policy must have observation='estimate' and layout='relative' to be exported with a "
            f"filter, got an observation of {', '.join(unknown or names)}"
        )
    size = controller.policy.inputs
    values = {
        "ABOUT": about(controller),
        "RATE": f"{controller.control_rate:g}",
        "LINES": "\n".join(f" *   {line}" for line in observation_lines(controller)),
        "ACTIONS": "\n".join(
            f" *   {field.formula(i)}" for i, field in enumerate(controller.action_fields)
        ),
        "SIZE": str(size),
        "FIELDS": "\n    ".join(_FIELDS[name] for name in names),
    }

    def filled(text: str) -> str:
        return re.sub(
            r"\b(ABOUT|RATE|LINES|ACTIONS|SIZE|FIELDS)\b", lambda found: values[found[1]], text
        )

    network = re.sub(r"\b([Wb]\d+|low|high|dot)\b", r"qgi_\1", c_source(controller, "qg_policy"))
    return PolicySources(filled(_API), network, filled(_SOURCE))
