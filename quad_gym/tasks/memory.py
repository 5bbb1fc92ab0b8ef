"""`ReadableBatch`: flights that show each instant to the views of a task.

The compiled code writes what is shown; views look into that memory, without a copy. Rewards and
endings of a task are written by `quad_gym.kernels.task.settle`.
"""

from sys import getrefcount
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.calls import Calls
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.kernels.compiling import Stage
from quad_gym.kernels.compiling.linked import SETTLE
from quad_gym.records import SHOWN, SHOWN_SIZE, WIDTH, Command
from quad_gym.tasks.lazy import Place, Shown

Floats = NDArray[np.float64]

_GAP = 8
"""Numbers between two rows of what is shown: a line of the cache."""
_TIME = SHOWN["time"].start
_COMPARED = slice(SHOWN["position_error"].start, SHOWN["gate_next"].stop)
"""What a step is compared with the one before in."""


def _references_of_one() -> int:
    """References of one array of a view; measured, as interpreters differ."""
    memory = np.zeros(1)
    before = getrefcount(memory)
    looking: list[Floats] = [memory[:]]
    kept = (looking, {"": looking[0]})  # as `look` does
    return getrefcount(memory) - before + sum(map(getrefcount, kept[0]))


_REFERENCES_OF_ONE = _references_of_one()


class ReadableBatch(FlightBatch):
    """A `FlightBatch` with what the views of a task read.

    `shown` is memory that the next step overwrites, unless somebody keeps an array of it: then the
    step writes to other memory. The arrays of views stay as long as their memory. Other fields are
    read as new arrays.
    """

    def __init__(self, count: int, **keywords: Any) -> None:
        super().__init__(count, **keywords)
        self._settings["shown"] = True
        self._stages |= {Stage.SHOW}
        self._entries.append(SETTLE)
        self._fields: dict[str, NDArray[Any]] = {}
        self._looking: list[NDArray[Any]] = []
        self._places: list[Place] = []
        self._bare_references = 0
        # rows that lie a power of two apart would share a few lines of the cache
        self._look_into(np.empty((SHOWN_SIZE, len(self._blocks) * WIDTH + _GAP)))

    shown: Floats
    """(SHOWN_SIZE, n) of `quad_gym.records.SHOWN` at the present instant; read-only"""
    _own_references: int
    """To what is shown, and to the arrays that look into it, where nobody else keeps any."""

    def _look_into(self, memory: Floats) -> None:
        """Let `shown` be what other memory holds."""
        for arrays, name in self._places:
            del arrays[name]
        self._places, self._looking = [], []
        self._own_references = self._bare_references
        self._shown, self.shown = memory, memory[:, : self.count]
        self.shown.setflags(write=False)
        self.time_shown, self.compared_shown = self.shown[_TIME], self.shown[_COMPARED]

    def look(self, at: Shown, place: dict[str, Any], name: str) -> NDArray[Any]:
        """An array (n, ...) that looks into what is shown, and stays as long as its memory.

        Args:
            at: What it looks at.
            place: Attributes that are to have it.
            name: Its name in them.
        """
        array = at.into(self.shown)
        place[name] = array
        self._looking.append(array)
        self._places.append((place, name))
        self._own_references += _REFERENCES_OF_ONE
        return array

    def _references(self) -> int:
        """How many references there are to what is shown, and to the arrays that look into it."""
        return getrefcount(self._shown) + sum(map(getrefcount, self._looking))

    def _run(self, command: Command) -> NDArray[np.float32]:
        if self._crew is not None and self._references() > self._own_references:
            # somebody keeps what was shown
            self._crew.gather()  # nobody may still write to the memory that goes
            self._look_into(np.empty_like(self._shown))
            self._calls.show_into(self._shown)
        return super()._run(command)

    def _calls_of_threads(self) -> Calls:
        calls = super()._calls_of_threads()
        self._look_into(np.empty_like(self._shown))  # nobody else knows of it yet
        calls.show_into(self._shown)
        self._bare_references = self._own_references = self._references()
        return calls

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Bring all flights back to a snapshot; `shown` is of its instant then.

        Raises:
            ValueError: If the snapshot is of another size or kind.
        """
        super().restore(snapshot)
        self._resets[:] = 0
        self._run(Command.RESET)  # of no flight, which shows and observes all of them
        self._blocks[:] = snapshot  # what fills the last block has begun anew

    def __getstate__(self) -> dict[str, Any]:
        """All but the arrays that look into its memory, which a copy makes anew."""
        looking: dict[str, Any] = {"_fields": {}, "_places": [], "_looking": []}
        looking |= {"shown": None, "time_shown": None, "compared_shown": None}
        return super().__getstate__() | looking

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Look into memory of its own."""
        self.__dict__.update(state)
        self._look_into(self._shown)

    def _field(self, name: str) -> NDArray[Any]:
        """A field of the flights' records, (blocks, ..., lanes), found once."""
        field = self._fields.get(name)
        if field is None:
            field = self._fields[name] = self._blocks[name]
        return field

    def columns(self, name: str) -> NDArray[Any]:
        """A field of the flights' records as a new array (..., n)."""
        if name not in self._fields and not self._room.holds(name):
            return np.ascontiguousarray(np.moveaxis(self.read(name), 0, -1))
        values = self._field(name)
        if values.ndim == 2:
            return values.flatten()[: self.count]
        last = values.ndim - 1
        values = values.transpose(*range(1, last), 0, last).copy()
        return values.reshape(*values.shape[:-2], -1)[..., : self.count]

    def rows(self, name: str) -> NDArray[Any]:
        """A field of the flights' records as a new array (n, ...)."""
        if name not in self._fields and not self._room.holds(name):
            return self.read(name)
        values = self._field(name)
        if values.ndim == 3:
            return self.columns(name).T
        last = values.ndim - 1
        values = values.transpose(0, last, *range(1, last))
        return values.reshape(-1, *values.shape[2:])[: self.count]

    def counts(self, name: str) -> NDArray[np.int64]:
        """A field of the flights' records as whole numbers, (n,)."""
        values = self._field(name).astype(np.int64).reshape(-1)
        return values if len(values) == self.count else values[: self.count]

    def write(self, name: str, values: NDArray[Any]) -> None:
        """Write a field of the flights' records, (n,)."""
        field = self._field(name)
        if values.size == field.size:
            field[:] = values.reshape(field.shape)
            return
        lanes = field.flatten()
        lanes[: self.count] = values
        field[:] = lanes.reshape(field.shape)

    def gates(self) -> Floats:
        """(n, gates, 3) of a course in I [m]; none elsewhere."""
        if self.task.kind != "waypoints":
            return np.zeros((self.count, 0, 3))
        return self.rows("gates")[:, : self.task.gate_count]

    def obstacle_centers(self) -> Floats:
        """(n, k, 3) where the middles of the world's obstacles are in I [m]."""
        count = len(self.world.obstacles)
        if not count:
            return np.zeros((self.count, 0, 3))
        return np.ascontiguousarray(self.rows("obstacle_center")[:, :count])

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
