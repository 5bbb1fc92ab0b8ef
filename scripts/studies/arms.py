"""Arms of studies, as data: each defines how a controller is trained and tested.

A study trains each arm with several seeds, and tests every policy on the estimate in the same
episodes. To define your own arms, write a file like this one with a tuple `ARMS`, and pass it to
`python -m scripts.studies --arms-file`.
"""

import runpy
from collections.abc import Collection, Sequence
from dataclasses import KW_ONLY, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from baselines.policies import is_included
from baselines.recipes import ALGORITHMS, ReadOnly
from quad_gym import NoisyObservationParams, sensor_suite
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked


def _word(name: str, value: Any) -> str:
    if not (isinstance(value, str) and value.isidentifier()):
        raise ValueError(f"{name} must be a word of letters and digits, got {value!r}")
    return value


class Arm(Checked, kw_only=False):
    """Arm of a study: the training and the test of one kind of controller."""

    name: Annotated[str, _word]
    """Short name, for folders"""
    label: Annotated[str, partial(check.instance, kind=str)]
    """Label for tables and figures"""
    _: KW_ONLY
    policy: str | None = None
    """Name of a policy that needs no training (`baselines.policies.load_policy`); None: trained"""
    flies: str | None = None
    """Name of a trained arm whose policies this arm tests in another environment, as a control"""
    environment: ReadOnly = field(default_factory=dict)
    """Keywords of the environment in the test, such as the observation"""
    training: ReadOnly = field(default_factory=dict)
    """Keywords that override `environment` in training and in the selection of the best policy"""
    learning: ReadOnly = field(default_factory=dict)
    """Keywords that override both in training, but not in the selection of the best policy, such as
    another reward"""
    algorithm: Annotated[str, partial(check.choice, choices=ALGORITHMS)] = "ppo"
    """Algorithm, one of `baselines.recipes.ALGORITHMS`; PPO is trained with the compiled engine,
    others are with Stable-Baselines3"""
    parameters: ReadOnly = field(default_factory=dict)
    """Parameters of the algorithm that override the recipe's"""

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.policy if self.flies is None else f"taken from {self.flies}"
        learns = self.training or self.learning or self.parameters or self.algorithm != "ppo"
        if given is not None and learns:
            raise ValueError(f"Arm {self.name} must not be trained, because its policy is {given}")
        if self.policy is not None and self.flies is not None:
            raise ValueError(
                f"Arm {self.name} must have either a policy or the name of another arm, not both"
            )

    @property
    def trained(self) -> bool:
        """True if the arm is trained."""
        return self.policy is None and self.flies is None

    @property
    def learned(self) -> bool:
        """True if the policy is trained by the study or is an included one."""
        return self.trained or (self.policy is not None and is_included(self.policy))

    @property
    def engine(self) -> str:
        """Training engine of the arm, one of `baselines.recipes.ENGINES`."""
        return "compiled" if self.algorithm == "ppo" else "sb3"


def _task(name: str, module: str = "scripts.studies.arm_tasks") -> dict[str, str]:
    """Keyword of an environment with a task of a module."""
    return {"task": f"{module}:{name}"}


_FAR_SIGHTED = {"gamma": 0.995}
"""Longer horizon: without a reward for certainty, looking at the markers is rewarded only seconds
later. With the recipe's 0.99, a third of the flights crashed in preliminary trainings."""
_ONE_WALL = sensor_suite("one_wall")
_NOISIER = _ONE_WALL.replace(
    noisy=NoisyObservationParams(position=0.11, velocity=0.10, attitude=0.012, body_rates=0.011)
)
"""Noise as large as the errors of the estimate: root mean squares of position and velocity over 300
episodes of `pd_features_when_uncertain`, attitude in proportion. The suite's own noise, 8 mm, has
the size of the errors of a filter that always has features in view."""
_WITH_STD = _task("WithStd", "baselines.arm_tasks")

ARMS = (
    Arm("pd_reference", "PD, tracks the rewarded heading", policy="pd"),
    Arm("pd_features", "PD, facing the features", policy="pd:features"),
    Arm(
        "pd_features_when_uncertain",
        "PD, facing the features when uncertain",
        policy="pd:features_when_uncertain",
        environment={"include_std": True},
    ),
    Arm(
        "pd_planning",
        "PD that plans by covariances",
        policy="planning",
        environment={"include_std": True},
    ),
    Arm("truth", "truth", training={"observation": "truth"}),
    Arm("noisy", "truth + independent noise", training={"observation": "noisy"}),
    Arm(
        "noisier",
        "truth + noise matched to observed errors",
        training={"observation": "noisy", "sensors": _NOISIER},
    ),
    Arm("estimate", "estimate", parameters=_FAR_SIGHTED),
    Arm("std", "estimate + standard deviation", environment=_WITH_STD, parameters=_FAR_SIGHTED),
    Arm(
        "std_history",
        "estimate + standard deviation + history",
        environment=_task("WithStdHistory"),
        parameters=_FAR_SIGHTED,
    ),
    Arm("certainty", "estimate, reward for certainty", learning=_task("CertaintyReward")),
    Arm(
        "std_certainty",
        "estimate + standard deviation, reward for certainty",
        environment=_WITH_STD,
        learning=_task("WithStdCertaintyReward"),
    ),
    Arm(
        "std_certainty_privileged",
        "estimate + standard deviation, reward for certainty, privileged critic",
        environment=_WITH_STD,
        learning=_task("WithStdCertaintyRewardForCritic", "scripts.studies.arm_critics"),
        parameters={"critic_only": 15},
    ),
    Arm("included_truth", "truth", policy="pretrained:truth"),
    Arm(
        "included",
        "estimate + standard deviation, reward for certainty",
        policy="pretrained",
        environment=_WITH_STD,
    ),
)
"""Arms of `QuadGym/LookAround-v0`."""

