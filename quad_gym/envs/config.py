"""`EnvConfig`: all that the keywords of an environment say, checked, nested by subject.

A keyword is a field of one of its parts, under the same name, or a field of `TaskParams`. A keyword
that is not given has the value of the id's task, otherwise the default here. What has no effect
with the others, `params/task.py` and `configuration.py` know. `QuadEnv` explains each keyword.
"""

import inspect
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NamedTuple,
    Self,
    TypeAlias,
    TypedDict,
    TypeVar,
)

import numpy as np

from quad_gym.configuration import FILTER_ARGUMENTS, FlightConfiguration
from quad_gym.envs.spaces import ACTIONS, LAYOUTS, OBSERVATIONS
from quad_gym.faults import FaultsGiven, GnssOutage, felt_without_sensors
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, show
from quad_gym.params.randomization import Given, Randomization
from quad_gym.params.suites import SensorSuite, given_suite
from quad_gym.params.task import RewardParams, TaskParams, check_limit, fields_without_effect
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.vehicle import ActionParams, VehicleParams
from quad_gym.params.world import WorldParams

if TYPE_CHECKING:
    from quad_gym.batch.own_estimator import Estimator
    from quad_gym.tasks import Task


# --------------------------------------------------------------------------------------------------
# Benchmark tasks: each is a built-in reference with its own sensors and `Task`.
# --------------------------------------------------------------------------------------------------


class Benchmark(NamedTuple):
    """Definition of a benchmark task; keywords override it."""

    task: TaskParams  #: reference and bounds of the task
    keywords: Mapping[str, Any]  #: keywords of the environment


BENCHMARKS = {
    "look_around": Benchmark(
        TaskParams(
            kind="random_trajectory",
            start="hover",
            radius=2.5,
            height=2.0,
            period=12.0,
            randomize_reference=True,
            duration=15.0,  # the estimate of a vehicle that never looks has diverged by then
            out_of_bounds=8.0,  # room for errors of the estimate, and for recovery
            min_height=-5.0,
        ),
        {"sensors": "one_wall", "task": "quad_gym.tasks.look_around:LookAround"},
    ),
    "stale_race": Benchmark(
        TaskParams(
            kind="waypoints",
            start="hover",
            radius=3.5,
            height=1.5,
            duration=20.0,
            out_of_bounds=12.0,
            gate_count=8,
            gate_radius=0.6,  # several times the delay error of the measurements at racing speed
        ),
        {"sensors": "stale", "task": "quad_gym.tasks.stale_race:StaleRace"},
    ),
    "outage_dash": Benchmark(
        TaskParams(
            kind="hover",
            start="hover",
            radius=60.0,  # the start of the course, which leads through the origin
            height=4.0,
            duration=90.0,  # 27 s at the rewarded speed, and as long in outages
            out_of_bounds=300.0,
            min_height=0.0,
        ),
        {
            "sensors": "consumer",
            "action": "velocity",  # the decision is how far to go on, not how to stay upright
            "control_rate": 10.0,
            "world": "slalom",
            "faults": (GnssOutage(rate=0.1, duration=(5.0, 15.0)),),  # waiting once is no answer
            "task": "quad_gym.tasks.outage_dash:OutageDash",
        },
    ),
}
"""Benchmark tasks by name."""


# --------------------------------------------------------------------------------------------------
# `EnvConfig`: all that the keywords of an environment say, checked, nested by subject.
# --------------------------------------------------------------------------------------------------

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

TASK_KEYWORDS = tuple(field.name for field in fields(TaskParams) if field.name != "kind")
"""Names of the keywords that are fields of `TaskParams`."""

SLOWEST = 1.0  #: least control rate [Hz]: smaller ones are periods
MAX_STEPS = 10**9  #: longest time limit in steps; a duration of 0 has none

