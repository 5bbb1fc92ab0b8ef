"""Fields that only the views of user-defined tasks need, computed at the end of a step."""

from math import prod

from quad_gym.records.sizes import Field

SHOWN_FIELDS = (
    Field("R_BI", (3, 3), "-", "true attitude"),
    Field("position_gap", (3,), "m", "reference minus observed position, in B"),
    Field("velocity_gap", (3,), "m/s", "reference minus observed velocity, in B"),
    Field("up", (3,), "-", "observed vertical in B"),
    Field("heading", (3,), "-", "reference heading in B"),
    Field("w_seen", (3,), "rad/s", "observed body rates in B"),
    Field("acceleration", (3,), "m/s^2", "reference acceleration in B"),
    Field("ahead", (2, 3), "m", "preview minus reference position, in B"),
    Field("r_ref", (3,), "m", "reference position in I"),
    Field("v_ref", (3,), "m/s", "reference velocity in I"),
    Field("a_ref", (3,), "m/s^2", "reference acceleration in I"),
    Field("x_ref", (3,), "-", "reference heading in I"),
    Field(
        "preview", (2, 3), "m", "reference at two later times, or the gates after the next, in I"
    ),
)

SHOWN: dict[str, slice] = {}  # rows of each field, by its name
SHOWN_SIZE = 0  # number of rows
for _field in SHOWN_FIELDS:
    SHOWN[_field.name] = slice(SHOWN_SIZE, SHOWN_SIZE + prod(_field.shape))
    SHOWN_SIZE = SHOWN[_field.name].stop
SHOWN_SHAPES = {field.name: field.shape for field in SHOWN_FIELDS}
"""Shape of each field, by its name."""
