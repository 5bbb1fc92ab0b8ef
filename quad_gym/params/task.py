"""The task: its reference, the start and the end of its episodes, and weights of its reward."""

import functools
import math
from collections.abc import Sequence
from dataclasses import field, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Vector
from quad_gym.params.trajectories import Trajectory
from quad_gym.records import MAX_GATES, RewardTerm, Start, TaskKind

# --------------------------------------------------------------------------------------------------
# Weights of the built-in rewards.
# --------------------------------------------------------------------------------------------------

Weight = Annotated[float, check.between(0.0, 1e9)]

_COMMON = (RewardTerm.HEADING, RewardTerm.ACTION_RATE, RewardTerm.BODY_RATES)
_TRACKING = (RewardTerm.NEAR, RewardTerm.FINE, *_COMMON)
_COURSE = (RewardTerm.PROGRESS, RewardTerm.GATE_PASSED, *_COMMON)


class RewardParams(Checked):
    """Weights of the terms of the built-in rewards, per step; a weight of 0 switches a term off.

    The defaults are this package's own: flying on the reference earns 1.6 in each step, and the
    costs are small beside it unless actions jump.
    """

    near: Weight = 1.0
    """weight of exp(-near_decay e) of the position error e [-]"""
    near_decay: Weight = 2.0
    """decay of that term with distance [1/m]; it still rewards coming closer at errors of a
    meter"""
    fine: Weight = 0.5
    """weight of exp(-fine_decay e) [-]"""
    fine_decay: Weight = 20.0
    """decay of that term with distance [1/m]; it rewards errors of centimeters"""
    progress: Weight = 1.0
    """weight of the speed toward the next gate of a course [s/m]"""
    gate_passed: Weight = 1.0
    """weight of 1 / control period in a step that passes a gate [s]"""
    heading: Weight = 0.1
    """weight of the alignment of body x with the desired heading, from -1 to 1 [-]"""
    action_rate: Weight = 0.02
    """cost of the squared change of the action since the last step [-]"""
    body_rates: Weight = 0.002
    """cost of the squared body rates [s^2/rad^2]"""

    @staticmethod
    def terms(kind: str) -> tuple[RewardTerm, ...]:
        """Return the terms of the reward of a kind of task."""
        return _COURSE if kind == "waypoints" else _TRACKING


# --------------------------------------------------------------------------------------------------
# The task: its reference, and the start and the end of its episodes.
# --------------------------------------------------------------------------------------------------

TASKS = tuple(task.name.lower() for task in TaskKind)  #: kinds of task
STARTS = tuple(start.name.lower() for start in Start)  #: names of the ways in which episodes begin

FARTHEST = 1000.0
"""Largest distance of a reference from the origin, along an axis, in observations [m]."""

ONE_TASK_FIELDS = {
    "max_speed": "random_trajectory",
    "max_acceleration": "random_trajectory",
    "gate_count": "waypoints",
    "gate_radius": "waypoints",
    "trajectory": "trajectory",
}
"""Fields that have an effect with a single task, and that task."""

FIELDS_WITHOUT_EFFECT = {
    "hover": ("period",),
    "waypoints": ("period", "preview"),
    "trajectory": ("radius", "period", "height"),
}
"""Fields that have an effect with most tasks, by the tasks with which they have none."""

MIN_PERIOD = 0.01  #: period of the fastest reference [s]; no vehicle can follow a faster one

Size = Annotated[float, partial(check.positive, most=FARTHEST)]


