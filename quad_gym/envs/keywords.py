"""Keywords of the environments: types and defaults, and the signatures that show them.

`EnvKeywords` is the only list of them. Type checkers and editors read it from `**keywords` of the
interfaces, `inspect.signature` and `help` from the signatures that `shows` makes of it. `QuadEnv`
explains each keyword. `env_option` writes given keywords for a command line.
"""

import inspect
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, TypeVar

from quad_gym.envs.config import DEFAULTS, TASK_KEYWORDS
from quad_gym.faults import FaultsGiven
from quad_gym.params.checks import show
from quad_gym.params.randomization import Given, Randomization
from quad_gym.params.suites import SensorSuite
from quad_gym.params.task import RewardParams
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.vehicle import ActionParams, VehicleParams
from quad_gym.params.world import WorldParams

if TYPE_CHECKING:
    from quad_gym.batch.own_estimator import Estimator
    from quad_gym.tasks import Task


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
