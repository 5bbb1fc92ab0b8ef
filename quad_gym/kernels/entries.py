"""Compiled functions that Python calls: their names and arguments, without the code.

A call goes to the library of compiled kernels, if there is one (`library.py`); otherwise Numba
compiles the function on its first call, or loads it from its cache. Arrays are passed in C order
and with the data type of the catalog; a call writes results into arrays of the caller.
"""

import functools
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.library import library
from quad_gym.kernels.stages import SOURCES, STAGE_TABLE, Stage
from quad_gym.records import (
    FLIGHT,
    FLIGHT_BLOCK,
    MEASUREMENT,
    OPERATION,
    PARAMS,
    PARAMS_BLOCK,
    SAMPLE,
    SETTINGS,
    START,
    STEP_BLOCK,
    WORK_BLOCK,
    Sensor,
)
from quad_gym.records.inputs import EVENT, FIX, INPUT, PENDING, WINDOW


class Rows(NamedTuple):
    """An argument that is an array."""

    dtype: np.dtype[Any]
    axes: int = 1


class Entry:
    """A compiled function, to be called.

    Args:
        name: "module:function" within `quad_gym.kernels`.
        arguments: An array, `int` or `bool` for each argument.
        returns: Type of the result; None: there is none.
    """

    def __init__(
        self, name: str, *arguments: Rows | type, returns: type[float] | None = None
    ) -> None:
        self.name = f"quad_gym.kernels.{name}"
        self.arguments, self.returns = arguments, returns
        self._arrays = [(k, a) for k, a in enumerate(arguments) if isinstance(a, Rows)]

    def __call__(self, *given: Any) -> Any:
        """Call it.

        Raises:
            TypeError: If an array has another data type, number of axes or order.
        """
        return self.bound(*given)() if self._arrays else self._function(*given)

    def bound(self, *given: Any) -> Callable[[], Any]:
        """Return a function that makes this call again and again, with the same memory."""
        for k, wanted in self._arrays:
            _check(self.name, wanted, given[k])
        if library() is None:
            return functools.partial(self._function, *given)
        words: list[int] = []
        for value in given:
            if isinstance(value, np.ndarray):
                words += (value.ctypes.data, *value.shape)
            else:
                words.append(int(value))
        return _Call(self._function, words, given)

    @functools.cached_property
    def _function(self) -> Callable[..., Any]:
        found = library()
        if found is None:
            from quad_gym.kernels.compiling.workers import dispatcher_of  # importing it takes 1 s

            compiled: Callable[..., Any] = dispatcher_of(self.name)
            return compiled
        words = len(self.arguments) + sum(wanted.axes for _, wanted in self._arrays)
        return found.function_of(self.name, words, self.returns)


class _Call:
    """A call of the library, with addresses and shapes in place of arrays, which it keeps alive."""

    def __init__(
        self, function: Callable[..., Any], words: list[int], kept: tuple[Any, ...]
    ) -> None:
        self._function, self._words, self._kept = function, words, kept

    def __call__(self) -> Any:
        return self._function(*self._words)


def _check(name: str, wanted: Rows, array: NDArray[Any]) -> None:
    """Refuse an array for which a function has no code."""
    same = array.dtype is wanted.dtype or array.dtype == wanted.dtype
    if not same or array.ndim != wanted.axes or not array.flags.c_contiguous:
        raise TypeError(
            f"{name} takes an array of {wanted.axes} axes in C order, got {array.ndim} axes "
            f"with strides {array.strides}{'' if same else f' of {array.dtype}'}"
        )


_FLIGHT, _PARAMS, _SETTINGS, _START = map(Rows, (FLIGHT, PARAMS, SETTINGS, START))
_BLOCK, _BLOCK_PARAMS, _STEPS = map(Rows, (FLIGHT_BLOCK, PARAMS_BLOCK, STEP_BLOCK))
_BLOCK_WORK, _TABLE = Rows(WORK_BLOCK), Rows(STAGE_TABLE)
_TAPE = (Rows(SAMPLE), Rows(MEASUREMENT), Rows(OPERATION))
_VECTOR, _MATRIX, _CUBE = (Rows(np.dtype(np.float64), axes) for axes in (1, 2, 3))
_INDICES, _MASK = Rows(np.dtype(np.int64)), Rows(np.dtype(np.bool_), 2)
_WORDS, _SLOTS = Rows(np.dtype(np.uint64)), Rows(np.dtype(np.uint64), 2)

