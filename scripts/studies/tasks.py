"""Tasks of studies, as data: arms, success, columns of the table, figures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.experiments import Flown
from scripts.studies.arms import ARMS, OUTAGE_DASH, STALE_RACE, TRACKING, Arm
from scripts.studies.scores import Score, mean, worst_tenth


@dataclass(frozen=True)
class StudyColumn:
    """Column of the table: one number per episode, and their score."""

    heading: str
    """Heading with the unit"""
    of: Callable[[Flown], NDArray[Any]]
    """Function that returns one number per episode, (e,)"""
    digits: int | None = None
    """Number of decimals; None: a share, in percent"""
    score: Score = mean
    """Score of the episodes"""


@dataclass(frozen=True, kw_only=True)
class StudiedTask:
    """Definition of the studies of a task."""

    arms: tuple[Arm, ...]
    """All arms, in the order of the table"""
    carrying: tuple[str, ...]
    """Names of the arms that are studied by default"""
    success: Callable[[Flown], NDArray[np.bool_]]
    """Function that returns True for successful episodes, (e,)"""
    meaning: str
    """Definition of success in words"""
    columns: Mapping[str, StudyColumn]
    """Further columns of the table, by name"""
    telling: str
    """Column that the conclusions quote, in addition to successes and crashes"""
    traced: tuple[str, ...]
    """Traces of the first episodes that the figure shows, see `traces.TRACES`"""
    evaluations: int = 9
    """Number of evaluations during a training, of which the best policy is kept"""
    figure: str
    """Figure of an episode. "glance": heading of policies; "pace": speed, and standard deviations
    of the filter; "none": no figure"""
    course: tuple[str, int] | None = None
    """Name and number of the gates of a course; None: no course"""
    film_speed: float = 1.0
    """Seconds of flight per second of a film"""

    def table(self) -> dict[str, StudyColumn]:
        """Columns of the table by name, in their order."""
        returns = StudyColumn("return", lambda run: run.episodes.returns, digits=1)
        return {
            "return": returns,
            "worst": replace(returns, heading="worst tenth", score=worst_tenth),
            "success": StudyColumn("success", self.success),
            "crashed": StudyColumn("crashed", lambda run: run.episodes.crashed),
            **self.columns,
        }


WITHIN = 0.5
"""Largest mean position error in the second half of a successful episode of LookAround [m]."""


def stays(run: Flown, within: float = WITHIN) -> NDArray[np.bool_]:
    """Return True for complete episodes with a late error below `within` [m], (e,)."""
    return ~run.episodes.crashed & (np.nan_to_num(run.episodes.late_error, nan=np.inf) < within)


def passes(run: Flown, gates: int) -> NDArray[np.bool_]:
    """Return True for episodes with at least `gates` gates and no crash, (e,)."""
    return ~run.episodes.crashed & (run.episodes.gates_passed >= gates)


def _gates(heading: str) -> dict[str, StudyColumn]:
    """Columns of a course."""
    return {
        "gates": StudyColumn(heading, lambda run: run.episodes.gates_passed, digits=2),
        "speed": StudyColumn(
            "mean speed up to the end [m/s]", lambda run: run.recorded["mean_speed"], digits=2
        ),
    }


def _tracking(gates: int = 0) -> StudiedTask:
    """Definition of the studies of a task with a built-in reference."""
    error = StudyColumn("position error [m]", lambda run: run.episodes.mean_error, digits=3)
    return StudiedTask(
        arms=TRACKING,
        carrying=tuple(arm.name for arm in TRACKING),
        success=lambda run: passes(run, gates),
        meaning=f"all {gates} gates passed" if gates else "completed without a crash",
        columns={"error": error, **(_gates(f"gates passed, of {gates}") if gates else {})},
        telling="error",
        traced=(),
        evaluations=8,
        figure="none",
        course=("gates", gates) if gates else None,
    )


STUDIED: Mapping[str, StudiedTask] = {
    "look_around": StudiedTask(
        arms=ARMS,
        carrying=(
            "pd_reference",
            "pd_features",
            "pd_features_when_uncertain",
            "truth",
            "std_certainty",
        ),
        success=stays,
        meaning=f"completed, with a mean position error below {WITHIN:g} m in the second half",
        columns={
            "error": StudyColumn(
                "position error [m]", lambda run: run.episodes.mean_error, digits=3
            ),
            "in_view": StudyColumn("features in view", lambda run: run.recorded["in_view"]),
        },
        telling="error",
        traced=("off_wall", "off_reward", "sigma", "estimation_error", "position_error"),
        figure="glance",
    ),
    "stale_race": StudiedTask(
        arms=STALE_RACE,
        carrying=(
            "pd",
            "truth",
            "std",
            "truth_on_truth",
            "truth_delay_compensated",
            "std_delay_compensated",
        ),
        evaluations=8,
        success=lambda run: passes(run, 8),
        meaning="all eight gates passed",
        columns=_gates("gates passed, of 8"),
        telling="gates",
        traced=("speed", "sigma", "estimation_error"),
        figure="pace",
        course=("gates", 8),
    ),
    "outage_dash": StudiedTask(
        arms=OUTAGE_DASH,
        carrying=("pd", "pd_slow", "pd_waiting", "truth", "estimate", "std", "truth_on_truth"),
        evaluations=12,
        success=lambda run: passes(run, 10),
        meaning="all ten gaps passed, without a crash",
        columns=_gates("gaps passed, of 10"),
        telling="gates",
        traced=("speed", "sigma", "estimation_error", "outage"),
        figure="pace",
        course=("gaps", 10),
        film_speed=3.0,
    ),
    "circle": _tracking(),
    "random_trajectory": _tracking(),
    "waypoints": _tracking(gates=5),
}
"""Definitions by task."""
