"""From the keywords of an environment to its flights: the same for all three interfaces."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.references import check_in_bounds, check_pad
from quad_gym.batch.resets import checked_start
from quad_gym.envs.benchmarks import BENCHMARKS
from quad_gym.envs.effects import require_effect, require_own_task, runs_no_sensor
from quad_gym.envs.keywords import DEFAULTS, TASK_KEYWORDS
from quad_gym.envs.spaces import (
    ACTIONS,
    LAYOUTS,
    OBSERVATIONS,
    ObservationField,
    layout_bounds,
    observation_layout,
    observation_space,
    policy_size,
)
from quad_gym.faults import Fault
from quad_gym.faults.presets import needs_sensors
from quad_gym.packing.configuration import MAX_FLIGHTS, FlightConfiguration
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.suites import given_suite
from quad_gym.params.task import TaskParams, check_limit
from quad_gym.params.world import WorldParams
from quad_gym.records import Autoreset, Layout

if TYPE_CHECKING:
    from quad_gym.tasks import Task

TASK_DEFAULTS: dict[str, TaskParams] = {
    # with bounds of 3 m, SAC overestimates the value of places that it no longer visits, and drifts
    # there; hovering starts are within 1.56 m
    "hover": TaskParams(kind="hover", start="hover", out_of_bounds=1.6),
    # plain PPO learns from "mixed"; from "ground" alone, the report's, no episode gets anywhere
    "circle": TaskParams(kind="circle", start="mixed"),
    "lemniscate": TaskParams(kind="lemniscate", start="hover", radius=3.0),
    "random_trajectory": TaskParams(
        kind="random_trajectory",
        start="hover",
        radius=2.5,
        height=2.0,
        period=12.0,
        randomize_reference=True,
    ),
    "waypoints": TaskParams(
        kind="waypoints", start="hover", radius=3.5, height=1.5, duration=20.0, out_of_bounds=12.0
    ),
    "trajectory": TaskParams(kind="trajectory", start="hover"),
}
"""Defaults of each task, which keywords override."""

SLOWEST = 1.0  #: least control rate [Hz]: smaller ones are periods
MAX_STEPS = 10**9  #: longest time limit in steps; a duration of 0 has none


Own: TypeAlias = "Task | type[Task] | str"
"""A user-defined task: an instance, its class, or "module:name" of either."""
Base: TypeAlias = "str | tuple[str, Own]"
"""Kind of task, or, for an id of `register_task`, that kind and the task laid over it."""


def kind_and_tasks(task: "Own | None", base: "Base | None") -> "tuple[str, tuple[Own, ...]]":
    """Return the kind of task that is flown, and the tasks laid over it, the last one on top."""
    kinds = (*TASK_DEFAULTS, *BENCHMARKS)
    registered: tuple[Own, ...] = ()
    if isinstance(base, tuple | list) and len(base) == 2:
        base, registered = base[0], (base[1],)
    kind = "circle" if base is None else check.choice("base", base, kinds)
    if not isinstance(task, str) or ":" in task:
        return kind, registered if task is None else (*registered, task)
    if base is None and task in kinds:
        return task, ()
    if task in kinds:
        raise ValueError(
            f'task must be a quad_gym.Task, or its "module:name", where an id or base names the '
            f"kind {kind}, got {task!r}: choose the id of {task} instead"
        )
    raise ValueError(
        f'task must be one of {", ".join(kinds)}, or a quad_gym.Task, or its "module:name", got '
        f"{task!r}{check.did_you_mean(task, kinds)}"
    )


class Flights:
    """The flights behind an environment, with its observation's table; see `QuadEnv`."""

    def __init__(
        self,
        task: "Own | None",
        count: int,
        autoreset: Autoreset,
        *,
        base: "Base | None" = None,
        **keywords: Any,
    ) -> None:
        check.whole("num_envs", count, most=MAX_FLIGHTS)
        name, tasks = kind_and_tasks(task, base)
        self.name = name
        defaults, own = BENCHMARKS.get(name) or (TASK_DEFAULTS[name], {})
        given = {name: keywords.pop(name) for name in TASK_KEYWORDS if name in keywords}
        given = {name: value for name, value in given.items() if value is not None}
        require_own_task(given, name, defaults.kind, own_reward=bool(own))
        self.task: TaskParams = defaults.replace(**given)
        if "pad" in given and not self.task.may_start_on_ground:
            raise ValueError(
                f'pad has no effect with start="{self.task.start}", and must not be given'
            )
        if "trajectory" in given and "duration" not in given:  # all of it, or a round
            longest = max(path.duration for path in self.task.trajectories)
            self.task = self.task.replace(duration=longest)
        asked = frozenset(keywords)
        keywords = {**DEFAULTS, **own, **keywords}
        if "task" in own:
            tasks = (own["task"], *tasks)
        keywords["task"] = tasks
        if "faults" in own and keywords["faults"] is own["faults"] and runs_no_sensor(keywords):
            keywords["faults"] = None  # the task's own, which would have no effect
        steps = keywords.pop("max_episode_steps", None)
        if steps is not None:
            steps = check.whole("max_episode_steps", steps, most=MAX_STEPS)
        if steps is not None and "duration" not in given:  # in place of the task's own limit
            rate = check.positive("control_rate", keywords["control_rate"], least=SLOWEST)
            self.task = self.task.replace(duration=steps / rate)
        require_effect(asked, keywords)
        self._build(count, autoreset, asked, keywords)
        if steps is not None:
            self.batch.limit(min(steps, self.batch.max_steps or steps))

    def _build(
        self, count: int, autoreset: Autoreset, asked: Collection[str], keywords: dict[str, Any]
    ) -> None:
        """Make the flights and their observation's table; `asked`: keywords given by the user."""
        check.choice("observation", keywords["observation"], tuple(OBSERVATIONS))
        check.choice("action", keywords["action"], tuple(ACTIONS))
        check.choice("layout", keywords["layout"], tuple(LAYOUTS))
        for name in ("camera", "include_std", "privileged", "reward_terms"):
            check.flag(name, keywords[name])
        self.observation, self.action = keywords["observation"], keywords["action"]
        self.layout, self.reward_terms = keywords["layout"], keywords["reward_terms"]
        self.control_rate = check.positive("control_rate", keywords["control_rate"], least=SLOWEST)
        check_limit(self.task, self.control_rate, "control_rate")
        raw, tasks = self.observation == "measurements", keywords["task"]
        flown = {name: value for name, value in keywords.items() if name not in _NOT_OF_BATCH}
        flown["sensors"] = _suite(keywords, "camera" in asked)
        c = FlightConfiguration(
            count,
            **flown,
            estimator=own_estimator(keywords["estimator"]),
            task=self.task,
            source=OBSERVATIONS[self.observation],
            control=ACTIONS[self.action],
            layout=Layout.MEASUREMENTS if raw else LAYOUTS[self.layout],
            autoreset=autoreset,
        )
        drawn = c.randomization.names
        if c.world.ground is None and not tasks and "start_position_I" not in drawn:
            check_pad(self.task)  # a user-defined task may set where vehicles start
        _require_sensors(c.possible_faults, keywords)
        self.table: tuple[ObservationField, ...] = observation_layout(
            self.observation,
            None if raw else self.layout,
            sensors=c.sensors,
            include_std=c.include_std,
            privileged=c.privileged,
            drawn=(drawn if drawn or c.world != WorldParams() else None) if c.privileged else None,
        )
        c = replace(c, bounds=layout_bounds(self.table))
        if not tasks:
            self.batch = FlightBatch(c)  # type: ignore[arg-type]
        else:
            from quad_gym.envs.own_task import batch_with_task

            self.batch, self.table = batch_with_task(tasks, c, self.table)
        self.space = observation_space(self.table)
        self.policy_size = policy_size(self.table) if c.privileged else None

    def start(self, options: dict[str, Any] | None) -> dict[str, Any]:
        """The start values in the options of a reset, checked before anything changes."""
        chosen = start_options(options)
        position, velocity, yaw = (chosen.get(name) for name in ("position", "velocity", "yaw"))
        count, world = self.batch.count, self.batch.world
        given = checked_start(count, position, velocity, yaw, self.task, world)
        ends_by_itself = "terminated" in getattr(self.batch, "methods", ())  # a user's task
        if position is not None and given is not None and not ends_by_itself:
            check_in_bounds(self.task, given[:, :3])
        return chosen

    def split(self, observations: NDArray[np.float32]) -> Any:
        """Observations (..., n) as the space wants them: an array, or a Dict of parts."""
        if self.policy_size is None:
            return observations
        return {
            "policy": observations[..., : self.policy_size].copy(),
            "privileged": observations[..., self.policy_size :].copy(),
        }


