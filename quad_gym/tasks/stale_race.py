"""`StaleRace`: a race with sensor latency that the filter does not model."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.params.task import RewardParams
from quad_gym.tasks.rewards import ActionRate, BodyRates, Crash, GatePassed, Progress, Term
from quad_gym.tasks.task import Task

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

PROGRESS_WEIGHT = 0.1
"""Weight of the speed toward the next gate: a race at 4 m/s earns 0.4 per step."""

GATE_REWARD = 1.0  #: reward for each gate passed, so that flying past a gate is not worthwhile
CRASH_COST = 5.0  #: cost of a crash, as much as five gates


class StaleRace(Task):
    """Race through gates with sensor latency that the filter does not model.

    Eight gates lie on a course that is drawn for each episode, as in `Waypoints`; a gate is passed
    within 0.6 m of its center. GNSS is delayed by 120 ms, as of receivers of hobby vehicles, and
    images by 10 ms. The filter ignores these delays, as many filters do. Their effect depends on
    the controller: at rest a delayed position is correct, at 4 m/s it is off by 0.5 m, many times
    the standard deviation that the filter assumes, so that attitude and biases become wrong as
    well. The faster the flight, the worse the estimate.

    With `sensors` whose filter uses the time stamps (`delay_compensation="retrodict"`) the same
    race is easy; this is the control condition of the experiment.

    ## Reward
    In each step, with the speed s toward the next gate [m/s], the norm d of the change of the
    action and the norm w of the body rates [rad/s]

        0.1 s - 0.02 d^2 - 0.002 w^2 + 1 (passed a gate) - 5 (crashed)

    ## Observation
    The observation of `Waypoints`: the observed position of the next gate relative to the vehicle,
    in the body frame, and the two gates after it.

    ## Endings
    The endings of `Waypoints`: the last gate, a time limit of 20 s, and a distance of 12 m from the
    next gate.

    Args:
        crash_cost: Cost of a crash.

    Raises:
        ValueError: If it is negative or not finite.
    """

    def __init__(self, crash_cost: float = CRASH_COST) -> None:
        costs = RewardParams()
        self._terms: dict[str, Term] = {
            "progress": PROGRESS_WEIGHT * Progress(),
            "action_rate": -costs.action_rate * ActionRate(),
            "body_rates": -costs.body_rates * BodyRates(),
            "crash": -check.number("crash_cost", crash_cost, least=0.0) * Crash(),
        }
        self._gate: Term = GATE_REWARD * GatePassed()

    def reward(self, view: "View") -> dict[str, NDArray[np.float64]]:
        """Return the terms of the reward described in the class, (n,) each."""
        terms = {name: term(view) for name, term in self._terms.items()}
        return terms | {"gate_passed": view.period * self._gate(view)}