Own: TypeAlias = "Task | type[Task] | str"
"""A user-defined task: an instance, its class, or "module:name" of either."""
Base: TypeAlias = "str | tuple[str, Own]"
"""Kind of task, or, for an id of `register_task`, that kind and the task laid over it."""

_BATCH: dict[str, Any] = {field.name: field.default for field in fields(FlightConfiguration)}


class ObservationConfig(Checked, bare=True):
    """The controller's input, and contents of `info`."""

    observation: Annotated[str, partial(check.choice, choices=tuple(OBSERVATIONS))] = "estimate"
    layout: Annotated[str, partial(check.choice, choices=tuple(LAYOUTS))] = "relative"
    include_std: bool = _BATCH["include_std"]
    privileged: bool = _BATCH["privileged"]
    innovations: bool = _BATCH["innovations"]
    reward_terms: bool = False


class VehicleConfig(Checked, bare=True):
    """The vehicle, and the meaning of an action."""

    action: Annotated[str, partial(check.choice, choices=tuple(ACTIONS))] = "ctbr"
    vehicle: Any = _BATCH["vehicle"]
    true_vehicle: Any = _BATCH["true_vehicle"]
    action_params: Any = _BATCH["action_params"]
    control_rate: Annotated[float, partial(check.positive, least=SLOWEST)] = 50.0
    action_delay: Any = _BATCH["action_delay"]
    substeps: Any = _BATCH["substeps"]


class SensorsConfig(Checked, bare=True):
    """The sensors, as the filter assumes them and as they are, and whether they have to run."""

    sensors: Any = _BATCH["sensors"]
    true_sensors: Any = _BATCH["true_sensors"]
    camera: bool = True
    run_filter: Any = _BATCH["run_filter"]


class FilterConfig(Checked, bare=True):
    """The filter."""

    estimator: Any = None
    filter_start: Any = _BATCH["filter_start"]


class WorldConfig(Checked, bare=True):
    """The world, differences between episodes, and faults."""

    world: Any = _BATCH["world"]
    randomization: Any = _BATCH["randomization"]
    faults: Any = _BATCH["faults"]


class RenderingConfig(Checked, bare=True):
    """Frames; these need a `render_mode`."""

    render_view: Any = None
    render_size: Any = None


_PARTS = (
    ObservationConfig,
    SensorsConfig,
    FilterConfig,
    VehicleConfig,
    WorldConfig,
    RenderingConfig,
)

DEFAULTS: dict[str, Any] = {field.name: field.default for part in _PARTS for field in fields(part)}
"""Defaults of keywords that the id's task does not set; None for all others."""