_NOT_OF_BATCH = ("observation", "action", "layout", "task", "camera", "estimator", "reward_terms")
"""Keywords of environments that determine keywords of `FlightBatch`."""


def _suite(keywords: Mapping[str, Any], camera_is_wanted: bool) -> SensorSuite:
    """Return the sensor suite that the keywords `sensors`, `camera` and `estimator` select."""
    sensors, estimator = keywords["sensors"], keywords["estimator"]
    suite = given_suite("sensors", sensors)
    if not keywords["camera"]:
        suite = suite.replace(camera=None)
    elif camera_is_wanted and suite.camera is None:
        raise ValueError(f"camera must not be True: the sensors {sensors!r} have none")
    if estimator is None or own_estimator(estimator) is not None:
        return suite
    check.choice("estimator", estimator, ("ukf", "ekf"))
    return suite.replace(estimator=suite.estimator.replace(kind=estimator))


def own_estimator(given: Any) -> Any:
    """Return a user's estimator; None for the names of built-in ones."""
    return given if not isinstance(given, str) or ":" in given else None


def _require_sensors(faults: Collection[Fault], keywords: Mapping[str, Any]) -> None:
    """Refuse faults of sensors if none runs."""
    of_sensors = [fault for fault in faults if needs_sensors(fault)]
    if of_sensors and runs_no_sensor(keywords):
        raise ValueError(
            f"faults must concern simulated parts: {type(of_sensors[0]).__name__} concerns "
            f'sensors, and none runs with observation="{keywords["observation"]}" (unless '
            "include_std or innovations ask for the filter)"
        )


