"""The tasks that are studied: arms, success, columns of the table and figures of each, as data."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.intervals import Score, mean, worst_tenth
from quad_gym.experiments.arms import ARMS_OF, Arm
from quad_gym.experiments.study_flights import Flown


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of the table: one number of each episode, and what is made of them."""

    heading: str
    """for people, with its unit"""
    of: Callable[[Flown], NDArray[Any]]
    """(e,) one number of each episode"""
    digits: int | None = None
    """after the point; None: a share, in percent"""
    score: Score = mean
    """over the episodes"""


@dataclass(frozen=True, kw_only=True)
class StudiedTask:
    """What a study of a task is made of."""

    arms: tuple[Arm, ...]
    """all there are, in the order of the table"""
    carrying: tuple[str, ...]
    """names of those that carry the conclusions"""
    success: Callable[[Flown], NDArray[np.bool_]]
    """(e,) whether episodes are a success"""
    meaning: str
    """what success is, for people"""
    columns: Mapping[str, Column]
    """further ones of the table, by name"""
    telling: str
    """the column that says how the task was done, beside successes and crashes"""
    traced: tuple[str, ...]
    """what is kept of the first episodes, for the figure; see `study_flights.TRACES`"""
    evaluations: int = 9
    """how often a policy is evaluated over its training, to keep the best one"""
    figure: str
    """"glance": where policies look; "pace": how fast they fly, and how sure the filter is"""
    course: tuple[str, int] | None = None
    """what is passed on a course, and how many there are; None: there is no course"""
    film_speed: float = 1.0
    """seconds of flight per second of a film"""


ALWAYS: Mapping[str, Column] = {
    "return": Column(heading="return", of=lambda run: run.returns, digits=1),
    "worst": Column(heading="worst tenth", of=lambda run: run.returns, digits=1, score=worst_tenth),
    "crashed": Column(heading="crashed", of=lambda run: run.crashed),
}
"""Columns of every table, beside that of success."""

WITHIN = 0.5
"""Mean position error in the second half that is a success in LookAround [m]."""


def stays(run: Flown, within: float = WITHIN) -> NDArray[np.bool_]:
    """(e,) whether it flew to the end, in the second half with a mean error below `within`."""
    return ~run.crashed & (np.nan_to_num(run.late_error, nan=np.inf) < within)


def passes(run: Flown, gates: int) -> NDArray[np.bool_]:
    """(e,) whether it passed so many gates without a crash."""
    return ~run.crashed & (run.gates >= gates)


_SPEED = Column(heading="mean speed [m/s]", of=lambda run: run.speed, digits=2)

STUDIED: Mapping[str, StudiedTask] = {
    "look_around": StudiedTask(
        arms=ARMS_OF["look_around"],
        carrying=(
            "pd_reference",
            "pd_features",
            "pd_features_when_uncertain",
            "truth",
            "std_certainty",
        ),
        success=stays,
        meaning="flown to the end, with a mean position error below "
        f"{WITHIN:g} m in the second half",
        columns={
            "error": Column(heading="position error [m]", of=lambda run: run.error, digits=3),
            "in_view": Column(heading="features in view", of=lambda run: run.in_view),
        },
        telling="error",
        traced=("off_wall", "off_reward", "sigma", "estimation_error", "position_error"),
        figure="glance",
    ),
    "stale_race": StudiedTask(
        arms=ARMS_OF["stale_race"],
        carrying=(
            *("pd", "truth", "std", "truth_on_truth", "truth_delay_compensated"),
            "std_delay_compensated",
        ),
        evaluations=8,
        success=lambda run: passes(run, 8),
        meaning="all eight gates passed",
        columns={
            "gates": Column(heading="gates passed, of 8", of=lambda run: run.gates, digits=2),
            "speed": _SPEED,
        },
        telling="gates",
        traced=("speed", "sigma", "estimation_error"),
        figure="pace",
        course=("gates", 8),
    ),
    "outage_dash": StudiedTask(
        arms=ARMS_OF["outage_dash"],
        carrying=(*("pd", "pd_slow", "pd_waiting", "truth", "estimate", "std", "truth_on_truth"),),
        evaluations=12,
        success=lambda run: passes(run, 10),
        meaning="all ten gaps passed, without a crash",
        columns={
            "gates": Column(heading="gaps passed, of 10", of=lambda run: run.gates, digits=2),
            "speed": _SPEED,
        },
        telling="gates",
        traced=("speed", "sigma", "estimation_error", "outage"),
        figure="pace",
        course=("gaps", 10),
        film_speed=3.0,
    ),
}
"""By task."""
