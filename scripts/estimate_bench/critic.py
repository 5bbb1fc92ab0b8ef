"""Task whose observation in training ends with the truth, for the critic only."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from quad_gym.tasks.task import ObservationSpec, Task

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

SIZE = 15  #: number of values that the critic receives in addition


class ForCritic(Task):
    """Any task, laid under this one, with the true state relative to the reference."""

    privileged = True
    observes: Mapping[str, ObservationSpec] = {
        "actual_position_error": ObservationSpec("m", "B"),
        "actual_velocity_error": ObservationSpec("m/s", "B"),
        "actual_up": ObservationSpec("-", "B"),
        "actual_heading": ObservationSpec("-", "B"),
        "actual_body_rates": ObservationSpec("rad/s", "B"),
    }

    def observe(self, view: "View") -> dict[str, NDArray[np.float64]]:
        """Return the five parts of the truth, (n, 3) each."""

        def in_body(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.ascontiguousarray((view.R_BI @ vectors[:, :, np.newaxis])[:, :, 0])

        return {
            "actual_position_error": in_body(view.reference_position - view.position),
            "actual_velocity_error": in_body(view.reference_velocity - view.velocity),
            "actual_up": view.truth.up,
            "actual_heading": in_body(view.reference_heading),
            "actual_body_rates": view.body_rates,
        }