class EnvConfig(Checked, eq=False, bare=True):
    """Configuration of an environment. `EnvConfig.of` makes one of keywords.

    Raises:
        ValueError: If a value is invalid, or has no effect with the others.
    """

    name: str
    """the id's task"""
    tasks: tuple[Any, ...]
    """tasks in Python that are laid over it, the last one on top"""
    task: TaskParams
    observation: ObservationConfig
    sensors: SensorsConfig
    filter: FilterConfig
    vehicle: VehicleConfig
    world: WorldConfig
    rendering: RenderingConfig
    max_steps: int | None
    """time limit in steps, in addition to the task's duration; None: none"""
    asked: Mapping[str, Any]
    """the given keywords, except those of the task and None"""

    @classmethod
    def of(
        cls,
        keywords: Mapping[str, Any],
        task: "Own | None" = None,
        base: "Base | None" = None,
        others: Sequence[str] = (),
    ) -> Self:
        """Return the configuration of keywords, of which `QuadEnv` explains each.

        Args:
            keywords: Keywords of an environment.
            task: A kind of task, or a task in Python.
            base: Kind of task of the id, or, for an id of `register_task`, that kind and its task.
            others: Further arguments of the environment, for which an unknown keyword may stand.

        Raises:
            TypeError: If a keyword is unknown; the exception is also a ValueError.
            ValueError: If a value is invalid, or has no effect with the others.
        """
        require_known(keywords, others)
        name, tasks = kind_and_tasks(task, base)
        defaults, own = BENCHMARKS.get(name) or (TASK_DEFAULTS[name], {})
        of_task = {n: keywords[n] for n in TASK_KEYWORDS if keywords.get(n) is not None}
        params = defaults.replace(**of_task)
        without = fields_without_effect(params)
        if own:
            without["reward_params"] = f"on the task {name}, whose class has weights of its own"
        check.effect(of_task, without)
        if "trajectory" in of_task and "duration" not in of_task:  # all of it, or a round
            longest = max(path.duration for path in params.trajectories)
            params = params.replace(duration=longest)
        rest = {n: value for n, value in keywords.items() if n not in TASK_KEYWORDS}
        steps = rest.pop("max_episode_steps", None)
        given = {**own, **rest}
        if "task" in given:
            tasks = (given.pop("task"), *tasks)
        if "faults" in own and given["faults"] is own["faults"] and runs_no_sensor(given):
            given["faults"] = None  # the task's own, which would have no effect
        vehicle = _part(VehicleConfig, given)
        if steps is not None:
            steps = check.whole("max_episode_steps", steps, most=MAX_STEPS)
            limit = steps / vehicle.control_rate  # in place of the task's, unless that was given
            params = params.replace(duration=min(limit, of_task.get("duration") or limit))
        return cls(
            name=name,
            tasks=tasks,
            task=params,
            observation=_part(ObservationConfig, given),
            sensors=_part(SensorsConfig, given),
            filter=_part(FilterConfig, given),
            vehicle=vehicle,
            world=_part(WorldConfig, given),
            rendering=_part(RenderingConfig, given),
            max_steps=steps,
            asked={n: value for n, value in rest.items() if value is not None},
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_limit(self.task, self.vehicle.control_rate, "control_rate")

    @property
    def described(self) -> dict[str, Any]:
        """Every keyword with its value, by parts, for records of what was flown."""
        parts = {name: vars(part) for name, part in vars(self).items() if isinstance(part, Checked)}
        return {
            "name": self.name,
            "tasks": self.tasks,
            "max_episode_steps": self.max_steps,
            **parts,
        }


def require_known(given: Mapping[str, Any], others: Sequence[str] = ()) -> None:
    """Refuse unknown keywords; one of them may stand for one of `others`, too."""
    known = (*DEFAULTS, "max_episode_steps", *TASK_KEYWORDS, "task", "base", *others)
    for name in ("threads", "render_flights"):
        if name in given and name not in known:
            raise check.UnknownKeywordError(
                f"{name} is not a keyword of a single environment, which has one (unexpected "
                f"keyword argument '{name}'); gymnasium.make_vec takes it"
            )
    check.keywords(given, known, "environments")


Part = TypeVar("Part", bound=Checked)


def _part(kind: type[Part], given: Mapping[str, Any]) -> Part:
    """Return a part of a configuration, with the fields among the given keywords."""
    return kind(**{field.name: given[field.name] for field in fields(kind) if field.name in given})


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


def runs_no_sensor(keywords: Mapping[str, Any]) -> bool:
    """Return True if an environment with these keywords simulates no sensor."""
    flags = (keywords.get(name) for name in ("run_filter", "include_std", "innovations"))
    asked = any(isinstance(flag, bool | np.bool_) and flag for flag in flags)
    return keywords.get("observation") in ("truth", "noisy") and not asked


def with_effect(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Remove keywords of a filter that does not run, and faults of sensors that are not used.

    Comparisons use the same keywords for several observations, but environments reject keywords
    that have no effect.
    """
    idle = FILTER_ARGUMENTS if runs_no_sensor(keywords) else ()
    kept = {name: value for name, value in keywords.items() if name not in idle}
    if keywords.get("observation") in ("truth", "noisy") and {"faults", "sensors"} <= set(kept):
        kept["faults"] = felt_without_sensors(
            kept["faults"], given_suite("sensors", kept["sensors"])
        )
    return kept


def own_estimator(given: Any) -> Any:
    """Return a user's estimator; None for the names of built-in ones."""
    return given if not isinstance(given, str) or ":" in given else None


# --------------------------------------------------------------------------------------------------
# Types of the keywords, and the signatures that show them.
#
# `EnvKeywords` is the only list of them. Type checkers and editors read it from `**keywords` of the
# interfaces, `inspect.signature` and `help` from the signatures that `shows` makes of it.
# --------------------------------------------------------------------------------------------------

Observation: TypeAlias = Literal["estimate", "truth", "noisy", "measurements"]


class TaskKeywords(TypedDict, total=False):
    """Fields of `quad_gym.TaskParams`; None: the value of the id's task."""

    radius: float | None
    period: float | None
    height: float | None
    start: Literal["ground", "hover", "mixed", "moving"] | None
    pad: bool | None
    reward_per: Literal["step", "second"] | None
    reward_params: RewardParams | None
    randomize_reference: bool | None
    duration: float | None
    out_of_bounds: float | None
    min_height: float | None
    truncate_when_diverged: bool | None
    max_tilt: float | None
    max_speed: float | None
    max_acceleration: float | None
    gate_count: int | None
    gate_radius: float | None
    preview: Sequence[float] | None
    trajectory: Trajectory | str | Path | Sequence[Trajectory | str | Path] | None


class EnvKeywords(TaskKeywords, total=False):
    """Keywords of every environment, which `quad_gym.QuadEnv` explains."""

    observation: Observation
    action: Literal["ctbr", "motor", "wrench", "attitude", "velocity"]
    layout: Literal["relative", "absolute"]
    include_std: bool
    privileged: bool
    sensors: SensorSuite | str
    run_filter: bool | None
    innovations: bool
    reward_terms: bool
    vehicle: VehicleParams | str
    action_params: ActionParams | None
    camera: bool
    estimator: "Literal['ukf', 'ekf'] | Estimator | type[Estimator] | str | None"
    filter_start: Literal["cold", "warm"]
    control_rate: float
    action_delay: float
    substeps: int
    max_episode_steps: int | None
    true_vehicle: VehicleParams | None
    true_sensors: SensorSuite | None
    world: WorldParams | str
    randomization: Randomization | Mapping[str, Given] | None
    faults: FaultsGiven
    render_view: Literal["fixed", "chase"] | None
    render_size: tuple[int, int] | None


class VectorKeywords(EnvKeywords, total=False):
    """Keywords of `make_sb3_vec_env`: of every environment, and of vector environments."""

    task: "Task | type[Task] | str | None"
    threads: int | None
    render_mode: Literal["human", "rgb_array"] | None
    render_flights: Sequence[int] | None


def types_of(keywords: type) -> dict[str, Any]:
    """Return the types of the keywords of a TypedDict by name, the most general ones first."""
    types = dict(inspect.get_annotations(keywords))
    return {name: types[name] for name in sorted(types, key=lambda name: name in TASK_KEYWORDS)}


F = TypeVar("F", bound=Callable[..., Any])


def shows(keywords: type) -> Callable[[F], F]:
    """Return a decorator that shows the keywords of a TypedDict in a signature."""

    def decorate(function: F) -> F:
        kind = inspect.Parameter.KEYWORD_ONLY
        types = types_of(keywords).items()
        return show(
            function,
            [inspect.Parameter(n, kind, default=DEFAULTS.get(n), annotation=t) for n, t in types],
        )

    return decorate


def env_option(keywords: Mapping[str, Any]) -> str:
    """Format keywords as the option --env of the commands, after a space; empty without any."""
    words = " ".join(shlex.quote(f"{k}={v}") for k, v in keywords.items())
    return words and f" --env {words}"