_TRUTH = {"observation": "truth"}
_STD = {"include_std": True}
_STALE = sensor_suite("stale")
_COMPENSATED = {
    "sensors": _STALE.replace(estimator=_STALE.estimator.replace(delay_compensation="retrodict"))
}
"""Sensors of the race, with a filter that uses the time stamps of their measurements."""
_WITH_HISTORY = {**_task("RaceWithHistory"), **_STD}

STALE_RACE = (
    Arm("pd", "PD", policy="pd"),
    Arm("truth", "truth", training=_TRUTH),
    Arm("std", "estimate + 15 standard deviations", environment=_STD),
    Arm("std_history", "estimate + 15 standard deviations + history", environment=_WITH_HISTORY),
    Arm(
        "residual",
        "truth + residual model",
        environment=_task("ObservedRace"),
        training={**_task("ResidualRace"), **_TRUTH},
    ),
    Arm("truth_on_truth", "truth, tested on the truth", flies="truth", environment=_TRUTH),
    Arm(
        "truth_delay_compensated",
        "truth, tested with delay compensation",
        flies="truth",
        environment=_COMPENSATED,
    ),
    Arm(
        "std_delay_compensated",
        "estimate + 15 standard deviations, tested with delay compensation",
        flies="std",
        environment={**_STD, **_COMPENSATED},
    ),
    Arm("included", "estimate + 15 standard deviations", policy="pretrained", environment=_STD),
)
"""Arms of `QuadGym/StaleRace-v0`."""

_SCALED = _task("Scaled", "baselines.arm_tasks")
_WITH_UNCERTAINTY = _task("WithUncertainty", "baselines.arm_tasks")
_CONSTANT_CRASH_COST = _task("ConstantCrashCost")

OUTAGE_DASH = (
    Arm("pd", "PD at 4.7 m/s", policy="pd"),
    Arm("pd_slow", "PD at 2.4 m/s", policy="pd:slow"),
    Arm("pd_waiting", "PD that waits when uncertain", policy="pd:waiting", environment=_STD),
    Arm("pd_planning", "PD that plans by covariances", policy="planning", environment=_STD),
    Arm("truth", "truth", environment=_SCALED, training=_TRUTH, learning=_CONSTANT_CRASH_COST),
    Arm("estimate", "estimate", environment=_SCALED, learning=_CONSTANT_CRASH_COST),
    Arm(
        "std",
        "estimate + normalized uncertainty",
        environment=_WITH_UNCERTAINTY,
        learning=_task("ConstantCrashCostWithUncertainty"),
    ),
    Arm(
        "std_privileged",
        "estimate + normalized uncertainty, privileged critic",
        environment=_WITH_UNCERTAINTY,
        learning=_task("ConstantCrashCostWithUncertaintyForCritic", "scripts.studies.arm_critics"),
        parameters={"critic_only": 16},
    ),
    Arm(
        "truth_on_truth",
        "truth, tested on the truth",
        flies="truth",
        environment={**_SCALED, **_TRUTH},
    ),
    Arm(
        "included",
        "estimate + normalized uncertainty",
        policy="pretrained",
        environment=_WITH_UNCERTAINTY,
    ),
)
"""Arms of `QuadGym/OutageDash-v0`."""


def read_arms(file: Path) -> tuple[Arm, ...]:
    """Read the tuple `ARMS` of a Python file.

    Raises:
        ValueError: If there is no such file or tuple.
    """
    if not file.is_file():
        raise ValueError(f"--arms-file must be a Python file, got {file}")
    try:
        arms = runpy.run_path(str(file)).get("ARMS")
    except (SyntaxError, ValueError) as error:
        raise ValueError(f"--arms-file must be a Python file, got {file}: {error}") from None
    if not (isinstance(arms, tuple) and all(isinstance(arm, Arm) for arm in arms)):
        raise ValueError(f"--arms-file {file} must have a tuple ARMS of Arm")
    names = [arm.name for arm in arms]
    if len(set(names)) != len(names):
        raise ValueError(f"arms must have different names, got {', '.join(names)}")
    return arms


def chosen_arms(known: Sequence[Arm], wanted: Collection[str]) -> tuple[Arm, ...]:
    """Arms with given names, in the order of the known ones.

    Raises:
        ValueError: If there is no such arm, or the arm whose policies another flies is missing.
    """
    for name in wanted:
        check.choice("--arms", name, tuple(arm.name for arm in known))
    found = tuple(arm for arm in known if arm.name in wanted)
    trained = [arm.name for arm in found if arm.trained]
    for arm in found:
        if arm.flies is not None and arm.flies not in trained:
            raise ValueError(f"--arms must name {arm.flies}, whose policies {arm.name} flies")
    return found
