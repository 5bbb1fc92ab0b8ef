"""`ReadableBatch`: flights whose state the views of a task can read."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.calls import Calls
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.kernels.stages import needed_stages
from quad_gym.packing.configuration import FlightConfiguration
from quad_gym.records import SHOWN, SHOWN_SHAPES, SHOWN_SIZE, Command, Result

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

_GAP = 8  #: padding between two rows of the memory: a cache line
_JUDGED = slice(int(Result.REWARD), int(Result.ENDING) + 1)


class ReadableBatch(FlightBatch):
    """`FlightBatch` with quantities that only views of a task need; methods return new arrays."""

    def __init__(self, c: FlightConfiguration, split: int) -> None:
        super().__init__(c)  # type: ignore[arg-type]
        self._split = split
        self._settings["shown"] = True
        self._stages = needed_stages(self._settings[0])
        # rows at distances of a power of two would compete for a few cache lines
        self._shown = np.zeros((SHOWN_SIZE, len(self._actions) + _GAP))
        self.period = 1.0 / self.clocks.control_rate
        self.reward_scale = self.period if self.task.reward_per == "second" else 1.0
        self.began: Truths = np.zeros(self.count, bool)
        self.judged = np.zeros((_JUDGED.stop, self.count))
        self.remember()

    began: Truths
    """True for flights that have begun an episode since the last step, (n,)."""
    judged: Floats
    """Reward, terminated, truncated and ending of the built-in task in the last step, (4, n)."""
    error_before: Floats
    """Distance from the reference before the step, (n,) [m]."""
    gates_before: Floats
    """Number of gates passed before the step, (n,)."""

    def remember(self) -> None:
        """Store the quantities that the next step is compared with."""
        self.error_before, self.gates_before = self.rows("position_error"), self.rows("gate_next")

    def gate_passed(self) -> Truths:
        """True for flights that have passed a gate in the last step, (n,)."""
        return (self.rows("gate_next") > self.gates_before) & ~self.began

    def step(self, actions: NDArray[Any] | None = None) -> NDArray[np.float32]:
        """Fly one control period; see `FlightBatch.step`."""
        self.remember()
        observations = super().step(actions)
        self.judged = self._results[_JUDGED, : self.count].copy()
        return observations

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore all flights from a snapshot."""
        super().restore(snapshot)
        flights = self._blocks.copy()
        self._resets[:] = 0
        self._run(Command.RESET)  # resets no flight, but computes `shown` and the observations
        self._blocks[:] = flights  # padding lanes of the last block have begun again
        self.remember()  # the step before is unknown: no progress, no gate passed

    def _calls_of_threads(self) -> Calls:
        calls = super()._calls_of_threads()
        calls.show_into(self._shown)
        return calls

    def shown(self, name: str) -> Floats:
        """Read a field of `quad_gym.records.SHOWN`, (n, ...)."""
        values, shape = self._shown[SHOWN[name], : self.count], SHOWN_SHAPES[name]
        if len(shape) == 1:
            return values.copy().T
        # memory layout of a single flight, so that products have the same bits in any batch
        return np.ascontiguousarray(values.T).reshape(-1, *shape)

    def rows(self, name: str, kind: type[np.generic] = np.float64) -> NDArray[Any]:
        """Read a field of the flights' records, (n, ...), as numbers of a kind."""
        values = self.record(name)
        values = values > 0.0 if kind is np.bool_ else values.astype(kind, copy=False)
        return np.asfortranarray(values) if values.ndim == 2 else values  # faster by columns

    def builtin_observation(self) -> NDArray[np.float32]:
        """Read the built-in observation without its privileged part, (n, k)."""
        return self._observations[:, : self._split].copy()

    def nominal(self) -> dict[str, Any]:
        """Parameters of the nominal camera, and the rotation from G to I, by name."""
        names = ("camera", "R_CB", "focal_length", "half_image", "R_IG")
        return {name: self._world[name][0, ..., 0] for name in names}

    def finite(self, flights: NDArray[np.intp]) -> Truths:
        """True where the true state of some flights is finite."""
        state = np.hstack([self.record(name, flights) for name in ("r", "v", "q", "w")])
        return np.isfinite(state).all(axis=1)
