"""Results of a step for every flight, and fields that only the views of users' tasks need."""

from enum import IntEnum
from math import prod

from quad_gym.records.enums import RewardTerm
from quad_gym.records.sizes import Field


class Result(IntEnum):
    """Rows of the results of a step."""

    REWARD = 0
    TERMINATED = 1
    TRUNCATED = 2
    ENDING = 3
    POSITION_ERROR = 4
    ESTIMATION_ERROR = 5
    FILTER_STATUS = 6
    EPISODE_STEPS = 7
    EPISODE_RETURN = 8
    EPISODE_ERROR_SUM = 9
    GATES_PASSED = 10
    FAULTS = 11
    FILTER_DIVERGED = 12


RESULTS = (
    *(result.name.lower() for result in Result),
    *(f"reward_{term.name.lower()}" for term in RewardTerm),
)
"""Names of the rows of the results of a step, with the terms of the reward last."""

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
    Field("preview", (2, 3), "m", "reference later, or the gates after the next, in I"),
)
"""Fields for views, computed at the end of a step."""

SHOWN: dict[str, slice] = {}  #: rows of each field, by its name
SHOWN_SIZE = 0  #: number of rows
for _field in SHOWN_FIELDS:
    SHOWN[_field.name] = slice(SHOWN_SIZE, SHOWN_SIZE + prod(_field.shape))
    SHOWN_SIZE = SHOWN[_field.name].stop
SHOWN_SHAPES = {field.name: field.shape for field in SHOWN_FIELDS}
"""Shape of each field, by its name."""
