"""The records of many flights in memory: reading, keeping and restoring them, and calls."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.configuration import FlightConfiguration
from quad_gym.faults import Fault, named_faults
from quad_gym.kernels.entries import fly
from quad_gym.params import checks as check
from quad_gym.params.randomization import Randomization
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite
from quad_gym.params.task import TaskParams
from quad_gym.params.vehicle import Clocks, VehicleParams
from quad_gym.params.world import WorldParams
from quad_gym.records import (
    BLOCKS_OF,
    COLUMNS,
    FLIGHT_BLOCK,
    WIDTH,
    Call,
    Room,
    Sensor,
    aligned_zeros,
    covariance_of,
    field_of_flights,
    in_double,
    joint_covariance,
    lower_factors,
    parts_of,
    places_of_lanes,
)

# --------------------------------------------------------------------------------------------------
# The records of many flights in memory: reading, keeping and restoring them.
# --------------------------------------------------------------------------------------------------

_UNKNOWN = ("start_given", "innovation", "innovation_sigma", "block_nis", "obstacle_distance")
"""Fields that are NaN until they are measured or given."""


def _place_of(reading: str) -> tuple[str, tuple[int | slice, ...]]:
    """Return where a record has the numbers of a reading: field and indices."""
    blocks, numbers = BLOCKS_OF[reading], slice(READINGS[reading].length)
    return "measurement", (blocks if READINGS[reading].most_blocks > 1 else blocks.start, numbers)


_PARTS_OF: dict[str, tuple[str, tuple[int | slice, ...]]] = {
    "drift_hat": ("slow_hat", (slice(0, 3),)),  # in suites with a sensor that drifts
    **{name: _place_of(name) for name in READINGS},
}
"""Names of parts of fields."""


_FACTORS = {
    "L": (slice(0, 15), slice(0, 15)),
    "L_slow": (slice(15, None),),
    "L_drift": (slice(15, 18), slice(0, 18)),
}


"""Parts of the lower factor of the covariance of r, v, e, b_a, b_g and slow errors, by names."""


def configuration_digest(*records: NDArray[Any]) -> int:
    """Return a digest of records of settings, parameters and trajectories, as a word."""
    digest = hashlib.blake2b(digest_size=8)
    for record in records:
        for name in record.dtype.names or ():
            if name != "max_steps":  # which `FlightBatch.limit` changes
                digest.update(np.ascontiguousarray(record[name]).tobytes())
    return int.from_bytes(digest.digest(), "little")


class FlightMemory:
    """The records of `count` flights, in blocks of WIDTH."""

    configuration: FlightConfiguration
    count: int
    run_filter: bool
    task: TaskParams
    world: WorldParams
    sensors: SensorSuite
    faults: tuple[Fault, ...]
    randomization: Randomization
    vehicle: VehicleParams
    clocks: Clocks
    _model: NDArray[Any]
    _world: NDArray[Any]
    _settings: NDArray[Any]
    _exchange: NDArray[Any]
    _resets: NDArray[np.uint8]
    _results: NDArray[np.float64]

    def _fly(self, command: int) -> NDArray[np.float32]:
        """Have the threads carry out a `Command`; return the observations."""
        raise NotImplementedError

    def _allocate(self, room: Room, undrawn: NDArray[np.float64], configuration: int) -> None:
        """Allocate the records of flights that have never been reset."""
        self._room, self._undrawn, self._begun = room, undrawn, False
        self._blocks = aligned_zeros(-(-self.count // WIDTH), room.dtype)
        lanes = np.arange(len(self._blocks) * WIDTH).reshape(-1, WIDTH)
        self._blocks["idle"] = lanes >= self.count
        self._blocks["needs_reset"] = 1.0
        self._blocks["configuration"] = configuration
        for name in _UNKNOWN:
            if room.holds(name):
                self._blocks[name] = np.nan
        if room.holds("drawn"):
            self._blocks["drawn"] = undrawn[:, np.newaxis]

    # ---- reading ------------------------------------------------------------------------------

    @property
    def R_IG(self) -> NDArray[np.float64]:
        """Rotation (3, 3) from G, the frame of GNSS, to I."""
        return np.array(self._model["R_IG"][0, ..., 0], np.float64)

    def record(self, name: str, flights: NDArray[np.intp] | None = None) -> NDArray[Any]:
        """Return a field of the records by its name in the kernels, as a new array (n, ...).

        `FlightBatch.read` returns the quantities that users need, by their public names.

        Args:
            name: The field, such as "r" or "b_a_hat"; or "L", the lower factor of the covariance,
                in the order r, v, e, b_a, b_g, and "L_slow", its rows of slow errors below.
            flights: Indices of the flights; None: all of them.

        Raises:
            ValueError: If there is no such field, see `records.FLIGHT_FIELDS`, or no such flight.
        """
        if flights is not None:
            flights = self._chosen(flights)
        if name in _PARTS_OF:
            field, part = _PARTS_OF[name]
            return self.record(field, flights)[(slice(None), *part)]
        if name in _FACTORS:
            return self._joint_factor(flights)[(slice(None), *_FACTORS[name])]
        if name not in (FLIGHT_BLOCK.names or ()):
            known = check.did_you_mean(name, FLIGHT_BLOCK.names or ())
            raise ValueError(f"name must be a field of a flight's record, got {name!r}{known}")
        if not self._room.holds(name):  # this configuration does not use it
            count = self.count if flights is None else len(flights)
            if name == "drawn":
                return np.tile(self._undrawn, (count, 1))
            base, shape = FLIGHT_BLOCK[name].base, FLIGHT_BLOCK[name].shape[:-1]
            return in_double(np.full((count, *shape), np.nan if name in _UNKNOWN else 0.0, base))
        return self._fetched(name, flights)

    def _chosen(self, flights: ArrayLike) -> NDArray[np.intp]:
        """Return indices of flights, of which all exist; NumPy would take masks and others, too."""
        found = np.asarray(flights)
        if not found.size:
            found = found.astype(np.intp)
        indices = found.ndim == 1 and found.dtype.kind in "iu"
        if not indices or (found.size and not 0 <= found.min() <= found.max() < self.count):
            raise ValueError(
                f"flights must be indices (n,) from 0 to {self.count - 1}, got {flights!r}"
            )
        return found

    def _joint_factor(self, flights: NDArray[np.intp] | None) -> NDArray[np.float64]:
        """Return the factors (n, 24, 24) of the covariances of all states, slow errors last."""
        P_slow = self.record("P_slow", flights)
        return lower_factors(joint_covariance(self.record("P", flights), P_slow))

    def _fetched(self, name: str, flights: NDArray[np.intp] | None) -> NDArray[Any]:
        """Return a field of the records that this configuration uses, as `record` does."""
        if flights is None:
            return field_of_flights(self._blocks, name, self.count)
        return in_double(self._blocks[name][flights // WIDTH, ..., flights % WIDTH])

    def _drawn(self, columns: slice) -> NDArray[np.float64]:
        """Return columns of the field `drawn`, as a new array (n, columns)."""
        values = np.moveaxis(self._blocks["drawn"][:, columns], -1, 1)
        return in_double(values.reshape(-1, values.shape[-1])[: self.count].copy())

    def write(self, flights: NDArray[np.intp], **values: ArrayLike) -> None:
        """Write fields of the records of some flights, (len(flights), ...) each."""
        block, lane = np.divmod(flights, WIDTH)
        for name, value in values.items():
            self._blocks[name][block, ..., lane] = value

    def drawn(self) -> dict[str, NDArray[np.float64]]:
        """Return the drawn parameters of the present episodes by name: (count,) or (count, n)."""
        found = {}
        for name in self.randomization.names:
            values = self._drawn(COLUMNS[name])
            if name == "feature_offsets_I" and (count := self.sensors.blocks_of("pixels")):
                values = values[:, : 3 * count].reshape(-1, count, 3)
            found[name] = values[:, 0] if values.shape[1:] == (1,) else values
        return found

    def feature_places(self) -> NDArray[np.float64]:
        """Return the features of the camera as the filter assumes them, (count, m, 3) in I [m]."""
        count = self.sensors.blocks_of("pixels")
        if self._room.holds("feature_place"):
            return np.ascontiguousarray(self.record("feature_place")[:, :count])
        believed = self._world if self.randomization.known else self._model
        nominal = believed["features"][0, :count, :, 0].astype(np.float64)
        return np.broadcast_to(nominal, (self.count, *nominal.shape))

    def active_faults(self) -> dict[str, NDArray[np.bool_]]:
        """Return which of the possible faults are active at present, by name: (count,) each."""
        return named_faults(self.faults, self.record("faults"))

    def covariance(self) -> NDArray[np.float64]:
        """Return the covariances (count, 15, 15) of the filters, in the order r, v, e, b_a, b_g."""
        return covariance_of(self.record("P"), self.record("arc"))

    # ---- keeping ------------------------------------------------------------------------------

    def snapshot(self) -> NDArray[Any]:
        """Return a copy of all flights, with which `restore` restores this instant bitwise."""
        return self._blocks.copy()

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore all flights from a snapshot; see `FlightBatch.restore`."""
        fits = (
            isinstance(snapshot, np.ndarray)
            and snapshot.dtype == self._blocks.dtype
            and snapshot.shape == self._blocks.shape
            and np.array_equal(snapshot["idle"], self._blocks["idle"])
            and np.array_equal(snapshot["configuration"], self._blocks["configuration"])
        )
        if not fits:
            raise ValueError(
                f"snapshot must be from a batch of {self.count} flights with the same task, "
                "vehicle, sensors, filter, world, randomization, faults, rates and observation, "
                "and with the same version, precision and number of lanes"
            )
        self._blocks[:] = snapshot
        self._begun = False  # it may have been taken before a reset

    @property
    def begun(self) -> bool:
        """True once the flights have been stepped; False again after `restore`."""
        return self._begun

    def copied_record(self, flight: int) -> NDArray[np.uint32]:
        """Return the whole record of one flight at the present instant, for `with_records`."""
        block, lane = divmod(flight, WIDTH)
        return parts_of(self._blocks)[block, places_of_lanes(self._room.dtype)[:, lane]]

    def with_records(self, records: Sequence[NDArray[np.uint32]]) -> Self:
        """Return flights with copied records, to `read` from: not to be stepped or reset."""
        found = object.__new__(type(self))
        found.__dict__.update(self.__dict__)
        found.count = len(records)
        found._blocks = aligned_zeros(-(-found.count // WIDTH), self._room.dtype)
        parts, places = parts_of(found._blocks), places_of_lanes(self._room.dtype)
        for flight, record in enumerate(records):
            block, lane = divmod(flight, WIDTH)
            parts[block, places[:, lane]] = record
        return found

    # ---- switching ----------------------------------------------------------------------------

    def switch_sensors(self, **sensors: bool | None) -> None:
        """Switch sensors of all flights off, or on again, from the next tick on.

        The filter continues without them. A new episode begins with all sensors on.

        Args:
            sensors: By name, such as `gnss` or `barometer`: True: the sensor measures; False: it is
                off; None: as at present.

        Raises:
            ValueError: If a sensor is unknown, or the suite lacks it.
        """
        for name, measures in sensors.items():
            check.choice("switch_sensors", name, tuple(self.sensors.sensors))
            if measures is not None:
                waits = self._blocks["wait"][:, Sensor[name.upper()]]
                on = check.flag(name, measures)
                waits[:] = np.where(np.isinf(waits), 0.0, waits) if on else np.inf

    def switch_faults(self, active: bool) -> None:
        """Activate or deactivate the faults of all flights at the next tick, at any time.

        They stay so until the end of the episode, except for faults with a rate.

        Args:
            active: True: activate; False: deactivate.
        """
        check.flag("active", active)
        tick = self._blocks["tick"]
        for fault in self.faults:
            if active:
                self._blocks["fault_from"][:, fault.kind] = tick
            self._blocks["fault_until"][:, fault.kind] = np.inf if active else tick


# --------------------------------------------------------------------------------------------------
# Calls of the compiled code that flies: addresses of a batch's memory, in words.
#
# An array as an argument would take a third of a microsecond, longer than a stage runs.
# --------------------------------------------------------------------------------------------------

Word = int | NDArray[Any] | Sequence[NDArray[Any]]
"""A number, an array of which the kernel gets the address, or an array for each thread."""


class Calls:
    """The calls of all threads of a batch; they keep its memory and the `kept` arrays alive."""

    def __init__(
        self,
        blocks: NDArray[Any],
        room: Room,
        words: Mapping[Call, Word],
        kept: Sequence[NDArray[Any]],
    ) -> None:
        self._memory = (blocks, dict(words), kept)
        threads = next(len(arrays) for arrays in words.values() if isinstance(arrays, list))
        self._words = np.zeros((threads, len(Call)), np.int64)
        self._words[:, Call.BLOCKS] = address_of(blocks) - room.skipped
        self._words[:, Call.PITCH] = room.dtype.itemsize
        for word, value in words.items():
            if isinstance(value, Sequence):
                self._words[:, word] = [address_of(array) for array in value]
            else:
                self._words[:, word] = value if isinstance(value, int) else address_of(value)
        self._rows = [address_of(row) for row in self._words]
        self._board: tuple[NDArray[np.int64] | None, int, int] = (None, 0, 0)

    def observe_into(self, observations: NDArray[np.float32]) -> None:
        """Set the array into which the next step writes its observations."""
        self._memory[1][Call.OBSERVATIONS] = observations
        self._words[:, Call.OBSERVATIONS] = address_of(observations)

    def show_into(self, shown: NDArray[np.float64]) -> None:
        """Set the array into which the next step or reset writes the fields that tasks read."""
        self._memory[1][Call.SHOWN] = shown
        self._words[:, Call.SHOWN] = address_of(shown)
        self._words[:, Call.SHOWN_PITCH] = shown.strides[0]

    def __call__(self, board: NDArray[np.int64], number: int, command: int, serving: bool) -> bool:
        """Fly blocks of a board, as the thread of this number; see `fly`."""
        kept, posted, size = self._board
        if board is not kept:  # its address takes longer than the rest of this call
            posted, size = address_of(board), board.size
            self._board = board, posted, size
        return bool(fly(self._rows[number], posted, size, number, command, serving))


def address_of(array: NDArray[Any]) -> int:
    """Return the address of an array's memory.

    `array.__array_interface__` would write out the data type, which takes 0.3 ms for a record.
    """
    return array.ctypes.data


# --------------------------------------------------------------------------------------------------
# State variables that a task or an estimator of a user keeps for each flight.
# --------------------------------------------------------------------------------------------------

_KINDS = {"b": np.bool_, "i": np.int64, "u": np.int64, "f": np.float64}


class State:
    """Named arrays (n, ...), one row per flight, which have the same values in each new episode."""

    __slots__ = ("_first", "_rows")
    _first: NDArray[Any]
    _rows: NDArray[Any]

    def __init__(self, count: int, start: Mapping[str, ArrayLike]) -> None:
        first: dict[str, NDArray[Any]] = {}
        for name, value in start.items():
            if not isinstance(name, str) or not name.isidentifier() or name.startswith("_"):
                raise ValueError(
                    f"names in state must be identifiers without leading underscore, got {name!r}"
                )
            values = np.asarray(value)
            if values.dtype.kind not in _KINDS:
                raise ValueError(f"state must contain numbers, got {value!r} for {name!r}")
            first[name] = values.astype(_KINDS[values.dtype.kind])
        row = np.zeros(1, [(name, value.dtype, value.shape) for name, value in first.items()])
        for name, value in first.items():
            row[name] = value
        self.__setstate__((row, np.repeat(row, count)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables."""
        return self._rows.dtype.names or ()

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name[0] == "_" or name not in self.names:
            raise AttributeError(f"its class declares no state {name!r}: add it to `state`")
        return self._rows[name]

    def __setattr__(self, name: str, value: Any) -> None:
        self.__getattr__(name)[:] = value

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.names]  # for "did you mean" suggestions

    def __getstate__(self) -> Any:
        return self._first, self._rows

    def __setstate__(self, state: Any) -> None:
        object.__setattr__(self, "_first", state[0])
        object.__setattr__(self, "_rows", state[1].copy())  # pickle's own may be read-only forever
        self.lock(True)

    def lock(self, locked: bool) -> None:
        """Make all arrays read-only, or writable."""
        self._rows.flags.writeable = not locked

    def begin(self, chosen: NDArray[np.bool_]) -> None:
        """Set the rows of flights that begin an episode to the initial values."""
        self.put(self._first, chosen)

    def rows(self) -> NDArray[Any]:
        """Copy of all variables: one record (n,)."""
        return self._rows.copy()

    def put(self, rows: NDArray[Any], chosen: NDArray[np.bool_]) -> None:
        """Replace the rows of chosen flights by others, as `rows` returns them."""
        self.lock(False)
        self._rows[chosen] = rows
        self.lock(True)

    def kept_with(self, flights: NDArray[Any]) -> NDArray[Any]:
        """Join a snapshot of flights with this state, if there is any."""
        if not self.names:
            return flights
        kept = np.zeros(len(flights), self._kind_with(flights.dtype))
        kept["flights"] = flights
        kept["state"][np.divmod(np.arange(len(self._rows)), WIDTH)] = self._rows
        return kept

    def flights_of(
        self, snapshot: NDArray[Any], flights: np.dtype[Any], owner: str
    ) -> NDArray[Any]:
        """Return the flights of a snapshot that `kept_with` has joined with a state like this one.

        `flights` is their data type, `owner` the task or estimator that needs the state.
        """
        if not self.names:
            return snapshot
        if getattr(snapshot, "dtype", None) != self._kind_with(flights):
            raise ValueError(f"snapshot must be one of a batch with {owner}")
        return np.asarray(snapshot["flights"])

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore the state that `kept_with` has joined with flights."""
        if self.names:
            places = np.divmod(np.arange(len(self._rows)), WIDTH)
            self.put(snapshot["state"][places], np.ones(len(self._rows), bool))

    def _kind_with(self, flights: np.dtype[Any]) -> np.dtype[Any]:
        """Data type of flights with this state."""
        return np.dtype([("flights", flights), ("state", self._rows.dtype, (WIDTH,))])
