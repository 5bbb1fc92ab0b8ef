"""`Estimator`: a user's own filter in place of the built-in one, its measurements, its calls."""

import copy
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.memory import FlightMemory, State
from quad_gym.params import checks as check
from quad_gym.params.checks import did_you_mean
from quad_gym.params.sensor_table import READINGS, SENSOR_OF
from quad_gym.params.suites import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    BLOCKS_OF,
    EXCHANGE_BLOCK,
    REAL,
    WIDTH,
    Autoreset,
    Command,
    Result,
    Sensor,
    field_of_flights,
    lower_triangle,
    put_in_flights,
)
from quad_gym.records.inputs import SensorReading
from quad_gym.rotations import NORM_ERROR, are_rotations, quaternion_to_dcm

# --------------------------------------------------------------------------------------------------
# `Estimator`: a user's own filter in place of the built-in one, and checks of its estimates.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

ESTIMATES: dict[str, tuple[int, ...]] = {
    "position": (3,),
    "velocity": (3,),
    "R_BI": (3, 3),
    "quaternion": (4,),
    "body_rates": (3,),
    "accel_bias": (3,),
    "gyro_bias": (3,),
    "covariance": (15, 15),
}
"""Names in an estimate, and the shape of each for one flight."""

_ASYMMETRY = 1e-4
"""Largest difference of covariances P_ij and P_ji over the standard deviations of both; sums in
float32 reach 1e-5."""


class Estimator:
    """Your own state estimator, on which the controller flies instead of the built-in filter.

    `gymnasium.make(id, estimator=Mine())`, `make_vec`, `make_sb3_vec_env` and `FlightBatch` take an
    instance, the class, or "module:Class". The sensors measure as usual; at every tick, an IMU
    sample, `update` receives the measurements of all flights that have arrived, and returns an
    estimate as a dictionary of arrays with one row per flight:

    | name | shape | meaning |
    |---|---|---|
    | `position`, `velocity` | (n, 3) | of the center of mass, in I [m, m/s] |
    | `R_BI` | (n, 3, 3) | attitude, v_B = R_BI v_I |
    | `quaternion` | (n, 4) | instead of `R_BI`: B to I, (w, x, y, z) |
    | `body_rates` | (n, 3) | in B [rad/s]; optional: the gyro minus `gyro_bias` |
    | `accel_bias`, `gyro_bias` | (n, 3) | in B [m/s^2, rad/s]; optional: zero |
    | `covariance` | (n, 15, 15) | of the errors, positive definite; optional |

    The covariance has the order position and velocity in I, attitude, accelerometer and gyro bias
    in B. The attitude error e is the rotation from the estimated to the true body frame, R_BI =
    R(e) R_BI_hat; for small angles R(e) = 1 - [e x]. `include_std`, NEES, recorded flights and
    videos use the covariance at the end of a control period; without one, they have NaN, and
    `include_std=True` is refused.

    An environment has its own deep copy of the estimator. Variables that change from tick to tick
    belong in `state`: a class attribute with initial values by name, which define shape and type
    for one flight: {"position": np.zeros(3), "P": np.eye(15)}. In the methods `self.state.P` is the
    array (n, 15, 15) of all flights. It is saved, restored, copied and pickled with the flights,
    and has the initial values again in each new episode. Flights are the same in batches of any
    size, provided that the methods compute each row independently of the others.
    """

    state: Any = MappingProxyType({})

    def reset(self, view: "StartView", mask: Truths) -> Mapping[str, ArrayLike] | None:
        """Begin episodes.

        Args:
            view: Start of the episodes as the built-in filter has it (not the truth), and the first
                measurements.
            mask: Flights that begin an episode, (n,). Changes of the state of others are undone.

        Returns:
            Estimate at the start, of which the rows in `mask` are used; None: the built-in start.
        """
        return None

    def update(self, measurements: "Measurements") -> Mapping[str, ArrayLike]:
        """Return the estimate at the end of a tick.

        Args:
            measurements: The IMU sample of the tick, and the measurements that arrive at its end.

        Returns:
            Estimate of all flights.
        """
        raise NotImplementedError(f"{type(self).__name__} must define update(measurements)")


