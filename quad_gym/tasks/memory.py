"""`ReadableBatch`: flights whose state the views of a task can read.

The compiled code writes the quantities of a view to one block of memory, and arrays of views are
NumPy views of it, without a copy. `quad_gym.kernels.task.settle` writes rewards and endings.

An array that a task keeps must not change in the next step. Before each step, reference counts show
whether an array is still in use; if so, the step writes to other memory. The invariant: while no
array is in use, only the list of arrays handed out and its own attribute refer to each array, and
only the batch, its calls and the arrays in that list refer to the memory. Any further reference
increases a count, including a slice, which refers to the memory itself. An array that is not in
the list counts as used, so an interrupt or a second thread can cost memory, but never expose
outdated data. Weak references are not counted.
"""

from sys import getrefcount
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.calls import Calls
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.kernels.compiling.linked import SETTLE
from quad_gym.kernels.compiling.stages import needed_stages
from quad_gym.records import SHOWN, SHOWN_SIZE, WIDTH, Command
from quad_gym.tasks.lazy import Attribute, Shown

Floats = NDArray[np.float64]

_GAP = 8
"""Padding between two rows of the memory: a cache line."""
_TIME = SHOWN["time"].start
_COMPARED = slice(SHOWN["position_error"].start, SHOWN["gate_next"].stop)
"""Rows of the quantities that a step is compared in with the step before."""
COMPARED_ERROR = SHOWN["position_error"].start - _COMPARED.start
"""Row of the position error among the compared quantities."""
COMPARED_GATES = SHOWN["gate_next"].start - _COMPARED.start
"""Row of the number of gates passed among the compared quantities."""


def _references_unless_kept() -> int:
    """Reference count of an array that only its attribute and the list of arrays refer to.

    It is measured because interpreters count differently.
    """
    attributes = {"": np.zeros(1)}
    return max(map(getrefcount, [attributes[""]]))


_UNLESS_KEPT = _references_unless_kept()


