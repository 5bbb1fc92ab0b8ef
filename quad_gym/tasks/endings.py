"""Which flights a user's task terminates and truncates, and why."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.records import Ending, Result
from quad_gym.tasks import answers

if TYPE_CHECKING:
    from quad_gym.tasks.batch import TaskBatch

Truths = NDArray[np.bool_]

_TASK = float(Ending.TASK)


def endings(flights: "TaskBatch") -> dict[Result, NDArray[Any]]:
    """What the task says of the ends of episodes, as results; nothing where none ends.

    Raises:
        TaskError: If its methods fail.
    """
    asked = {m: _asked(flights, m) for m in ("terminated", "truncated") if m in flights.methods}
    nobody = not any(np.count_nonzero(value) for value in asked.values())
    if nobody and not np.count_nonzero(flights.judged_over):
        return {}  # almost always
    shipped = flights.view.shipped
    terminated = asked.get("terminated", shipped.terminated)
    if "terminated" in asked:
        spared = shipped.terminated & ~terminated
        if spared.any():  # but nobody flies on in a state that is no more
            terminated = terminated | (spared & ~flights.finite(spared))
    truncated = asked.get("truncated", shipped.truncated)
    if flights.began_some:
        terminated, truncated = terminated & ~flights.began, truncated & ~flights.began
    truncated = truncated & ~terminated
    over = terminated | truncated
    why = np.where(terminated & shipped.terminated, shipped.ending, _TASK)
    why = np.where(truncated & shipped.truncated, _cut(flights), why)
    return {
        Result.TERMINATED: terminated.astype(np.float64),
        Result.TRUNCATED: truncated.astype(np.float64),
        Result.ENDING: np.where(over, why, 0.0),
    }


def _asked(flights: "TaskBatch", method: str) -> Truths:
    value = answers.ask(flights.custom, method, flights.view)
    return answers.truths(flights.custom, method, value, flights.count)


def _cut(flights: "TaskBatch") -> NDArray[np.float64]:
    """Why an episode would be truncated, also of one that is terminated."""
    why = np.full(flights.count, float(Ending.TIME_LIMIT))
    if flights.task.end_when_lost:
        why[flights.result("filter_lost") > 0.0] = float(Ending.FILTER_LOST)
    why[flights.result("filter_status") > 0.0] = float(Ending.FILTER_FAILED)
    return why
