"""Arms of studies, as data: each defines how a controller is trained and tested.

A study trains each arm with several seeds, and tests every policy on the estimate in the same
episodes. To define your own arms, write a file like this one with a tuple `ARMS`, and pass it to
`python -m scripts.studies --arms-file`.
"""

import runpy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import KW_ONLY, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from baselines.policies import is_included
from baselines.recipes import ALGORITHMS, IMITATION, ReadOnly
from quad_gym import NoisyObservationParams, sensor_suite
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.records.sizes import PRECISION, PRECISIONS
from scripts.studies.fitting import errors_of


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
    algorithm: Annotated[str, partial(check.choice, choices=(*ALGORITHMS, IMITATION))] = "ppo"
    """Algorithm, one of `baselines.recipes.ALGORITHMS`, or `IMITATION`; PPO and imitation are
    trained with the compiled engine, others are with Stable-Baselines3"""
    parameters: ReadOnly = field(default_factory=dict)
    """Parameters of the algorithm that override the recipe's"""
    precision: Annotated[str, partial(check.choice, choices=PRECISIONS)] = PRECISION
    """Precision of the flights in training; in the test, it is always the one of the process"""

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.policy if self.flies is None else f"taken from {self.flies}"
        learns = self.training or self.learning or self.parameters or self.algorithm != "ppo"
        learns = learns or self.precision != PRECISION
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
        return "compiled" if self.algorithm in ("ppo", IMITATION) else "sb3"


def _task(name: str, module: str = "scripts.studies.arm_tasks") -> dict[str, str]:
    """Keyword of an environment with a task of a module."""
    return {"task": f"{module}:{name}"}


TRUTH: Mapping[str, Any] = {"observation": "truth"}
"""Keyword of training on the truth. In `learning`, the checkpoint is chosen on the estimate."""
_FILTERED_TRUTH = {**TRUTH, "run_filter": True}
"""Training on the truth while the filter flies along, for its standard deviation and a reward; the
flights are the same as with `TRUTH`."""
STD: Mapping[str, Any] = {"include_std": True}


def _matched_noise(suite: str, task: str) -> dict[str, Any]:
    """Keywords of training on the truth with noise as large as the errors of the estimate."""
    noise = NoisyObservationParams(**errors_of(task))
    return {"observation": "noisy", "sensors": sensor_suite(suite).replace(noisy=noise)}


_NOISY, _MATCHED = {"observation": "noisy"}, _matched_noise("one_wall", "look_around")
"""Independent noise. The suite's own, 8 mm, has the size of the errors of a filter that always has
features in view; the matched one of the errors of `pd_features_when_uncertain`."""
_WITH_STD = _task("WithStd", "baselines.arm_tasks")
_CERTAINTY, _STD_CERTAINTY = _task("CertaintyReward"), _task("WithStdCertaintyReward")
_FILTER = {"run_filter": True}

