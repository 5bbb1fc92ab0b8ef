"""Results of a step for every flight."""

from enum import IntEnum

from quad_gym.records.enums import RewardTerm


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
