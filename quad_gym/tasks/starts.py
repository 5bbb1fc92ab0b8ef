"""Start values that `reset` of a task returns."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.starts import checked_start
from quad_gym.params.task import TaskParams
from quad_gym.params.world import WorldParams
from quad_gym.tasks import answers
from quad_gym.tasks.task import Task, TaskError, label

Start = dict[str, Any]

_SHAPES: dict[str, tuple[int, ...]] = {"position": (3,), "velocity": (3,), "yaw": ()}
"""Start values that `reset` may return, with the shapes of their rows."""


def starts(
    task: Task,
    returned: Any,
    chosen: NDArray[np.bool_],
    given: Start,
    params: TaskParams,
    world: WorldParams,
) -> Start:
    """Combine start values that `reset` of a task returns with `given` ones, which take precedence.

    Rows of flights that are not `chosen` (n,) to begin an episode are ignored.
    """
    if not isinstance(returned, Mapping) or not set(returned) <= set(_SHAPES):
        raise TaskError(
            f"{label(task)}.reset must return None or a dictionary with any of "
            f"{', '.join(_SHAPES)}; got {returned!r}"
        )
    count, found = len(chosen), {name: given.get(name) for name in _SHAPES}
    for name, value in returned.items():
        values = answers.numbers(task, "reset", value, name)
        shape = (count, *_SHAPES[name])
        if values.shape not in (shape, _SHAPES[name]):
            raise TaskError(
                f"{label(task)}.reset must return shape {shape} for {name!r}, got {values.shape}"
            )
        rows = np.zeros(shape)
        rows[chosen] = np.broadcast_to(values, shape)[chosen]
        sound = np.asarray(np.isfinite(rows).reshape(count, -1).all(axis=1))
        answers.require(sound, task, "reset", rows, f"finite numbers for {name!r}")
        if given.get(name) is None:
            found[name] = rows
    try:
        checked_start(count, **found, task=params, world=world, chosen=chosen)
    except ValueError as error:
        raise TaskError(f"{label(task)}.reset returned an invalid start: {error}") from None
    return found