def checked_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Actions as finite floats of a shape, clipped to [-1, 1]."""
    if _in_order(actions, shape):
        return actions
    try:
        given = np.asarray(actions)
    except ValueError:
        raise ValueError(f"action must be {shape} numbers, got {actions!r}") from None
    if given.dtype.kind not in "biuf" or np.ma.is_masked(actions):
        raise ValueError(f"action must be {shape} numbers, got {actions!r}")
    numbers = given.astype(np.float64)
    if numbers.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise ValueError("action must be finite: it contains NaN or infinity")
    return numbers.clip(-1.0, 1.0)


def _in_order(actions: Any, shape: tuple[int, ...]) -> bool:
    """Return True if actions need no check and no clipping; NaN and infinity always do."""
    if not (type(actions) is np.ndarray and actions.dtype.kind == "f" and actions.shape == shape):
        return False
    if actions.ndim == 1:  # a few numbers are sooner looked at than handed to NumPy
        return all(-1.0 <= number <= 1.0 for number in actions.tolist())
    return bool(actions.max() <= 1.0 and actions.min() >= -1.0)


def named_options(options: Any) -> dict[str, Any]:
    """A copy of the options of a reset, which are by name; none for None."""
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options must be values by name, or None, got {options!r}")
    return dict(options or {})


def start_options(options: dict[str, Any] | None) -> dict[str, Any]:
    """The start values in the options of a reset."""
    chosen = named_options(options)
    known = ("position", "velocity", "yaw")
    unknown = sorted(set(chosen) - set(known))
    if unknown:
        raise ValueError(f"options may contain {', '.join(known)}, got {unknown[0]!r}")
    return chosen
