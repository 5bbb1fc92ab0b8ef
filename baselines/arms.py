"""Arms of a study: what a controller is trained on, as data.

A study trains each arm with several seeds, and flies every policy on the estimate in the same
episodes. To add arms of your own, write a file like this one, with a tuple `ARMS`, and name it to
`quad-gym study --arms-file`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from baselines.recipes import ALGORITHMS
from quad_gym import sensor_suite
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked


@dataclass(frozen=True, kw_only=True)
class Arm(Checked):
    """A way to get a controller."""

    name: str
    """short, for folders"""
    label: str
    """for people"""
    policy: str | None = None
    """by name (`baselines.policies.load_policy`), one that is not trained; None: trained"""
    flies: str | None = None
    """name of a trained arm whose policies it flies elsewhere: a control"""
    environment: Mapping[str, Any] = field(default_factory=dict)
    """keywords of the environment in which it flies the test, such as what is observed"""
    training: Mapping[str, Any] = field(default_factory=dict)
    """keywords that hold in place of these while it is trained and its best policy is chosen"""
    learning: Mapping[str, Any] = field(default_factory=dict)
    """keywords that hold in place of these while it is trained, but not where its best policy is
    chosen, such as a reward of its own"""
    algorithm: str = "ppo"
    """one of `baselines.recipes.ALGORITHMS`; PPO is trained with the compiled engine, and the
    others with Stable-Baselines3"""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """of the algorithm, in place of the recipe's"""

    def __post_init__(self) -> None:
        self._check(check.choice, "algorithm", choices=ALGORITHMS)
        if not (isinstance(self.name, str) and self.name.isidentifier()):
            raise ValueError(f"Arm.name must be a word of letters and digits, got {self.name!r}")
        check.instance("Arm.label", self.label, str)
        for name in ("environment", "training", "learning", "parameters"):
            check.instance(f"Arm.{name}", getattr(self, name), Mapping)
            self._set(name, MappingProxyType(dict(getattr(self, name))))
        given = self.policy if self.flies is None else f"that of {self.flies}"
        learns = self.training or self.learning or self.parameters or self.algorithm != "ppo"
        if given is not None and learns:
            raise ValueError(f"Arm {self.name} must not be trained, as its policy is {given}")
        if self.policy is not None and self.flies is not None:
            raise ValueError(
                f"Arm {self.name} must have a policy, or fly that of another, not both"
            )

    @property
    def trained(self) -> bool:
        """Whether it is trained."""
        return self.policy is None and self.flies is None

    @property
    def engine(self) -> str:
        """What trains it, one of `baselines.plans.ENGINES`."""
        return "compiled" if self.algorithm == "ppo" else "sb3"


_FAR_SIGHTED = {"gamma": 0.995}
"""Without a reward for being sure, what a look is worth comes seconds later: with the recipe's 0.99
a third of the flights crashed in pilots."""
_DOUBTING = {"custom": "baselines.arm_tasks:Doubting"}

ARMS = (
    Arm(name="pd_reference", label="PD, facing as rewarded", policy="pd"),
    Arm(name="pd_features", label="PD, facing the features", policy="pd:features"),
    Arm(
        name="pd_unsure",
        label="PD, facing the features when unsure",
        policy="pd:features_when_unsure",
        environment={"include_std": True},
    ),
    Arm(name="truth", label="truth", training={"observation": "truth"}),
    Arm(name="noisy", label="truth + independent noise", training={"observation": "noisy"}),
    Arm(name="estimate", label="estimate", parameters=_FAR_SIGHTED),
    Arm(
        name="sigma",
        label="estimate + standard deviation",
        environment=_DOUBTING,
        parameters=_FAR_SIGHTED,
    ),
    Arm(
        name="memory",
        label="estimate + standard deviation + memory",
        environment={"custom": "baselines.arm_tasks:Remembering"},
        parameters=_FAR_SIGHTED,
    ),
    Arm(
        name="paid",
        label="estimate, paid for being sure",
        learning={"custom": "baselines.arm_tasks:Paid"},
    ),
    Arm(
        name="sure",
        label="estimate + standard deviation, paid for being sure",
        environment=_DOUBTING,
        learning={"custom": "baselines.arm_tasks:Sure"},
    ),
    Arm(
        name="asymmetric",
        label="estimate + standard deviation, paid for being sure, critic sees the truth",
        environment=_DOUBTING,
        learning={"custom": "baselines.arm_critics:SureForCritic"},
        parameters={"critic_only": 15},
    ),
    # paid for being sure as `paid` and `sure` are, so that these differ in what the policy knows
    Arm(
        name="recurrent",
        label="estimate, LSTM, paid for being sure",
        learning={"custom": "baselines.arm_tasks:Paid"},
        algorithm="recurrent_ppo",
    ),
)
"""Those of `QuadGym/LookAround-v0`."""

