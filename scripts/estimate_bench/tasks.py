"""The five tasks of EstimateBench, as data."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from quad_gym import IDS
from scripts.studies.tasks import STUDIED, StudiedTask

PROTOCOL = 1  #: version of the protocol, which entries name


@dataclass(frozen=True, kw_only=True)
class BenchTask:
    """Task of the benchmark. Horizon and reward scale belong to it, and not to an algorithm."""

    name: str
    """Name in tables"""
    asks: str
    """Question that the task asks, for the page"""
    env_id: str
    environment: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of the environment in training and test"""
    flights: tuple[str, ...]
    """Patterns of the golden flights of the task"""
    steps: int
    """Environment steps of a training"""
    gamma: float
    """Discount per step"""
    reward_scale: float
    """Factor on rewards that makes returns of the order of 100"""
    starts: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of the environment in training only"""
    rule: str
    """Name of the best fixed rule, for `load_policy` or of `scripts.studies.rules`"""
    rule_environment: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of the environment that the rule needs"""
    measurements: bool = True
    """True if the task can be observed by raw measurements alone"""

    @property
    def defined(self) -> StudiedTask:
        """Success and columns of the task."""
        return STUDIED[IDS[self.env_id]]


_STD = {"include_std": True}
_MIXED = {"start": "mixed", "randomize_reference": True}

TASKS: tuple[BenchTask, ...] = (
    BenchTask(
        name="LookAround",
        asks="Does the policy act to know its position?",
        env_id="QuadGym/LookAround-v0",
        flights=("LookAround", "LookAround, truth"),
        steps=2_000_000,
        gamma=0.99,
        reward_scale=0.2,
        starts={"out_of_bounds": 3.0},
        rule="planning",
        rule_environment=_STD,
        measurements=False,  # it observes the direction of the markers from the estimate
    ),
    BenchTask(
        name="StaleRace",
        asks="Does the policy fly such that late measurements do no harm?",
        env_id="QuadGym/StaleRace-v0",
        flights=("StaleRace", "StaleRace, truth"),
        steps=4_000_000,
        gamma=0.99,
        reward_scale=1.0,
        starts=_MIXED,
        rule="pd",
    ),
    BenchTask(
        name="OutageDash",
        asks="Does the policy wait while it is too uncertain for the next gap?",
        env_id="QuadGym/OutageDash-v0",
        flights=("OutageDash", "OutageDash, truth"),
        steps=1_200_000,
        gamma=0.99,
        reward_scale=0.02,
        rule="backs_off",
        rule_environment=_STD,
        measurements=False,  # its observation, relative to the gaps, replaces all others
    ),
    BenchTask(
        name="Circle",
        asks="Sanity check: the task on which the recipes were tuned",
        env_id="QuadGym/Circle-v0",
        environment={"sensors": "standard"},
        flights=("Circle, standard",),
        steps=1_800_000,
        gamma=0.97,
        reward_scale=0.2,
        starts=_MIXED,
        rule="pd",
    ),
    BenchTask(
        name="RandomTrajectory",
        asks="Control: with this estimate, training on the truth should be at least as good",
        env_id="QuadGym/RandomTrajectory-v0",
        environment={"sensors": "consumer", "world": "breeze"},
        flights=("RandomTrajectory, consumer", "breeze"),
        steps=1_800_000,
        gamma=0.97,
        reward_scale=0.2,
        starts=_MIXED,
        rule="pd",
    ),
)
"""Tasks in the order of the table."""

TASK: Mapping[str, BenchTask] = {task.name: task for task in TASKS}
"""Tasks by name."""
