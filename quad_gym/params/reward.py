"""Weights of the built-in rewards."""

from dataclasses import fields
from typing import Annotated

from quad_gym.params import checks as check
from quad_gym.params.checked import Checked
from quad_gym.records import RewardTerm

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

    def require_effect(self, kind: str) -> None:
        """Refuse changed weights of terms that the reward of a kind of task does not have."""
        used = {term.name.lower() for term in self.terms(kind)}
        for field in fields(self):
            changed = getattr(self, field.name) != field.default
            if changed and field.name.removesuffix("_decay") not in used:
                raise ValueError(f"RewardParams.{field.name} has no effect on the task {kind}")
