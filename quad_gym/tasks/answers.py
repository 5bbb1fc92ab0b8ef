"""Checks of the return values of a task's methods; errors name the method and the flights."""

from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.resets import checked_start
from quad_gym.params.checks import did_you_mean
from quad_gym.params.task import TaskParams
from quad_gym.params.world import WorldParams
from quad_gym.records.state import State
from quad_gym.tasks.fields import Group
from quad_gym.tasks.task import Task, TaskError, label
from quad_gym.tasks.view import VIEW_FIELDS, View

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

LONE = "observed"
"""Name in the table of observations for an array that `observe` returns without a name."""

Start = dict[str, Any]

_SHAPES: dict[str, tuple[int, ...]] = {"position": (3,), "velocity": (3,), "yaw": ()}
"""Start values that `reset` may return, with the shapes of their rows."""


def ask(task: Task, method: str, *arguments: Any) -> Any:
    """Call a task's method; an exception that it raises becomes the cause of a TaskError."""
    try:
        return getattr(task, method)(*arguments)
    except Exception as error:
        raise TaskError(
            f"{label(task)}.{method} failed, for all flights: {type(error).__name__}: {error}"
            + _meant(error)
        ) from error


def _meant(error: Exception) -> str:
    """Suggestion of an attribute's name, for the end of a message about one that is missing."""
    if not isinstance(error, AttributeError) or error.name is None:
        return ""
    if not isinstance(error.obj, Group | State):
        return ""  # attributes of users' objects may have side effects
    if isinstance(error.obj, Group):  # in another group?
        for field in VIEW_FIELDS:
            if field.name.rpartition(".")[2] == error.name:
                return f"; did you mean view.{field.name}?"
    return did_you_mean(error.name, [name for name in dir(error.obj) if name[0] != "_"])


def numbers(task: Task, method: str, value: Any, name: str = "") -> NDArray[Any]:
    """Convert a return value to an array of numbers."""
    try:
        found = np.asarray(value)
    except (TypeError, ValueError):
        found = np.array(None)
    if found.dtype.kind not in "fiub":
        _refuse(task, method, f"numbers{_of(name)}", _short(value))
    return found


def reward_terms(task: Task, view: View) -> dict[str, Floats]:
    """Terms of a task's reward, (n,) each, which may still be NaN or infinite."""
    value = ask(task, "reward", view)
    if not isinstance(value, Mapping):
        return {"reward": _reward(task, value, view.count)}
    if not value:
        _refuse(task, "reward", "at least one term", "none")
    return {str(name): _reward(task, term, view.count, str(name)) for name, term in value.items()}


def _reward(task: Task, value: Any, count: int, name: str = "") -> Floats:
    """Reward, or its term with this name, (n,)."""
    found = numbers(task, "reward", value, name)
    if found.shape != (count,):
        must = f"shape ({count},), one number per flight{_of(name)}"
        _refuse(task, "reward", must, found.shape)
    return found.astype(np.float64)


def truths(task: Task, method: str, view: View) -> Truths:
    """Boolean values that a method returns, (n,)."""
    found = numbers(task, method, ask(task, method, view))
    if found.dtype.kind != "b" or found.shape != (view.count,):
        must = f"booleans of shape ({view.count},)"
        _refuse(task, method, must, f"{found.dtype} of {found.shape}")
    return found


def parts(task: Task, value: Any, count: int) -> dict[str, NDArray[Any]]:
    """Convert the return value of `observe` to (n, k) arrays by name, in its order."""
    named = value if isinstance(value, Mapping) else {LONE: value}
    found = {}
    for name, part in named.items():
        array = numbers(task, "observe", part, str(name))
        if array.ndim not in (1, 2) or len(array) != count:
            must = f"shape ({count},) or ({count}, k){_of(str(name))}"
            _refuse(task, "observe", must, array.shape)
        found[str(name)] = array[:, np.newaxis] if array.ndim == 1 else array
    return found


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
        values = numbers(task, "reset", value, name)
        shape = (count, *_SHAPES[name])
        if values.shape not in (shape, _SHAPES[name]):
            _refuse(task, "reset", f"shape {shape} for {name!r}", values.shape)
        rows = np.zeros(shape)
        rows[chosen] = np.broadcast_to(values, shape)[chosen]
        sound = np.asarray(np.isfinite(rows).reshape(count, -1).all(axis=1))
        require(sound, task, "reset", rows, f"finite numbers for {name!r}")
        if given.get(name) is None:
            found[name] = rows
    try:
        checked_start(count, **found, task=params, world=world, chosen=chosen)
    except ValueError as error:
        raise TaskError(f"{label(task)}.reset returned an invalid start: {error}") from None
    return found


def require(sound: Truths, task: Task, method: str, values: NDArray[Any], required: str) -> None:
    """Reject values (n, ...) of flights that are not sound, (n,)."""
    wrong = np.flatnonzero(~sound)
    if wrong.size:
        got = f"{_short(values[wrong[0]])} for {flights_named(wrong)}"
        _refuse(task, method, required, got)


def flights_named(flights: NDArray[np.intp]) -> str:
    """List flights by number, at most five."""
    first = ", ".join(str(i) for i in flights[:5])
    more = f" and {len(flights) - 5} more" if len(flights) > 5 else ""
    return f"flight {first}" if len(flights) == 1 else f"flights {first}{more}"


def _refuse(task: Task, method: str, must: str, got: Any) -> NoReturn:
    """Raise a TaskError for what a method has returned."""
    raise TaskError(f"{label(task)}.{method} must return {must}, got {got}")


def _of(name: str) -> str:
    return f" for {name!r}" if name and name != LONE else ""


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
