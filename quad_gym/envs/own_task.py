"""From the keyword `task` to flights with a user-defined task."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quad_gym.configuration import FlightConfiguration
from quad_gym.envs.spaces import PRIVILEGED_NAMES, ObservationField, policy_size
from quad_gym.tasks.batch import LaidTask, Part, TaskBatch
from quad_gym.tasks.task import ObservationSpec, Task, resolve_task

Table = tuple[ObservationField, ...]


def laid_over(tasks: Sequence[Any]) -> Task:
    """Make one task of several, of which each is laid over the one before it.

    A task that derives from the class of the one before it takes its place.
    """
    found = resolve_task(tasks[0])
    for given in tasks[1:]:
        over = resolve_task(given)
        base = type(found.over if isinstance(found, LaidTask) else found)
        if base is not Task and isinstance(over, base):
            found = LaidTask(over, found.base) if isinstance(found, LaidTask) else over
        else:
            found = LaidTask(over, found)
    return found


def batch_with_task(
    given: Sequence[Any], c: FlightConfiguration, table: Table
) -> tuple[TaskBatch, Table]:
    """Make the flights with user-defined tasks; return them, and their observation's table.

    `given` are tasks, each of which is laid over the one before it.
    The parts that `observe` returns are found by calling it once, with a flight made for the
    purpose. Parts with names of built-in parts are refused.
    """
    task = laid_over(given)
    task._require(c.sensors, c.world)
    split = policy_size(table)
    if not task.has("observe"):
        return TaskBatch(c, own_task=task, split=split), table
    first = TaskBatch(replace(c, count=1, threads=1), own_task=task, split=split)
    first.reset(keys=np.zeros((1, 2), np.uint64))
    sizes = {name: part.shape[1] for name, part in first.ask_parts().items()}
    unknown = sorted(set(task.observes) - set(sizes))
    if unknown:
        raise ValueError(f"observes has {unknown[0]!r}, which observe does not return")
    kept = tuple(
        field
        for field in table
        if field.slice.stop <= split and (not task.replaces_observation or field.name in task.keeps)
    )
    rest = tuple(f for f in table if f.slice.start >= split)
    taken = ({field.name for field in (*kept, *rest)} | PRIVILEGED_NAMES) & set(sizes)
    if taken:
        raise ValueError(f"observe must not return {min(taken)!r}, a name of a built-in part")
    described = {name: task.observes.get(name, ObservationSpec()) for name in sizes}
    own = [ObservationField(name, slice(0, sizes[name]), *described[name]) for name in sizes]
    parts = {n: Part(sizes[n], described[n].low, described[n].high) for n in sizes}
    new, place = [], 0
    for field in (*kept, *own, *rest):
        size = field.slice.stop - field.slice.start
        new.append(field._replace(slice=slice(place, place + size)))
        place += size
    if not new:
        raise ValueError("observe must return something where it replaces the observation")
    columns = [k for field in kept for k in range(field.slice.start, field.slice.stop)]
    batch = TaskBatch(c, own_task=task, split=split, parts=parts, kept=columns)
    return batch, tuple(new)