def checked_estimate(method: str, given: Any, count: int, rows: Truths) -> dict[str, Floats]:
    """Return an estimate as arrays, with the attitude as R_BI.

    Args:
        method: Class and method that returned it, for messages.
        given: Its return value.
        count: Number of flights.
        rows: Flights whose values must be finite, (n,).
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"{method} must return a dictionary of arrays, got {given!r:.60}")
    for name in given:
        if name not in ESTIMATES:
            known = did_you_mean(name, ESTIMATES) or f": one of {', '.join(ESTIMATES)}"
            raise ValueError(f"{method} must return known names, got {name!r}{known}")
    found = {name: _checked(method, name, given[name], count, rows) for name in given}
    if ("R_BI" in found) == ("quaternion" in found):
        raise ValueError(f'{method} must return either "R_BI" or "quaternion"')
    for name in ("position", "velocity"):
        if name not in found:
            raise ValueError(f'{method} must return "{name}"')
    if "R_BI" in found:
        R = found["R_BI"]
        with np.errstate(all="ignore"):  # of flights that are not in `rows`
            good = are_rotations(R)
        if not good.all():
            _require(method, 'rotations for "R_BI"', good, R, rows)
        return found
    quaternion = found.pop("quaternion")
    squares = np.einsum("ni,ni->n", quaternion, quaternion)
    good = np.asarray(np.abs(squares - 1.0) < NORM_ERROR)
    if not good.all():
        _require(method, 'rotations for "quaternion"', good, quaternion, rows)
    found["R_BI"] = quaternion_to_dcm(quaternion / np.sqrt(squares)[:, None])
    return found


def own_copy(given: Estimator) -> Estimator:
    """Return a copy that shares nothing with the estimator."""
    try:
        return copy.deepcopy(given)
    except Exception as error:  # of any library whose objects it holds
        raise ValueError(
            f"estimator must be one that copy.deepcopy can copy, got {type(given).__name__}: "
            f"{error}"
        ) from None


def _checked(method: str, name: str, value: Any, count: int, rows: Truths) -> Floats:
    """Return one array of an estimate."""
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f'{method} must return arrays without a mask for "{name}"')
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "biufO":
            raise TypeError(given.dtype.name)
        array = given.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        must = f'{method} must return real numbers for "{name}"'
        raise ValueError(f"{must}, got {value!r:.60}") from None
    if array.shape != (count, *ESTIMATES[name]):
        raise ValueError(
            f'{method} must return shape {(count, *ESTIMATES[name])} for "{name}", got '
            f"{array.shape}"
        )
    if not np.isfinite(array.sum()):
        finite = np.isfinite(array).reshape(count, -1).all(axis=1)
        _require(method, f'finite numbers for "{name}"', finite, array, rows)
    return array


def _require(method: str, what: str, good: Any, values: Floats, rows: Truths) -> None:
    """Refuse values of flights in `rows` that are not `good`."""
    wrong = np.flatnonzero(~good & rows)
    if wrong.size:
        raise ValueError(
            f"{method} must return {what}, got {values[wrong[0]].tolist()!r:.60} for flight "
            f"{wrong[0]}" + (f" and {wrong.size - 1} more" if wrong.size > 1 else "")
        )


def factors(method: str, covariances: Floats, rows: Truths) -> Floats:
    """Return lower Cholesky factors of covariances; NaN where not in `rows`."""
    variances = np.einsum("nii->ni", covariances)
    with np.errstate(invalid="ignore"):  # of negative variances, which are refused below
        most = _ASYMMETRY * np.sqrt(variances[:, :, np.newaxis] * variances[:, np.newaxis])
    uneven = (np.abs(covariances - covariances.transpose(0, 2, 1)) > most).any(axis=(1, 2)) & rows
    if uneven.any():
        raise ValueError(
            f'{method} must return a symmetric "covariance", got another for flight '
            f"{np.flatnonzero(uneven)[0]}"
        )
    found = np.tril(np.full_like(covariances, np.nan))
    try:
        found[rows] = np.linalg.cholesky(covariances[rows])
    except np.linalg.LinAlgError:
        for flight in np.flatnonzero(rows):
            try:
                np.linalg.cholesky(covariances[flight])
            except np.linalg.LinAlgError:
                raise ValueError(
                    f'{method} must return a positive definite "covariance", got one that is not '
                    f"for flight {flight}"
                ) from None
        raise
    return found


# --------------------------------------------------------------------------------------------------
# `Measurements` of many flights that arrive at an instant, and the `Start` of episodes.
# --------------------------------------------------------------------------------------------------


def _record(name: str, meaning: str) -> "cached_property[Floats]":
    """Make a property of a field of the flights' records."""

    def read(self: "Measurements") -> Floats:
        return self._batch.record(name)

    read.__doc__ = meaning
    return cached_property(read)


