"""Variants of tasks that end the observation in training with the truth, for the critic alone.

With `critic_only` among the parameters of the compiled PPO, the value function sees these numbers,
and the policy does not: it flies the task without them. The value function then learns from what
decides about the rewards to come, such as how far off the estimate is, and the policy learns from
what a controller can know.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from baselines.arm_tasks import (
    ConstantCrashCostWithUncertainty,
    Parts,
    WithStdCertaintyReward,
    scaled_parts,
)
from quad_gym.tasks.outage_dash import gaps_behind, gaps_of
from quad_gym.tasks.task import ObservationSpec

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
    """`WithStdCertaintyReward` that observes the true state relative to the reference, too.

    What the estimate shows of position and velocity error, vertical, heading and body rates, as it
    truly is.
    """

    privileged = True
    observes: Mapping[str, ObservationSpec] = {**WithStdCertaintyReward.observes, **_TRUE}

    def observe(self, view: "View") -> Parts:
        """As `WithStdCertaintyReward`, and five parts (n, 3) of the truth."""
        return {**super().observe(view), **_true_state(view, view.reference_position)}


class ConstantCrashCostWithUncertaintyForCritic(ConstantCrashCostWithUncertainty):
    """`ConstantCrashCostWithUncertainty` that observes the truth relative to the next gap, too.

    The gap is the one that is truly next. The numbers are scaled as those of the estimate are, and
    `gnss_fails` is 1 while GNSS fails.
    """

    privileged = True
    observes: Mapping[str, ObservationSpec] = {
        **ConstantCrashCostWithUncertainty.observes,
        **_SCALED_TRUE,
    }

    def observe(self, view: "View") -> Parts:
        """As its base, five parts (n, 3) of the truth, and `gnss_fails` (n,)."""
        gaps = gaps_of(view)
        gap = gaps.centers[np.arange(view.count), gaps_behind(gaps, view.position)]
        fails = view.truth.faults["gnss_outage"].astype(np.float64)
        true = scaled_parts(_true_state(view, gap))
        return {**super().observe(view), **true, "gnss_fails": fails}


def _true_state(view: "View", target: NDArray[np.float64]) -> Parts:
    """The parts of _TRUE, (n, 3) each, for a vehicle that is to be at targets (n, 3) in I."""

    def in_body(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.ascontiguousarray((view.R_BI @ vectors[:, :, np.newaxis])[:, :, 0])

    return {
        "actual_position_error": in_body(target - view.position),
        "actual_velocity_error": in_body(view.reference_velocity - view.velocity),
        "actual_up": view.truth.up,
        "actual_heading": in_body(view.reference_heading),
        "actual_body_rates": view.body_rates,
    }
