"""Fixed rules of the studies that are no policy of `baselines`, by name.

All are PD control on the observation alone, with `include_std=True`.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.pd import MARGIN, SIGMAS, PDPolicy
from quad_gym.evaluation import Policy
from scripts.studies.arms import SLOWED
from scripts.studies.planning import LOST, PlanningPolicy

Array = NDArray[np.float64]

BACK = 3.0  #: distance before a wall to which `BacksOff` retreats from a place off the gap [m]
OPEN_AIR = 12.0  #: distance before the first wall at which `WaitsAtStart` waits [m]
SETTLED = 2.5  #: time after which the filter has converged after its start [s]
FOUND = 0.6  #: largest standard deviation of the position soon after an outage [m]


def _clearance(part: Mapping[str, Array]) -> tuple[Array, NDArray[np.bool_]]:
    """Clearance in the next gap [m], and whether the position is more uncertain; (n, 1) each."""
    room = 0.5 * part["gap_width"] - MARGIN
    return room, SIGMAS * part["position_sigma"].max(axis=1, keepdims=True) > room


class BacksOff(PDPolicy):
    """Mode "waiting" of PD control that also backs off from a wall in front of it.

    A vehicle that waits without GNSS drifts, and is somewhere else when GNSS returns. Where it then
    is closer than `BACK` to the wall and not in front of the gap, a straight line to the gap leads
    into the wall: the rule first flies to a place `BACK` before the gap.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env, pace="waiting")

    def _read(self, rows: Array) -> Any:
        part = {name: rows[:, where] for name, where in self._slices.items()}
        seen, gap = super()._read(rows), part["position_error"]
        ahead = (gap * seen.heading).sum(axis=1, keepdims=True)
        across = gap - ahead * seen.heading
        across -= (across * seen.up).sum(axis=1, keepdims=True) * seen.up
        off = np.linalg.norm(across, axis=1, keepdims=True)
        room, uncertain = _clearance(part)
        near = (ahead > 0.0) & (ahead < BACK) & (off > room) & ~uncertain
        error = np.where(near, gap - BACK * seen.heading, seen.position_error)
        return seen._replace(position_error=error)


class SlowsDown(PDPolicy):
    """PD control that flies at a share of its speed while the filter is uncertain.

    Uncertain is defined as in mode "waiting", but the vehicle stays where it is: with a share of
    zero it hovers. The shares show along which way of flying the return increases.
    """

    def __init__(self, env: Any, share: float) -> None:
        super().__init__(env)
        self._share = share

    def _read(self, rows: Array) -> Any:
        part = {name: rows[:, where] for name, where in self._slices.items()}
        seen = super()._read(rows)
        error, (_, uncertain) = seen.position_error, _clearance(part)
        distance = np.linalg.norm(error, axis=1, keepdims=True)
        limited = error * np.minimum(1.0, self._reach / np.maximum(distance, 1e-9))
        return seen._replace(position_error=np.where(uncertain, self._share * limited, error))


class WaitsAtStart(PDPolicy):
    """PD control that hovers in the open air until GNSS was lost once and is back, and then dashes.

    It shows whether one outage is all that a controller has to expect: then a single bit of memory
    is as good as a comparison of uncertainty and clearance.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._settled = round(SETTLED * env.unwrapped.flights.control_rate)
        self._lost = self._goes = np.zeros(0, bool)
        self._step = 0

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return the actions of all flights, whose episodes begin together."""
        if episode_start is not None and np.all(episode_start):
            self._lost = self._goes = np.zeros(len(observation), bool)
            self._step = 0
        action = super().predict(observation, state, episode_start, deterministic)
        self._step += 1
        return action

    def _read(self, rows: Array) -> Any:
        part = {name: rows[:, where] for name, where in self._slices.items()}
        seen = super()._read(rows)
        lost = part["velocity_sigma"][:, :2].max(axis=1) > LOST
        self._lost = self._lost | (lost & (self._step > self._settled))
        known = ~lost & (part["position_sigma"].max(axis=1) < FOUND)
        self._goes = self._goes | (self._lost & known)
        hold = part["position_error"] - OPEN_AIR * seen.heading
        error = np.where(self._goes[:, np.newaxis], seen.position_error, hold)
        return seen._replace(position_error=error)


RULES: Mapping[str, Callable[[Any], Policy]] = {
    "planning": PlanningPolicy,
    "backs_off": BacksOff,
    "waits_at_start": WaitsAtStart,
    **{f"slows_to_{share}": partial(SlowsDown, share=0.01 * share) for share in SLOWED},
}
"""Rules by name, made for an environment."""