ARMS = (
    Arm("pd_reference", "PD, tracks the rewarded heading", policy="pd"),
    Arm("pd_features", "PD, facing the features", policy="pd:features"),
    Arm(
        "pd_features_when_uncertain",
        "PD, facing the features when uncertain",
        policy="pd:features_when_uncertain",
        environment=STD,
    ),
    Arm("pd_planning", "PD that plans by covariances", policy="planning", environment=STD),
    Arm(
        "truth_std_certainty",
        "truth + standard deviation, reward for certainty",
        environment=_WITH_STD,
        learning={**_FILTERED_TRUTH, **_STD_CERTAINTY},
    ),
    Arm(
        "std_certainty",
        "estimate + standard deviation, reward for certainty",
        environment=_WITH_STD,
        learning=_STD_CERTAINTY,
    ),
    Arm(
        "std_certainty_single",
        "estimate + standard deviation, reward for certainty, in single precision",
        environment=_WITH_STD,
        learning=_STD_CERTAINTY,
        precision="single",
    ),
    Arm("truth", "truth", learning=TRUTH),
    Arm("estimate", "estimate"),
    Arm(
        "truth_std",
        "truth + standard deviation",
        environment=_WITH_STD,
        learning=_FILTERED_TRUTH,
    ),
    Arm("std", "estimate + standard deviation", environment=_WITH_STD),
    Arm(
        "truth_certainty",
        "truth, reward for certainty",
        learning={**_FILTERED_TRUTH, **_CERTAINTY},
    ),
    Arm("certainty", "estimate, reward for certainty", learning=_CERTAINTY),
    Arm(
        "noisy_std_certainty",
        "truth + independent noise + standard deviation, reward for certainty",
        environment=_WITH_STD,
        learning={**_NOISY, **_FILTER, **_STD_CERTAINTY},
    ),
    Arm(
        "matched_std_certainty",
        "truth + noise matched to observed errors + standard deviation, reward for certainty",
        environment=_WITH_STD,
        learning={**_MATCHED, **_FILTER, **_STD_CERTAINTY},
    ),
    Arm("noisy", "truth + independent noise", learning=_NOISY),
    Arm("matched", "truth + noise matched to observed errors", learning=_MATCHED),
    Arm(
        "std_history",
        "estimate + standard deviation + history",
        environment=_task("WithStdHistory"),
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
"""Arms of `QuadGym/LookAround-v0`. Eight of them are all combinations of the observation in
training (truth, estimate), the standard deviation, and the reward for certainty."""

_STALE = sensor_suite("stale")
_COMPENSATED = {
    "sensors": _STALE.replace(estimator=_STALE.estimator.replace(delay_compensation="retrodict"))
}
"""Sensors of the race, with a filter that uses the time stamps of their measurements."""
_RACE_NOISE = _matched_noise("stale", "stale_race")
_WITH_HISTORY = {**_task("RaceWithHistory"), **STD}

STALE_RACE = (
    Arm("pd", "PD", policy="pd"),
    Arm("truth", "truth", learning=TRUTH),
    Arm("estimate", "estimate"),
    Arm("std", "estimate + 15 standard deviations", environment=STD),
    Arm("noisy", "truth + noise matched to observed errors", learning=_RACE_NOISE),
    Arm(
        "residual",
        "truth + residual model",
        environment=_task("ObservedRace"),
        learning={**_task("ResidualRace"), **TRUTH},
    ),
    Arm("std_history", "estimate + 15 standard deviations + history", environment=_WITH_HISTORY),
    Arm("truth_on_truth", "truth, tested on the truth", flies="truth", environment=TRUTH),
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
        environment={**STD, **_COMPENSATED},
    ),
    Arm(
        "compensated",
        "estimate with delay compensation, in training and test",
        environment=_COMPENSATED,
    ),
    Arm("included", "estimate + 15 standard deviations", policy="pretrained", environment=STD),
)
"""Arms of `QuadGym/StaleRace-v0`."""

_SCALED = _task("Scaled", "baselines.arm_tasks")
_WITH_UNCERTAINTY = _task("WithUncertainty", "baselines.arm_tasks")
_SINCE_FIX = _task("WithTimeSinceFix")
_CONSTANT_CRASH_COST = _task("ConstantCrashCost")
_CONSTANT_WITH_UNCERTAINTY = _task("ConstantCrashCostWithUncertainty")

SLOWED = (50, 25, 0)
"""Speeds of `rules.SlowsDown` while the filter is uncertain, in percent of its full speed."""

OUTAGE_DASH = (
    Arm("pd", "PD at 4.7 m/s", policy="pd"),
    Arm("pd_slow", "PD at 2.4 m/s", policy="pd:slow"),
    Arm("pd_waiting", "PD that waits when uncertain", policy="pd:waiting", environment=STD),
    Arm(
        "pd_backs_off",
        "PD that waits when uncertain, and backs off from walls",
        policy="backs_off",
        environment=STD,
    ),
    Arm(
        "pd_waits_at_start",
        "PD that waits at the start for the end of an outage",
        policy="waits_at_start",
        environment=STD,
    ),
    Arm("pd_planning", "PD that plans by covariances", policy="planning", environment=STD),
    *(
        Arm(
            f"pd_slows_to_{share}",
            f"PD at {share} % of its speed when uncertain",
            policy=f"slows_to_{share}",
            environment=STD,
        )
        for share in SLOWED
    ),
    Arm("truth", "truth", environment=_SCALED, learning={**_CONSTANT_CRASH_COST, **TRUTH}),
    Arm("estimate", "estimate", environment=_SCALED, learning=_CONSTANT_CRASH_COST),
    Arm(
        "std",
        "estimate + normalized uncertainty",
        environment=_WITH_UNCERTAINTY,
        learning=_CONSTANT_WITH_UNCERTAINTY,
    ),
    Arm(
        "since_fix",
        "estimate + normalized uncertainty + time since the last fix",
        environment=_SINCE_FIX,
        learning=_task("ConstantCrashCostWithTimeSinceFix"),
    ),
    Arm(
        "imitation",
        "estimate + normalized uncertainty, imitation of the rule that backs off",
        environment=_WITH_UNCERTAINTY,
        learning={**_task("WithUncertaintyForRule"), **STD},
        algorithm=IMITATION,
        parameters={"teacher": "scripts.studies.rules:BacksOff"},
    ),
    Arm(
        "recurrent",
        "estimate + normalized uncertainty, recurrent policy",
        environment=_WITH_UNCERTAINTY,
        learning=_CONSTANT_WITH_UNCERTAINTY,
        algorithm="recurrent_ppo",
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
        environment={**_SCALED, **TRUTH},
    ),
    Arm(
        "included",
        "estimate + normalized uncertainty, imitation",
        policy="pretrained",
        environment=_WITH_UNCERTAINTY,
    ),
)
"""Arms of `QuadGym/OutageDash-v0`."""

TRACKING = (
    Arm("pd", "PD", policy="pd"),
    Arm("pd_on_truth", "PD, tested on the truth", policy="pd", environment=TRUTH),
    Arm("truth", "truth", learning=TRUTH),
    Arm("estimate", "estimate"),
    Arm("truth_on_truth", "truth, tested on the truth", flies="truth", environment=TRUTH),
)
"""Arms of tasks that follow a reference: the cost of flying on the estimate, `truth` minus
`truth_on_truth`, and the gain of training on it, `truth` minus `estimate`."""


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
