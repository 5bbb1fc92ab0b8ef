"""`StaleRace`: a race on measurements that are older than the filter takes them for."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.tasks.rewards import ActionRate, BodyRates, Crash, GatePassed, Progress, Term
from quad_gym.tasks.task import Task

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

PROGRESS_WEIGHT = 0.1
"""Of the speed toward the next gate: a race at 4 m/s earns 0.4 a step by it."""

GATE_REWARD = 1.0
"""Once for each gate, as much as half a meter of progress: fast flight past a gate does not pay."""

CRASH_COST = 5.0
"""Once, as much as five gates."""


class StaleRace(Task):
    """Race through gates on measurements that are older than the filter takes them for.

    Eight gates lie on a course that is drawn for each episode, as in `Waypoints`; one is passed
    within 0.6 m of its center. GNSS is 40 ms late and images are 10 ms late, which is little, and
    the filter takes both for fresh, as many do. The cost depends on the controller: at rest a late
    measurement is right, at 4 m/s it is off by 16 cm, many times what the filter expects, so that
    attitude and biases go wrong as well. The faster the flight, the worse the estimate.

    With `sensors` whose filter uses the time stamps (`delay_compensation="retrodict"`) the same
    race is easy; that is the control.

    ## Reward
    In each step, with the speed s toward the next gate [m/s], the size d of the change of the
    action and the size w of the body rates [rad/s]

        0.1 s - 0.02 d^2 - 0.002 w^2 + 1 (passed a gate) - 5 (crashed)

    ## Observation
    That of `Waypoints`: the next gate relative to the vehicle in the body frame as the controller
    sees it, and the two gates after it.

    ## Endings
    Those of `Waypoints`: the last gate, 20 s, and 12 m from the next gate.

    Args:
        crash_cost: What a crash costs, once.

    Raises:
        ValueError: If it is negative or not finite.
    """

    def __init__(self, crash_cost: float = CRASH_COST) -> None:
        self._costs: Term = (
            PROGRESS_WEIGHT * Progress()
            - 0.02 * ActionRate()
            - 0.002 * BodyRates()
            - check.number("crash_cost", crash_cost, least=0.0) * Crash()
        )
        self._gate: Term = GATE_REWARD * GatePassed()

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) see the class."""
        return self._costs(view) + view.period * self._gate(view)
