"""`LookAround`: a task in which the position is known only as well as the camera looks."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.tasks.rewards import Crash, Heading, Term, Tracking
from quad_gym.tasks.task import ObservationSpec, Task

if TYPE_CHECKING:
    from quad_gym.params.sensors import SensorSuite
    from quad_gym.params.world import WorldParams
    from quad_gym.tasks.view import View

WIDE_WEIGHT, NEAR_WEIGHT = 0.1, 0.1
"""Of exp(-e) and exp(-5 e): the first still pulls a vehicle back that has been lost for a while."""

HEADING_WEIGHT = 0.15
"""Of the heading. With 0.05 a rule that always faces the wall is as good as one that glances, with
0.2 a rule that never looks is nearly as good as one that always does."""

CRASH_COST = 2.0
"""Once, as much as ten steps of perfect tracking; a crash also costs the time that was left."""


class LookAround(Task):
    """Follow a random trajectory and look in the rewarded direction, without getting lost.

    There is no GNSS. All eight markers hang on one wall, 8 m west of the origin, the camera sees 60
    degrees, and the IMU is a cheap one: within seconds of looking away, the filter's position is
    off by decimeters, and after ten by meters. Looking at the markers costs reward, which pays
    for a heading that is drawn for each episode.

    ## Reward
    In each step, with the true position error e [m] and the alignment h of body x with the wanted
    heading (1: aligned, -1: opposite)

        0.1 exp(-e) + 0.1 exp(-5 e) + 0.15 h - 2 (crashed)

    At most 0.35 a step, so 262.5 in an episode of 750 steps.

    ## Observation
    The built-in one, and then `features_direction` (3): the unit vector from the vehicle to the
    middle of the markers in the body frame, both as the controller sees them.

    ## Endings
    Those of `QuadEnv`, with 8 m to the reference as the bound: a controller that is mistaken about
    its position has time to find it again. There is no ground above -5 m.

    Simple rules fail: PD control of the wanted heading gets lost in two thirds of the episodes, and
    PD control that faces the wall forgoes the reward of the heading.

    Args:
        heading_weight: Of h in the reward.
        crash_cost: What a crash costs, once.

    Raises:
        ValueError: If a number is negative or not finite.
    """

    observes: Mapping[str, ObservationSpec] = {
        "features_direction": ObservationSpec("-", "B", -1.0, 1.0)
    }

    def __init__(
        self, heading_weight: float = HEADING_WEIGHT, crash_cost: float = CRASH_COST
    ) -> None:
        self.pieces: Term = (
            WIDE_WEIGHT * Tracking(1.0)
            + NEAR_WEIGHT * Tracking(5.0)
            + check.number("heading_weight", heading_weight, least=0.0) * Heading()
            - check.number("crash_cost", crash_cost, least=0.0) * Crash()
        )

    def _require(self, sensors: "SensorSuite", world: "WorldParams") -> None:
        if sensors.camera is None:
            raise ValueError(
                "sensors must have a camera for LookAround, which observes the direction of the "
                "markers, got none: choose sensors that have one, and no camera=False"
            )

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) see the class."""
        return self.pieces(view)

    def observe(self, view: "View") -> dict[str, NDArray[np.float64]]:
        """`features_direction`: (n, 3) unit vector to the middle of the markers, in B."""
        gap = view.features.mean(axis=1) - view.observed.position
        gap /= np.maximum(np.sqrt((gap * gap).sum(axis=1, keepdims=True)), 1e-9)
        return {"features_direction": (view.observed.R_BI @ gap[:, :, np.newaxis])[:, :, 0]}
