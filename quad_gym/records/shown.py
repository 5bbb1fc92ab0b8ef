"""What a user's task is shown of a flight at the end of a step: a row for each number."""

from math import prod

import numpy as np

from quad_gym.records.sizes import Field

# fmt: off
SHOWN_FIELDS = (
    Field("time", (), "s", "since the start of the episode"),
    Field("r", (3,), "m", "true position in I"),
    Field("v", (3,), "m/s", "true velocity in I"),
    Field("q", (4,), "-", "true attitude, body to inertial"),
    Field("w", (3,), "rad/s", "true body rates in B"),
    Field("R_BI", (3, 3), "-", "true attitude"),
    Field("r_seen", (3,), "m", "position in I from the controller's source"),
    Field("v_seen", (3,), "m/s", "velocity in I from the controller's source"),
    Field("R_seen", (3, 3), "-", "attitude R_BI from the controller's source"),
    Field("position_gap", (3,), "m", "reference less seen position, in B"),
    Field("velocity_gap", (3,), "m/s", "reference less seen velocity, in B"),
    Field("up", (3,), "-", "the vertical in B, as seen"),
    Field("heading", (3,), "-", "reference heading in B, as seen"),
    Field("w_seen", (3,), "rad/s", "body rates in B from the controller's source"),
    Field("acceleration", (3,), "m/s^2", "reference acceleration in B, as seen"),
    Field("ahead", (2, 3), "m", "preview less reference position, in B, as seen"),
    Field("action", (4,), "-", "the present action"),
    Field("last_action", (4,), "-", "the action before it"),
    Field("r_ref", (3,), "m", "reference position in I"),
    Field("v_ref", (3,), "m/s", "reference velocity in I"),
    Field("a_ref", (3,), "m/s^2", "reference acceleration in I"),
    Field("x_ref", (3,), "-", "reference heading in I"),
    Field("preview", (2, 3), "m", "the reference a little later, or the gates after the next, in I"),
    Field("position_error", (), "m", "distance of the true position from the reference"),
    Field("gate_next", (), "-", "gates passed so far"),
    # whole numbers come last
    Field("step", (), "steps", "since the start of the episode", "i8"),
    Field("filter_status", (), "bits", "failures so far, see FilterStatus", "i8"),
)
# fmt: on

SHOWN: dict[str, slice] = {}
"""The rows of each field."""
for _field in SHOWN_FIELDS:
    _first = max((rows.stop for rows in SHOWN.values()), default=0)
    SHOWN[_field.name] = slice(_first, _first + prod(_field.shape))
SHOWN_SIZE = max(rows.stop for rows in SHOWN.values())
"""Rows, numbers that are shown."""
SHOWN_FLOATS = sum(prod(field.shape) for field in SHOWN_FIELDS if field.kind == "f8")
"""How many rows are float64; those after them are int64."""
for _field in SHOWN_FIELDS:
    assert (_field.kind == "f8") == (SHOWN[_field.name].stop <= SHOWN_FLOATS), _field.name
SHOWN_SHAPES = {field.name: field.shape for field in SHOWN_FIELDS}
"""The shape of each field."""
SHOWN_KINDS = {field.name: np.dtype(field.kind) for field in SHOWN_FIELDS}
"""The type of each field's numbers."""