class Measurements:
    """IMU sample of a tick, and the measurements that arrive at its end.

    Arrays have one row per flight, and are read when first used. Measurements are raw: with biases,
    noise, latency and faults. A sensor that the suite lacks is None. Each sensor of
    `quad_gym.params.sensor_table` is an attribute with its name.

    Attributes:
        count: Number of flights, n.
        dt: Duration of a tick [s].
        sensors: The suite that an estimator may assume.
        vehicle: The vehicle that it may assume.
        ground_height: Height of the ground in I, for optical flow and range finder [m].
    """

    def __init__(self, batch: FlightMemory, sample: NDArray[Any]) -> None:
        self._batch, self._sample = batch, sample
        self.count, self.dt = batch.count, batch.sensors.imu.dt
        self.sensors: SensorSuite = batch.sensors
        self.vehicle: VehicleParams = batch.vehicle
        self.ground_height = batch.world.ground_height

    @cached_property
    def gyro(self) -> Floats:
        """Angular rate in B, (n, 3) [rad/s]: the sample with which to predict over the tick.

        It is taken at the start of the tick or, with `ImuParams.samples="average"`, the mean.
        """
        return field_of_flights(self._sample, "gyro", self.count)

    @cached_property
    def accel(self) -> Floats:
        """Specific force in B, (n, 3) [m/s^2], of the same sample."""
        return field_of_flights(self._sample, "accel", self.count)

    @cached_property
    def time(self) -> Floats:
        """Time since the start of the episode, (n,) [s]."""
        return self._batch.record("tick") * self.dt

    @cached_property
    def gyro_now(self) -> Floats:
        """Angular rate that the gyro measures at this instant, the end of the tick, (n, 3)."""
        return field_of_flights(self._batch._exchange, "w_meas", self.count)

    action = _record("action", "Action of the control period, in [-1, 1], (n, 4).")

    @cached_property
    def features(self) -> Floats:
        """Features of the camera on the map, (n, features, 3) in I [m]."""
        return self._batch.feature_places()

    # ---- readings -----------------------------------------------------------------------------

    def __getattr__(self, name: str) -> SensorReading | None:
        """Measurement of a reading of `READINGS` by its name, (n, ...)."""
        if name not in READINGS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        count = self.sensors.blocks_of(name)
        found = self._reading(name, count) if count else None
        self.__dict__[name] = found
        return found

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *READINGS]

    def _new(self, first: int, count: int) -> Truths:
        """True where one of some blocks arrives, (n, count)."""
        valid = self._batch._blocks["block_valid"][:, first : first + count]
        rows = valid.transpose(0, 2, 1).reshape(len(valid) * WIDTH, count)
        return np.asarray(rows[: self.count] > 0.0)

    def _reading(self, name: str, count: int) -> SensorReading:
        """Measurement of the first blocks of a reading."""
        sensor, first = Sensor[SENSOR_OF[name].upper()], BLOCKS_OF[name].start
        age = float(self._batch._settings["sensor_delay"][0, sensor] * self.dt)
        new, reading = self._new(first, count), READINGS[name]
        values = self._batch.record("measurement")[:, first : first + count, : reading.length]
        values[~new] = np.nan
        if reading.in_G:
            x, y, z = values[:, 0].T[:, :, np.newaxis]
            R = self._batch.R_IG
            values = x * R[:, 0] + y * R[:, 1] + z * R[:, 2]  # as in any batch
        values = values.reshape(self.count, *self.sensors.shape_of(name)).copy()
        return SensorReading(values, new if reading.most_blocks > 1 else new[:, 0], age)


