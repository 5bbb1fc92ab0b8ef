"""`LookAround`: a task in which position accuracy depends on the camera's view of markers."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.tasks.rewards import Crash, Heading, Term, Tracking
from quad_gym.tasks.task import ObservationSpec, Task

if TYPE_CHECKING:
    from quad_gym.params.suites import SensorSuite
    from quad_gym.params.world import WorldParams
    from quad_gym.tasks.view import View

WIDE_WEIGHT, NEAR_WEIGHT = 0.1, 0.1
"""Weights of exp(-e) and exp(-5 e); the first still rewards coming closer at errors of meters."""

HEADING_WEIGHT = 0.15
"""Weight of the heading. With 0.05, a rule that always faces the wall is as good as one that
glances; with 0.2, a rule that never looks is nearly as good as one that always does."""

CRASH_COST = 2.0
"""Cost of a crash, as much as ten steps of perfect tracking; it also loses later rewards."""


class LookAround(Task):
    """Follow a random trajectory and face the rewarded heading without losing the position.

    There is no GNSS. All eight markers are on one wall, 8 m west of the origin. The camera has a
    field of view of 60 degrees, and the IMU is a low-cost one: the filter's position error grows to
    decimeters within seconds of looking away from the markers, and to meters within ten seconds.
    Looking at the markers costs reward, because the reward favors a heading that is drawn for each
    episode.

    ## Reward
    In each step, with the true position error e [m] and the alignment h of body x with the desired
    heading (1: aligned, -1: opposite)

        0.1 exp(-e) + 0.1 exp(-5 e) + 0.15 h - 2 (crashed)

    At most 0.35 per step, so 262.5 in an episode of 750 steps. Neither of two simple rules gets
    it: PD control that tracks the desired heading loses its position in two thirds of the
    episodes, and PD control that faces the wall forgoes the reward for the heading.

    ## Observation
    The built-in observation, followed by `features_direction` (3): the unit vector from the
    observed position to the center of the markers, in the observed body frame.

    ## Endings
    The endings of `QuadEnv`, with a bound of 8 m on the distance from the reference, so that a
    controller with a wrong position estimate has time to recover. The minimum height is -5 m.

    Args:
        heading_weight: Weight of h in the reward.
        crash_cost: Cost of a crash.

    Raises:
        ValueError: If a number is negative or not finite.
    """

    observes: Mapping[str, ObservationSpec] = {
        "features_direction": ObservationSpec("-", "B", -1.0, 1.0)
    }

    def __init__(
        self, heading_weight: float = HEADING_WEIGHT, crash_cost: float = CRASH_COST
    ) -> None:
        self._terms: dict[str, Term] = {
            "wide": WIDE_WEIGHT * Tracking(1.0),
            "near": NEAR_WEIGHT * Tracking(5.0),
            "heading": check.number("heading_weight", heading_weight, least=0.0) * Heading(),
            "crash": -check.number("crash_cost", crash_cost, least=0.0) * Crash(),
        }

    def _require(self, sensors: "SensorSuite", world: "WorldParams") -> None:
        if sensors.camera is None:
            raise ValueError(
                "sensors must have a camera for LookAround, which observes the direction of the "
                "markers, got none: choose sensors that have one, and no camera=False"
            )

    def reward(self, view: "View") -> dict[str, NDArray[np.float64]]:
        """Return the terms of the reward described in the class, (n,) each."""
        return {name: term(view) for name, term in self._terms.items()}

    def observe(self, view: "View") -> dict[str, NDArray[np.float64]]:
        """Return `features_direction`: unit vector to the center of the markers, (n, 3) in B."""
        gap = view.features.mean(axis=1) - view.observed.position
        gap /= np.maximum(np.sqrt((gap * gap).sum(axis=1, keepdims=True)), 1e-9)
        return {"features_direction": (view.observed.R_BI @ gap[:, :, np.newaxis])[:, :, 0]}
