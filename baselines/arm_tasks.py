"""Variants of `LookAround` that arms of a study are trained in."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.tasks.look_around import LookAround
from quad_gym.tasks.rewards import Uncertainty
from quad_gym.tasks.task import Observed

if TYPE_CHECKING:
    from quad_gym.tasks.draws import FlightRandom
    from quad_gym.tasks.view import View

EVERY = 10
"""Steps between what is remembered: 0.2 s at 50 Hz."""

REMEMBERED = 4
"""How many instants are remembered."""

_SEEN = 18
"""What is remembered of each: errors of position and velocity, vertical, heading, body rates and
the direction of the features."""


class Remembering(LookAround):
    """`LookAround` whose observation also has what was observed 0.2, 0.4, 0.6 and 0.8 s ago.

    At the start of an episode, the past is zero.
    """

    state: Mapping[str, ArrayLike] = {"past": np.zeros((REMEMBERED, _SEEN))}
    observes: Mapping[str, Observed] = {**LookAround.observes, "past": Observed("mixed", "B")}

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Every so often, remember the present, and forget the oldest."""
        due = (view.step % EVERY == 0)[:, np.newaxis, np.newaxis]
        seen = view.seen
        direction = super().observe(view)["features_direction"]
        now = [seen.position_error, seen.velocity_error, seen.up, seen.heading, seen.body_rates]
        latest = np.concatenate([*now, direction], axis=1)[:, np.newaxis]
        past = view.state.past
        view.state.past = np.where(due, np.concatenate([latest, past[:, :-1]], axis=1), past)

    def observe(self, view: "View") -> dict[str, NDArray[np.float64]]:
        """`features_direction` (n, 3), and `past` (n, 72)."""
        return {**super().observe(view), "past": view.state.past.reshape(view.count, -1)}


class Sure(LookAround):
    """`LookAround` that also pays for a sure filter: -0.3 of the position's variance [m^2].

    At most 0.1 a step, so that to be lost for good does not make a crash worth while.
    """

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) see the class."""
        return super().reward(view) - np.minimum(0.3 * Uncertainty("position")(view), 0.1)
