"""Variants of tasks whose observation in training ends with the truth, for the critic only.

With `critic_only` among the parameters of the compiled PPO, the value function receives these
values and the policy does not (asymmetric actor-critic): the policy flies the task without them.
The value function can then use information that determines future rewards, such as the estimation
error, while the policy uses only information available to a controller.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from baselines.arm_tasks import Parts, scaled_parts
from quad_gym.tasks.outage_dash import gaps_behind, gaps_of
from quad_gym.tasks.task import ObservationSpec
from scripts.studies.arm_tasks import ConstantCrashCostWithUncertainty, WithStdCertaintyReward

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

_TRUE: Mapping[str, ObservationSpec] = {
    "actual_position_error": ObservationSpec("m", "B"),
    "actual_velocity_error": ObservationSpec("m/s", "B"),
    "actual_up": ObservationSpec("-", "B"),
    "actual_heading": ObservationSpec("-", "B"),
    "actual_body_rates": ObservationSpec("rad/s", "B"),
}
_SCALED_TRUE: Mapping[str, ObservationSpec] = {
    "actual_position_error_scaled": ObservationSpec("-", "B"),
    "actual_velocity_error_scaled": ObservationSpec("-", "B"),
    "actual_up": ObservationSpec("-", "B"),
    "actual_heading": ObservationSpec("-", "B"),
    "actual_body_rates_scaled": ObservationSpec("-", "B"),
    "gnss_fails": ObservationSpec("0 or 1", "-"),
}


class WithStdCertaintyRewardForCritic(WithStdCertaintyReward):
    """`WithStdCertaintyReward` that also observes the true state relative to the reference.

    The additional parts are the true values of position error, velocity error, vertical, heading
    and body rates.
    """

    privileged = True
    observes: Mapping[str, ObservationSpec] = {**WithStdCertaintyReward.observes, **_TRUE}

    def observe(self, view: "View") -> Parts:
        """Return the base's observation, and five parts (n, 3) of the truth."""
        return {**super().observe(view), **_true_state(view, view.reference_position)}


class ConstantCrashCostWithUncertaintyForCritic(ConstantCrashCostWithUncertainty):
    """`ConstantCrashCostWithUncertainty` that also observes the truth relative to the next gap.

    The next gap is determined by the true position. The values have the same scales as the
    estimate, and `gnss_fails` is 1 while GNSS fails.
    """

    privileged = True
    observes: Mapping[str, ObservationSpec] = {
        **ConstantCrashCostWithUncertainty.observes,
        **_SCALED_TRUE,
    }

    def observe(self, view: "View") -> Parts:
        """Return the base's observation, five parts (n, 3) of the truth, and `gnss_fails` (n,)."""
        gaps = gaps_of(view)
        gap = gaps.centers[np.arange(view.count), gaps_behind(gaps, view.position)]
        fails = view.truth.faults["gnss_outage"].astype(np.float64)
        true = scaled_parts(_true_state(view, gap))
        return {**super().observe(view), **true, "gnss_fails": fails}


def _true_state(view: "View", target: NDArray[np.float64]) -> Parts:
    """Parts of `_TRUE`, (n, 3) each, relative to target positions (n, 3) in I."""

    def in_body(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.ascontiguousarray((view.R_BI @ vectors[:, :, np.newaxis])[:, :, 0])

    return {
        "actual_position_error": in_body(target - view.position),
        "actual_velocity_error": in_body(view.reference_velocity - view.velocity),
        "actual_up": view.truth.up,
        "actual_heading": in_body(view.reference_heading),
        "actual_body_rates": view.body_rates,
    }
