"""`ReadableBatch`: flights that show each instant to the views of a task.

The compiled code writes what is shown to one block of memory, and arrays of views are NumPy views
of it, without a copy. Rewards and endings of a task are written by `quad_gym.kernels.task.settle`.

An array that a task keeps must not change in the next step. Before each step, counts of references
tell whether somebody keeps one, and then the step writes to other memory. The invariant: while
nobody keeps any, each array that was handed out is referred to by the list of these and by its
attribute alone, and the memory by the batch, its calls and the arrays in that list alone. Any
further reference, such as from a slice, which NumPy lets refer to the memory itself, makes a count
larger. An array that is in no list counts as kept, so an interrupt or a second thread can cost
memory, but never show an old instant. Weak references are not counted.
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
from quad_gym.tasks.lazy import Attribute, Shown

Floats = NDArray[np.float64]

_GAP = 8
"""Numbers between two rows of what is shown: a line of the cache."""
_TIME = SHOWN["time"].start
_COMPARED = slice(SHOWN["position_error"].start, SHOWN["gate_next"].stop)
"""What a step is compared with the one before in."""
COMPARED_ERROR = SHOWN["position_error"].start - _COMPARED.start
"""The row of the position's error among what is compared."""
COMPARED_GATES = SHOWN["gate_next"].start - _COMPARED.start
"""The row of the gates passed."""


def _references_unless_kept() -> int:
    """To an array that was handed out; measured, as interpreters count differently."""
    attributes = {"": np.zeros(1)}
    return max(map(getrefcount, [attributes[""]]))


_UNLESS_KEPT = _references_unless_kept()


class ReadableBatch(FlightBatch):
    """A `FlightBatch` with what the views of a task read.

    `shown` is memory that the next step overwrites, unless somebody keeps an array of it: then the
    step writes to other memory. Arrays of views are handed out once for each memory, as making
    them in every step would take longer than the rest of a small task. Other fields are read as
    new arrays.
    """

    def __init__(self, count: int, **keywords: Any) -> None:
        super().__init__(count, **keywords)
        self._settings["shown"] = True
        self._stages |= {Stage.SHOW}
        self._entries.append(SETTLE)
        self._fields: dict[str, NDArray[Any]] = {}
        self._handed_out: list[NDArray[Any]] = []
        self._attributes: list[Attribute] = []
        self._memory_references = 0
        # rows that lie a power of two apart would share a few lines of the cache
        self._use_memory(np.zeros((SHOWN_SIZE, len(self._blocks) * WIDTH + _GAP)))

    shown: Floats
    """(SHOWN_SIZE, n) of `quad_gym.records.SHOWN` at the present instant; read-only"""
    _handed_out: list[NDArray[Any]]
    """Arrays of the present memory, each of which is an attribute of a view."""
    _attributes: list[Attribute]
    """All attributes that may hold an array of the present memory."""
    _memory_references: int
    """To the memory, without those of arrays that were handed out."""

    def _use_memory(self, memory: Floats) -> None:
        """Show what this memory holds from now on."""
        for group, name in self._attributes:
            group.pop(name, None)
        self._attributes, self._handed_out = [], []
        memory.setflags(write=False)  # no array of it can be made writable then
        self._memory, self.shown = memory, memory[:, : self.count]
        self.time_shown, self.compared_shown = self.shown[_TIME], self.shown[_COMPARED]

    def _change_memory(self, calls: Calls) -> None:
        """Leave the present memory to those who keep it, and use a copy."""
        self._memory_references = 0  # whatever interrupts this, the next step does it again
        self._use_memory(self._memory.copy())
        calls.show_into(self._memory)
        self._memory_references = getrefcount(self._memory)

    def hand_out(self, field: Shown, group: dict[str, Any], name: str) -> NDArray[Any]:
        """Make an array (n, ...) of the present memory an attribute, until the memory changes.

        Args:
            field: What it holds.
            group: The attributes of a group.
            name: Its name in them.
        """
        self._attributes.append((group, name))  # first, so that it is dropped whatever happens
        made = field.part_of(self.shown)
        array = group.setdefault(name, made)
        if array is made:  # no other thread was faster
            self._handed_out.append(array)
        return array

    def _is_kept(self) -> bool:
        """Whether anybody keeps an array of the present memory."""
        arrays = self._handed_out
        return (
            getrefcount(self._memory) - len(arrays) > self._memory_references
            or max(map(getrefcount, arrays), default=0) > _UNLESS_KEPT
        )

    def _run(self, command: Command) -> NDArray[np.float32]:
        if self._crew is not None and self._is_kept():
            self._crew.gather()  # nobody may still write to the memory that goes
            self._change_memory(self._calls)
        return super()._run(command)

    def _calls_of_threads(self) -> Calls:
        calls = super()._calls_of_threads()
        self._change_memory(calls)
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
        """All but the arrays of its memory, which a copy makes anew."""
        arrays: dict[str, Any] = {"_fields": {}, "_attributes": [], "_handed_out": []}
        arrays |= {"shown": None, "time_shown": None, "compared_shown": None}
        return super().__getstate__() | arrays

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Use memory of its own."""
        self.__dict__.update(state)
        self._use_memory(self._memory)

    def _field(self, name: str) -> NDArray[Any]:
        """A field of the flights' records, (blocks, ..., lanes), found once."""
        field = self._fields.get(name)
        if field is None:
            field = self._fields[name] = self._blocks[name]
        return field

    def columns(self, name: str) -> NDArray[Any]:
        """A field of the flights' records as a new array (..., n)."""
        if name not in self._fields and not self._room.holds(name):
            return np.ascontiguousarray(np.moveaxis(self.record(name), 0, -1))
        values = self._field(name)
        if values.ndim == 2:
            return values.flatten()[: self.count]
        last = values.ndim - 1
        values = values.transpose(*range(1, last), 0, last).copy()
        return values.reshape(*values.shape[:-2], -1)[..., : self.count]

    def rows(self, name: str) -> NDArray[Any]:
        """A field of the flights' records as a new array (n, ...)."""
        if name not in self._fields and not self._room.holds(name):
            return self.record(name)
        values = self._field(name)
        if values.ndim == 3:
            return self.columns(name).T
        last = values.ndim - 1
        values = values.transpose(0, last, *range(1, last)).copy()
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
        state = np.concatenate(
            [self.record(name, flights) for name in ("r", "v", "q", "w")], axis=1
        )
        finite[flights] = np.isfinite(state).all(axis=1)
        return finite
