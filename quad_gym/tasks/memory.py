"""Flights whose memory a view reads, and a task writes its judgment to."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.kernels.task.show import show
from quad_gym.records import SHOWN_SIZE, WIDTH

Floats = NDArray[np.float64]


class ReadableBatch(FlightBatch):
    """A `FlightBatch` with what the views of a task read, as new arrays of all flights."""

    _shown: Floats | None = None

    def show_anew(self) -> None:
        """Take notice that the flights have gone on."""
        self._shown = None

    @property
    def shown(self) -> Floats:
        """(SHOWN_SIZE, n) the numbers of `quad_gym.records.SHOWN` at the present instant."""
        if self._shown is None:
            shown = np.empty((SHOWN_SIZE, len(self._blocks) * WIDTH))
            calls = getattr(self, "_calls", None) or self._calls_of_threads()
            show(calls.words, shown)
            self._shown = shown[:, : self.count]
            self._shown.flags.writeable = False
        return self._shown

    def columns(self, name: str) -> NDArray[Any]:
        """A field of the flights' records as a new array (..., n)."""
        if name not in (self._blocks.dtype.fields or {}):
            return np.ascontiguousarray(np.moveaxis(self.read(name), 0, -1))
        values = self._blocks[name]
        if values.ndim == 2:
            return values.flatten()[: self.count]
        last = values.ndim - 1
        values = values.transpose(*range(1, last), 0, last).copy()
        return values.reshape(*values.shape[:-2], -1)[..., : self.count]

    def rows(self, name: str) -> NDArray[Any]:
        """A field of the flights' records as a new array (n, ...)."""
        values = self.columns(name)
        return values.T if values.ndim == 2 else np.ascontiguousarray(np.moveaxis(values, -1, 0))

    def write(self, name: str, values: NDArray[Any]) -> None:
        """Write a field of the flights' records, (n,)."""
        field = self._blocks[name]
        if values.size == field.size:
            field[:] = values.reshape(field.shape)
            return
        lanes = field.flatten()
        lanes[: self.count] = values
        field[:] = lanes.reshape(field.shape)

    def gates(self) -> Floats:
        """(n, gates, 3) of a course in I [m]; none elsewhere."""
        gates = self.task.gate_count if self.task.kind == "waypoints" else 0
        return self.rows("gates")[:, :gates]

    def nominal(self) -> dict[str, Any]:
        """Numbers of the nominal sensors."""
        names = ("camera", "R_CB", "focal_length", "half_image", "R_IG")
        return {name: self._world[name][0, ..., 0] for name in names}

    def finite(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(n,) whether the true state of flights is finite; looked at where `chosen`."""
        finite = np.ones(self.count, bool)
        flights = np.flatnonzero(chosen)
        state = np.concatenate([self.read(name, flights) for name in ("r", "v", "q", "w")], axis=1)
        finite[flights] = np.isfinite(state).all(axis=1)
        return finite