class StartView(Measurements):
    """Start of episodes as the built-in filter has it, and the measurements at that instant.

    A cold filter has its first fix: the position from the antenna, or from the mark from which the
    vehicle starts; the heading from the baseline, the magnetometer, or the mark; a level attitude;
    velocity and biases of zero. With `filter_start="warm"` it has converged. The first fix is not
    among the measurements, except with `FilterParams.reuse_first_fix`. `gyro` and `accel` are the
    sample of the first instant; they have no meaning with `ImuParams.samples="average"`.
    """

    def __init__(self, batch: FlightMemory, sample: NDArray[Any], mask: Truths) -> None:
        super().__init__(batch, sample)
        self._mask = mask

    def _new(self, first: int, count: int) -> Truths:
        return super()._new(first, count) & self._mask[:, np.newaxis]

    position = _record("r_hat", "Position, (n, 3) in I [m].")
    velocity = _record("v_hat", "Velocity, (n, 3) in I [m/s].")
    R_BI = _record("R_hat", "Attitude, (n, 3, 3).")
    accel_bias = _record("b_a_hat", "Accelerometer bias, (n, 3) in B [m/s^2].")
    gyro_bias = _record("b_g_hat", "Gyro bias, (n, 3) in B [rad/s].")

    @cached_property
    def covariance(self) -> Floats:
        """Covariance in the order of estimates, (n, 15, 15)."""
        return self._batch.covariance()


# --------------------------------------------------------------------------------------------------
# `OwnFilter`: the calls of a user's estimator by the flights that fly on it.
# --------------------------------------------------------------------------------------------------

STARTS = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias", "covariance")
"""Names of the estimate with which an episode begins, attributes of a `StartView`."""

_FIELDS = {
    "position": "r_hat",
    "velocity": "v_hat",
    "R_BI": "R_hat",
    "accel_bias": "b_a_hat",
    "gyro_bias": "b_g_hat",
    "body_rates": "w_hat",
}
"""Fields of the exchange that hold an estimate."""