_TRUTH = {"observation": "truth"}
_SIGMAS = {"include_std": True}
_STALE = sensor_suite("stale")
_STAMPED = {
    "sensors": _STALE.replace(estimator=_STALE.estimator.replace(delay_compensation="retrodict"))
}
"""The same sensors, and a filter that knows how old their measurements are."""
_RECALLING = {"custom": "baselines.arm_tasks:RecallingRace", **_SIGMAS}

STALE_RACE = (
    Arm(name="pd", label="PD", policy="pd"),
    Arm(name="truth", label="truth", training=_TRUTH),
    Arm(name="covariance", label="estimate + 15 standard deviations", environment=_SIGMAS),
    Arm(
        name="recalling",
        label="estimate + 15 standard deviations + memory",
        environment=_RECALLING,
    ),
    Arm(
        name="residual",
        label="truth + residual model",
        environment={"custom": "baselines.arm_tasks:SeenRace"},
        training={"custom": "baselines.arm_tasks:ResidualRace", **_TRUTH},
    ),
    Arm(name="truth_on_truth", label="truth, flown on it", flies="truth", environment=_TRUTH),
    Arm(
        name="truth_stamped",
        label="truth, flown with time stamps",
        flies="truth",
        environment=_STAMPED,
    ),
    Arm(
        name="covariance_stamped",
        label="estimate + 15 standard deviations, flown with time stamps",
        flies="covariance",
        environment={**_SIGMAS, **_STAMPED},
    ),
)
"""Those of `QuadGym/StaleRace-v0`."""

_SCALED = {"custom": "baselines.arm_tasks:Scaled"}
_WARY = {"custom": "baselines.arm_tasks:Wary"}
_STEADY = {"custom": "baselines.arm_tasks:Steady"}

OUTAGE_DASH = (
    Arm(name="pd", label="PD at 4.7 m/s", policy="pd"),
    Arm(name="pd_slow", label="PD at 2.4 m/s", policy="pd:slow"),
    Arm(
        name="pd_waiting",
        label="PD that waits when unsure",
        policy="pd:waiting",
        environment=_SIGMAS,
    ),
    Arm(
        name="truth",
        label="truth",
        environment=_SCALED,
        training=_TRUTH,
        learning=_STEADY,
    ),
    Arm(name="estimate", label="estimate", environment=_SCALED, learning=_STEADY),
    Arm(
        name="sigma",
        label="estimate + doubt",
        environment=_WARY,
        learning={"custom": "baselines.arm_tasks:SteadyWary"},
    ),
    Arm(
        name="asymmetric",
        label="estimate + doubt, critic sees the truth",
        environment=_WARY,
        learning={"custom": "baselines.arm_critics:SteadyWaryForCritic"},
        parameters={"critic_only": 16},
    ),
    Arm(
        name="truth_on_truth",
        label="truth, flown on it",
        flies="truth",
        environment={**_SCALED, **_TRUTH},
    ),
)
"""Those of `QuadGym/OutageDash-v0`."""

ARMS_OF = {"look_around": ARMS, "stale_race": STALE_RACE, "outage_dash": OUTAGE_DASH}
"""By task."""
