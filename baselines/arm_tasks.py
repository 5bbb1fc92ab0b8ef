"""Variants of `LookAround` for the arms of a study: for training, and some for evaluation."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.tasks.look_around import LookAround
from quad_gym.tasks.task import Observed

if TYPE_CHECKING:
    from quad_gym.tasks.draws import FlightRandom
    from quad_gym.tasks.view import View

TYPICAL = 0.03
"""Standard deviation of the position of a filter that sees markers [m]."""

EVERY = 10
"""Steps between what is remembered: 0.2 s at 50 Hz."""

REMEMBERED = 4
"""How many instants are remembered."""

_SEEN = 18
"""What is remembered of each: errors of position and velocity, vertical, heading, body rates and
the direction of the features."""

Parts = dict[str, NDArray[np.float64]]


class Doubting(LookAround):
    """`LookAround` whose observation also says how sure the filter is of its position.

    As log10(sigma / TYPICAL) of the largest standard deviation, so that a network sees a doubling
    alike whether it is of millimeters or of meters.
    """

    observes: Mapping[str, Observed] = {
        **LookAround.observes,
        "log_sigma": Observed("log10", "I", -1.0, 6.0),
    }

    def observe(self, view: "View") -> Parts:
        """`features_direction` (n, 3), and `log_sigma` (n,)."""
        try:
            sigma = view.estimate.position_sigma.max(axis=1)
        except ValueError:  # no filter runs: who sees the truth has no doubt
            sigma = np.zeros(view.count)
        return {**super().observe(view), "log_sigma": np.log10(np.maximum(sigma, 1e-9) / TYPICAL)}


class Remembering(Doubting):
    """`Doubting` whose observation also has what was observed 0.2, 0.4, 0.6 and 0.8 s ago.

    At the start of an episode, the past is zero.
    """

    state: Mapping[str, ArrayLike] = {"past": np.zeros((REMEMBERED, _SEEN))}
    observes: Mapping[str, Observed] = {**Doubting.observes, "past": Observed("mixed", "B")}

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Every so often, remember the present, and forget the oldest."""
        due = (view.step % EVERY == 0)[:, np.newaxis, np.newaxis]
        seen = view.seen
        direction = LookAround.observe(self, view)["features_direction"]
        now = [seen.position_error, seen.velocity_error, seen.up, seen.heading, seen.body_rates]
        latest = np.concatenate([*now, direction], axis=1)[:, np.newaxis]
        past = view.state.past
        view.state.past = np.where(due, np.concatenate([latest, past[:, :-1]], axis=1), past)

    def observe(self, view: "View") -> Parts:
        """As `Doubting`, and `past` (n, 72)."""
        return {**super().observe(view), "past": view.state.past.reshape(view.count, -1)}


class Paid(LookAround):
    """`LookAround` that also pays for a sure filter, which the controller does not see.

    -0.3 min(sigma / 0.5 m, 1) a step, sigma the largest standard deviation of the position: it
    matters more than the heading from 0.25 m on.
    """

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) see the class."""
        sigma = view.estimate.position_sigma.max(axis=1)
        return super().reward(view) - 0.3 * np.minimum(sigma / 0.5, 1.0)


class Sure(Paid, Doubting):
    """`Doubting` that also pays for a sure filter, as `Paid` does."""
