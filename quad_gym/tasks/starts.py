"""Where a task's `reset` lets episodes start."""

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
"""What `reset` may return, with the shapes of its rows."""


def starts(
    task: Task,
    returned: Any,
    chosen: NDArray[np.bool_],
    given: Start,
    params: TaskParams,
    world: WorldParams,
) -> Start:
    """Start values that a task's `reset` returned, beside those that a caller has given.

    Args:
        task: Whose.
        returned: By its `reset`.
        chosen: (n,) which flights begin an episode; the rows of the others do not count.
        given: What the caller has given, which comes first; None: nothing.
        params: Of the id's task.
        world: Says what stands in the way.

    Returns:
        "position", "velocity", "yaw", as `FlightBatch.reset` takes them.

    Raises:
        TaskError: If something is wrong with them.
    """
    if not isinstance(returned, Mapping) or not set(returned) <= set(_SHAPES):
        raise TaskError(
            f"{label(task)}.reset must return None or start values by name, of "
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
        raise TaskError(f"{label(task)}.reset returned a wrong start: {error}") from None
    return found