class ReadableBatch(FlightBatch):
    """`FlightBatch` with the memory that the views of a task read.

    The next step overwrites `shown`, unless an array of it is still in use: then the step writes to
    other memory. Arrays of views are made once for each memory, because making them in every step
    would take longer than the rest of a small task. Other fields are read as new arrays.
    """

    def __init__(self, count: int, **keywords: Any) -> None:
        super().__init__(count, **keywords)
        self._settings["shown"] = True
        self._stages = needed_stages(self._settings[0])
        self._entries.append(SETTLE)
        self._fields: dict[str, NDArray[Any]] = {}
        self._handed_out: list[NDArray[Any]] = []
        self._attributes: list[Attribute] = []
        self._memory_references = 0
        # rows at distances of a power of two would compete for a few cache lines
        self._use_memory(np.zeros((SHOWN_SIZE, len(self._blocks) * WIDTH + _GAP)))

    shown: Floats
    """Quantities of `quad_gym.records.SHOWN` at the present instant, (SHOWN_SIZE, n); read-only."""
    _handed_out: list[NDArray[Any]]
    """Arrays of the present memory, each of which is an attribute of a view."""
    _attributes: list[Attribute]
    """All attributes that may hold an array of the present memory."""
    _memory_references: int
    """Number of references to the memory, except from arrays that were handed out."""

    def _use_memory(self, memory: Floats) -> None:
        """Use this memory from now on."""
        for group, name in self._attributes:
            group.pop(name, None)
        self._attributes, self._handed_out = [], []
        memory.setflags(write=False)  # prevents that an array of it is made writable
        self._memory, self.shown = memory, memory[:, : self.count]
        self.time_shown, self.compared_shown = self.shown[_TIME], self.shown[_COMPARED]

    def _change_memory(self, calls: Calls) -> None:
        """Leave the present memory to the arrays still in use, and continue with a copy."""
        self._memory_references = 0  # after an interrupt, the next step repeats this
        self._use_memory(self._memory.copy())
        calls.show_into(self._memory)
        self._memory_references = getrefcount(self._memory)

    def hand_out(self, field: Shown, group: dict[str, Any], name: str) -> NDArray[Any]:
        """Make an array (n, ...) of the present memory an attribute, until the memory changes.

        Args:
            field: Quantity that it contains.
            group: Attributes of a group.
            name: Name of the attribute.
        """
        self._attributes.append((group, name))  # first: an interrupt must not leave it undropped
        made = field.part_of(self.shown)
        array = group.setdefault(name, made)
        if array is made:  # no other thread was faster
            self._handed_out.append(array)
        return array

    def _is_kept(self) -> bool:
        """True if an array of the present memory is still in use."""
        arrays = self._handed_out
        return (
            getrefcount(self._memory) - len(arrays) > self._memory_references
            or max(map(getrefcount, arrays), default=0) > _UNLESS_KEPT
        )

    def _run(self, command: Command) -> NDArray[np.float32]:
        if self._crew is not None and self._is_kept():
            self._crew.gather()  # no thread may still write to the old memory
            self._change_memory(self._calls)
        return super()._run(command)

    def _calls_of_threads(self) -> Calls:
        calls = super()._calls_of_threads()
        self._change_memory(calls)
        return calls

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore all flights, and `shown`, from a snapshot.

        Raises:
            ValueError: If the snapshot has another size or kind.
        """
        super().restore(snapshot)
        self._resets[:] = 0
        self._run(Command.RESET)  # resets no flight, but updates `shown` and the observations
        self._blocks[:] = snapshot  # padding lanes of the last block have begun again

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the arrays of its memory, which a copy creates itself."""
        arrays: dict[str, Any] = {"_fields": {}, "_attributes": [], "_handed_out": []}
        arrays |= {"shown": None, "time_shown": None, "compared_shown": None}
        return super().__getstate__() | arrays

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the attributes, with separate memory."""
        self.__dict__.update(state)
        self._use_memory(self._memory)

    def _field(self, name: str) -> NDArray[Any]:
        """Field of the flights' records, (blocks, ..., lanes), looked up once."""
        field = self._fields.get(name)
        if field is None:
            field = self._fields[name] = self._blocks[name]
        return field

    def columns(self, name: str) -> NDArray[Any]:
        """Read a field of the flights' records into a new array (..., n)."""
        if name not in self._fields and not self._room.holds(name):
            return np.ascontiguousarray(np.moveaxis(self.record(name), 0, -1))
        values = self._field(name)
        if values.ndim == 2:
            return values.flatten()[: self.count]
        last = values.ndim - 1
        values = values.transpose(*range(1, last), 0, last).copy()
        return values.reshape(*values.shape[:-2], -1)[..., : self.count]

    def rows(self, name: str) -> NDArray[Any]:
        """Read a field of the flights' records into a new array (n, ...)."""
        if name not in self._fields and not self._room.holds(name):
            return self.record(name)
        values = self._field(name)
        if values.ndim == 3:
            return self.columns(name).T
        last = values.ndim - 1
        values = values.transpose(0, last, *range(1, last)).copy()
        return values.reshape(-1, *values.shape[2:])[: self.count]

    def counts(self, name: str) -> NDArray[np.int64]:
        """Read a field of the flights' records as integers, (n,)."""
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
        """Gates of a course, (n, gates, 3) in I [m]; (n, 0, 3) in other tasks."""
        if self.task.kind != "waypoints":
            return np.zeros((self.count, 0, 3))
        return self.rows("gates")[:, : self.task.gate_count]

    def obstacle_centers(self) -> Floats:
        """Centers of the obstacles in this episode, (n, o, 3) in I [m]."""
        count = len(self.world.obstacles)
        if not count:
            return np.zeros((self.count, 0, 3))
        return np.ascontiguousarray(self.rows("obstacle_center")[:, :count])

    def nominal(self) -> dict[str, Any]:
        """Parameters of the nominal camera, and the rotation from G to I, by name."""
        names = ("camera", "R_CB", "focal_length", "half_image", "R_IG")
        return {name: self._world[name][0, ..., 0] for name in names}

    def finite(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """True where the true state is finite, (n,); checked only for `chosen` flights."""
        finite = np.ones(self.count, bool)
        flights = np.flatnonzero(chosen)
        state = np.concatenate(
            [self.record(name, flights) for name in ("r", "v", "q", "w")], axis=1
        )
        finite[flights] = np.isfinite(state).all(axis=1)
        return finite