fly = Entry("batch:fly", int, int, int, int, int, bool, returns=bool)
run_tape = Entry(
    "tape:run_tape",
    _BLOCK,
    _BLOCK_PARAMS,
    _BLOCK_PARAMS,
    _STEPS,
    _SETTINGS,
    _BLOCK_WORK,
    _TABLE,
    *_TAPE,
    _INDICES,
    _WORDS,
    _SLOTS,
    int,
    int,
)
take_inputs = Entry(
    "tape:take_inputs", *map(Rows, (WINDOW, EVENT, SAMPLE, PENDING, OPERATION, INPUT))
)
check_measurement = Entry("tape:check_measurement", Rows(MEASUREMENT))
start_filter = Entry("single:start_filter", _BLOCK, _BLOCK_PARAMS, _SETTINGS, _BLOCK_WORK, _VECTOR)
run_stage = Entry(
    "single:run_stage",
    *[int] * 4,
    _BLOCK_PARAMS,
    _BLOCK_PARAMS,
    _SETTINGS,
    _BLOCK_WORK,
    _TABLE,
    int,
)
body_accelerations_in_air = Entry(
    "single:body_accelerations_in_air",
    _VECTOR,
    _MATRIX,
    *[_VECTOR] * 4,
    _PARAMS,
    _SETTINGS,
    _VECTOR,
    _VECTOR,
)
integrate_flight = Entry("single:integrate_flight", _FLIGHT, _PARAMS, int)
body_accelerations = Entry(
    "single:body_accelerations", _MATRIX, *[_VECTOR] * 4, _PARAMS, _VECTOR, _VECTOR
)
first_heading = Entry("single:first_heading", _START, Rows(FIX))
start_level = Entry("single:start_level", _START)
wahba_of_vectors = Entry(
    "single:wahba_of_vectors", _VECTOR, _MATRIX, _MATRIX, _MATRIX, returns=float
)
nearest_obstacles = Entry("single:nearest_obstacles", _MATRIX, _CUBE, _SETTINGS, _VECTOR, _MATRIX)
hide_points = Entry("single:hide_points", _MATRIX, _CUBE, _CUBE, _SETTINGS, _MASK)

FILTER_STAGES = (
    Stage.UPDATE,
    Stage.PREDICT,
    Stage.GATE,
    Stage.RECOVER,
    Stage.MOTION,
    Stage.HEADING,
    *(Stage[sensor.name] for sensor in Sensor),
)
"""Stages that a filter runs, as far as it needs them."""
FILTER_ENTRIES = (
    start_filter.name,
    run_tape.name,
    take_inputs.name,
    check_measurement.name,
)
"""Names of the entries that a filter calls, the slowest to compile first."""
_SENSORS_AND_VEHICLE = (
    run_stage,
    body_accelerations_in_air,
    integrate_flight,
    body_accelerations,
    start_level,
    first_heading,
    wahba_of_vectors,
    nearest_obstacles,
    hide_points,
)
SENSORS_AND_VEHICLE = tuple(entry.name for entry in _SENSORS_AND_VEHICLE)
"""Names of the entries for sensors and vehicles."""
_ENTRIES = (
    fly,
    run_tape,
    start_filter,
    take_inputs,
    check_measurement,
    *_SENSORS_AND_VEHICLE,
)
ENTRIES = {entry.name: entry for entry in _ENTRIES}
"""All entries by their names."""


# --------------------------------------------------------------------------------------------------
# The stages of this process, and a table of those that a batch needs.
#
# They are in the library of compiled kernels, or Numba compiles or loads them on demand.
# --------------------------------------------------------------------------------------------------

_addresses: dict[str, int] = {}
_lock = threading.Lock()


def names_of(needed: Collection[str], entries: Sequence[str] = (fly.name,)) -> list[str]:
    """The compiled functions of stages and of the entries that call them, the longest first."""
    ordered = [name for name in dict.fromkeys(s.name for s in SOURCES) if name in needed]
    return [*ordered[:2], *entries[:1], *ordered[2:], *entries[1:]]


def linked_table(needed: Mapping[Stage, str], entries: Sequence[str] = (fly.name,)) -> NDArray[Any]:
    """Table of addresses, (1,) STAGE_TABLE, of only the stages that are needed.

    A batch has memory only for the parts that these stages use, see `used_parts`: other slots stay
    empty, even if another batch has linked their stages. The entries that call them are compiled
    with them.
    """
    with _lock:
        missing = set(needed.values()) - _addresses.keys()
        if missing:
            found = library()
            if found is None:
                from quad_gym.kernels.compiling.workers import prepare  # importing it takes 1 s

                prepare(names_of(set(needed.values()), entries))
            address = _compiled if found is None else found.address_of
            _addresses.update((name, address(name)) for name in missing)
    table = np.zeros(1, STAGE_TABLE)
    for stage, name in needed.items():
        table["address"][0, stage] = _addresses[name]
    return table


def _compiled(name: str) -> int:
    """Address of the machine code of a stage."""
    from quad_gym.kernels.compiling.decorators import SIGNATURE
    from quad_gym.kernels.compiling.workers import dispatcher_of

    compiled = dispatcher_of(name).overloads[tuple(SIGNATURE.args)]
    address = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
    if not address:
        raise RuntimeError(f"{name} has no machine code")
    return int(address)