class TaskParams(Checked):
    """Reference, start, reward scale and termination of a task."""

    kind: Annotated[str, partial(check.choice, choices=TASKS)] = "circle"
    """kind of task, one of TASKS"""
    radius: Size = 4.0
    """size of the reference, at most 1000 [m]; report section 4.2. Radius of the circle; distance
    of the hover point from the vertical through the origin; half the length of the lemniscate;
    bound of a random trajectory's distance from its center, and of the gates' distance from the
    vertical through the origin"""
    period: Annotated[float, partial(check.number, least=MIN_PERIOD)] = 10.0
    """period of the reference, at least 0.01 [s]; report section 4.2"""
    height: Size = 1.0
    """height of the reference, at most 1000 [m]; report section 4.2"""
    start: Annotated[str, partial(check.choice, choices=STARTS)] = "ground"
    """start of an episode. "ground": at rest below the reference at height 0, with stopped rotors
    (report section 4.2); "hover": hovering at rest within some decimeters of the reference;
    "mixed": one of these two, each with probability 0.5; "moving": as "hover", with uniformly drawn
    velocities of up to 1.5 m/s and body rates of up to 2 rad/s on each axis"""
    pad: bool = True
    """True: a launch pad supports a vehicle that starts on the ground until its thrust lifts it;
    False: it sinks while its rotors spin up, as in the report. Ground that supports vehicles
    (`WorldParams.ground`) makes the pad unnecessary"""
    reward_per: Literal["step", "second"] = "step"
    """unit of the reward. "step": of order one in each step, as learning algorithms expect;
    "second": the reward per step times the control period"""
    reward_params: RewardParams = field(default_factory=RewardParams)
    """weights of the terms of the built-in reward, see `quad_gym.RewardParams`"""
    randomize_reference: bool = False
    """True: draw the reference in each episode: azimuth and distance of the hover point; phase,
    radius, period and sense of circle and lemniscate; the heading of a random trajectory and of a
    course of gates. A user-defined trajectory is rotated about the vertical through the origin, and
    a closed one begins anywhere"""
    duration: Annotated[float, check.between(0.0, 1e9)] = 10.0
    """time limit of an episode [s], at least half a control period; 0: no limit; report section
    4.2"""
    out_of_bounds: check.Positive = 3.0
    """distance from the reference above which an episode ends [m]"""
    min_height: float = -0.5
    """height below which an episode ends [m]. The default is negative, as a vehicle without a
    launch pad sinks while its rotors spin up. Over ground that supports vehicles
    (`WorldParams.ground`), at least 0.5 m below that ground"""
    truncate_when_diverged: bool = False
    """True: truncate an episode when the filter's consistency monitor flags divergence"""
    max_tilt: float = math.radians(100.0)
    """angle between the body z axis and the vertical above which an episode ends [rad]"""
    max_speed: check.Positive = 2.5
    """bound of the speed of a random trajectory [m/s]"""
    max_acceleration: check.Positive = 3.0
    """bound of the acceleration of a random trajectory [m/s^2]"""
    gate_count: Annotated[int, partial(check.whole, most=MAX_GATES)] = 5
    """number of gates of a course, at most 8"""
    gate_radius: check.Positive = 0.3
    """distance from the center of a gate below which the gate is passed [m]"""
    preview: Annotated[Vector, partial(check.vector, length=2, least=0.0)] = (0.2, 0.4)
    """(2,) times ahead of the present at which observations include the reference [s]"""
    trajectory: Trajectory | str | Path | Sequence[Trajectory | str | Path] | None = None
    """reference of the task: a `quad_gym.Trajectory`, the path of a table for
    `Trajectory.from_csv`, or a sequence of these, of which each episode draws one; None: a figure
    of eight through five points"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._set("trajectory", checked_trajectories(self.trajectory))
        weights = check.changed(self.reward_params)
        own = {f"RewardParams.{name}": weight for name, weight in weights.items()}
        check.effect({**check.changed(self), **own}, fields_without_effect(self))
        lowest, of = (
            (0.0, "of starts") if self.may_start_on_ground else (self.height, "of the task")
        )
        if self.kind != "trajectory" and self.min_height > lowest:
            self._refuse("min_height", f"be at most {lowest:g} m, the height {of}")
        if not 0.0 < self.max_tilt <= math.pi:
            self._refuse("max_tilt", "be in (0, pi]")

    @property
    def may_start_on_ground(self) -> bool:
        """True if any episode may begin on the ground."""
        return self.start in ("ground", "mixed")

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """Trajectories of the task "trajectory", one of them per episode; empty for others."""
        if self.kind != "trajectory":
            return ()
        given: Any = self.trajectory
        return given or (figure_of_eight(),)


def fields_without_effect(task: TaskParams) -> dict[str, str]:
    """Return the fields and weights that have no effect on a task, each with the reason.

    `TaskParams` refuses those that differ from their defaults. An environment, which knows the
    keywords that were given, refuses each of them.
    """
    on_task = f"on the task {task.kind}"
    found = {
        name: f"{on_task} (only on {kind})"
        for name, kind in ONE_TASK_FIELDS.items()
        if kind != task.kind
    }
    found |= dict.fromkeys(FIELDS_WITHOUT_EFFECT.get(task.kind, ()), on_task)
    used = {term.name.lower() for term in RewardParams.terms(task.kind)}
    for weight in fields(RewardParams):
        if weight.name.removesuffix("_decay") not in used:
            found[f"RewardParams.{weight.name}"] = on_task
    if not task.may_start_on_ground:
        found["pad"] = f'with start="{task.start}"'
    return found


@functools.cache
def figure_of_eight() -> Trajectory:
    """Return a closed trajectory through five points, up to 2.5 m/s and 3 m/s^2."""
    points = [(0, 0, 1.5), (3, 1.5, 2), (3, -1.5, 1), (-3, 1.5, 2), (-3, -1.5, 1)]
    return Trajectory.through(points, closed=True, yaw="along")


def checked_trajectories(given: Any) -> tuple[Trajectory, ...] | None:
    """Return the trajectories of a task as a tuple, or None; files are read."""
    if given is None:
        return None
    several = [given] if isinstance(given, (Trajectory, str, Path)) else given
    if not isinstance(several, Sequence) or not several:
        raise ValueError(
            f"TaskParams.trajectory must be a Trajectory or a sequence of them, got {given!r}"
        )
    found = []
    for one in several:
        path = _read(one) if isinstance(one, (str, Path)) else one
        check.instance("TaskParams.trajectory", path, Trajectory)
        if path.reach > FARTHEST:
            raise ValueError(
                f"TaskParams.trajectory must stay within {FARTHEST:g} m of the origin, got "
                f"{path.reach:.4g} m"
            )
        found.append(path)
    return tuple(found)


def _read(file: str | Path) -> Trajectory:
    try:
        return Trajectory.from_csv(file)
    except OSError as error:
        raise ValueError(
            f"TaskParams.trajectory must be a file that can be read: {error}"
        ) from None


def check_limit(task: TaskParams, rate: float, name: str) -> None:
    """Refuse a time limit of less than a step, which would be rounded to no limit."""
    if task.duration > 0.0 and round(task.duration * rate) == 0:
        raise ValueError(
            f"duration must be 0 (no limit) or at least one step, {1.0 / rate:g} s at {name}="
            f"{rate:g} Hz, got {task.duration:g} s"
        )