class OwnFilter:
    """An own copy of a user's estimator, with the state of all flights that it estimates.

    The kernels of a batch fly tick by tick up to the measurements; the estimate is then written to
    the fields in which they expect the filter's.
    """

    def __init__(self, given: Estimator, count: int) -> None:
        self.name = type(given).__name__
        self.estimator = own_copy(given)
        self.state = self.estimator.state = State(count, given.state)
        self.state.lock(False)
        self._failed, self._has_covariance = False, True

    def begin(self, view: Any, mask: Truths) -> Mapping[str, ArrayLike]:
        """Begin the episodes of flights in `mask`; return the estimate, by default the view's."""
        others = self.state.rows()
        self.state.begin(mask)
        self.state.lock(False)
        estimate = self.estimator.reset(view, mask)
        self.state.put(others[~mask], ~mask)
        self.state.lock(False)
        return {name: getattr(view, name) for name in STARTS} if estimate is None else estimate

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.state.lock(False)

    def restore(self, batch: FlightMemory, snapshot: NDArray[Any]) -> None:
        """Restore the state from a snapshot of `State.kept_with`."""
        self.state.restore(snapshot)
        self.state.lock(False)
        for name in EXCHANGE_BLOCK.names or ():
            batch._exchange[name] = batch._blocks[name]
        self._failed, self._has_covariance = False, True

    def run(self, batch: FlightMemory, command: Command) -> NDArray[np.float32]:
        """Fly a control period, or begin episodes; return the observations.

        After an invalid estimate, a ValueError, the flights must be reset.
        """
        if command == Command.RESET:
            observations = batch._fly(Command.RESET)
            begun = batch._resets > 0
            failed = self._failed and not begun.all()
        else:
            failed = False
            if self._failed:
                raise check.NotResetError(
                    f"call reset() before step(): a method of {self.name} has failed"
                )
            self._failed = True
            self._fly_ticks(batch)
            observations = batch._fly(Command.FINISH)
            begun = batch.record("tick") == 0.0
        if begun.any():
            self._failed = True
            view = StartView(batch, _sample(batch), begun)
            self._write(batch, "reset", self.begin(view, begun), begun, view)
            observations = batch._fly(Command.LOOK)
            if batch.configuration.autoreset is Autoreset.NEXT_STEP and command != Command.RESET:
                row = batch._results[Result.ESTIMATION_ERROR, : batch.count]
                row[begun] = batch.record("estimation_error")[begun]
        self._failed = failed
        return observations

    def _fly_ticks(self, batch: FlightMemory) -> None:
        """Fly the ticks of a control period, with an update after each."""
        everyone = np.ones(batch.count, bool)
        averages = batch.sensors.imu.samples == "average"
        for left in range(batch.clocks.ticks_per_step - 1, -1, -1):
            sample = _sample(batch)  # which the vehicle has taken at the start of the tick
            batch._fly(Command.TICK + left)
            measurements = Measurements(batch, _sample(batch) if averages else sample)
            estimate = self.estimator.update(measurements)
            self._write(batch, "update", estimate, everyone, measurements, with_covariance=not left)

    def _write(
        self,
        batch: FlightMemory,
        method: str,
        given: Any,
        mask: Truths,
        measurements: Measurements,
        with_covariance: bool = True,
    ) -> None:
        """Write an estimate to the records of flights in `mask`, if it is valid."""
        method, rows = f"{self.name}.{method}", mask
        try:
            found = checked_estimate(method, given, batch.count, rows)
        except ValueError:  # a flight whose true state is not finite has no estimate either
            rows = mask & np.isfinite(batch.record("r")).all(axis=1)
            found = checked_estimate(method, given, batch.count, rows)
        covariance = found.pop("covariance", None)
        if covariance is None and batch.configuration.include_std:
            raise ValueError(f'include_std=True needs a "covariance", and {method} returns none')
        everyone, exchange = bool(mask.all()), batch._exchange
        if not everyone and "body_rates" not in found:
            bias = found.get("gyro_bias", 0.0)  # in the precision of the blocks below
            found["body_rates"] = np.subtract(measurements.gyro_now, bias, dtype=REAL)
        for name, field in _FIELDS.items():
            values = found.get(name)
            if values is None and everyone:
                rates = exchange["w_meas"] - exchange["b_g_hat"] if field == "w_hat" else 0.0
                exchange[field] = rates
                continue
            if values is None:
                values = np.zeros((batch.count, 3))
            if not everyone:
                kept = field_of_flights(exchange, field, batch.count)
                values = np.where(mask.reshape(-1, *[1] * (values.ndim - 1)), values, kept)
            put_in_flights(exchange, field, values)
        if not with_covariance or (covariance is None and not self._has_covariance and everyone):
            return
        P = np.tril(np.full((batch.count, 15, 15), np.nan))
        if covariance is not None:
            factors(method, covariance, rows)  # raises for one that is none
            P[rows] = lower_triangle(covariance[rows])
        if not everyone:
            P = np.where(mask[:, np.newaxis, np.newaxis], P, batch.record("P"))
        put_in_flights(batch._blocks, "P", P)
        self._has_covariance = covariance is not None


def _sample(batch: FlightMemory) -> NDArray[Any]:
    """Copy the last IMU sample of all flights, as blocks."""
    return np.asarray(batch._exchange[["gyro", "accel"]].copy())
