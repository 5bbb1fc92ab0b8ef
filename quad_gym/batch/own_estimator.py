"""`OwnFilter`: the calls of a user's estimator by the flights that fly on it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.measurements import Measurements, StartView
from quad_gym.batch.memory import FlightMemory
from quad_gym.estimation.own import Estimator, checked_estimate, factors, own_copy
from quad_gym.params import checks as check
from quad_gym.records import (
    EXCHANGE_BLOCK,
    Autoreset,
    Command,
    Result,
    field_of_flights,
    put_in_flights,
)
from quad_gym.records.state import State

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

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
    """A batch's own copy of a user's estimator.

    The kernels fly tick by tick up to the measurements; the estimate is then written to the
    fields in which they expect the filter's.
    """

    def __init__(self, given: Estimator, count: int) -> None:
        self.name = type(given).__name__
        self._estimator = own_copy(given)
        self.state = self._estimator.state = State(count, given.state)
        self.state.lock(False)
        self._failed, self._has_covariance = False, True

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.state.lock(False)

    def restore(self, batch: FlightMemory, snapshot: NDArray[Any]) -> None:
        """Restore the state from a snapshot of `State.kept_with`."""
        self.state.restore(snapshot)
        self.state.lock(False)
        for name in EXCHANGE_BLOCK.names or ():
            put_in_flights(batch._exchange, name, batch.record(name))
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
            self._begin(batch, begun)
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
            estimate = self._estimator.update(measurements)
            self._write(batch, "update", estimate, everyone, measurements, with_covariance=not left)

    def _begin(self, batch: FlightMemory, mask: Truths) -> None:
        """Begin the episodes of flights in `mask`."""
        others = self.state.rows()
        self.state.begin(mask)
        self.state.lock(False)
        view = StartView(batch, _sample(batch), mask)
        estimate = self._estimator.reset(view, mask)
        self.state.put(others[~mask], ~mask)
        self.state.lock(False)
        if estimate is None:
            names = ("position", "velocity", "R_BI", "gyro_bias", "accel_bias", "covariance")
            estimate = {name: getattr(view, name) for name in names}
        self._write(batch, "reset", estimate, mask, view)

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
            found["body_rates"] = measurements.gyro_now - found.get("gyro_bias", 0.0)
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
        factor = np.tril(np.full((batch.count, 15, 15), np.nan))
        if covariance is not None:
            factor = factors(method, covariance, rows)
        if not everyone:
            factor = np.where(mask[:, np.newaxis, np.newaxis], factor, batch.record("L"))
        put_in_flights(batch._blocks, "L", factor)
        self._has_covariance = covariance is not None


def _sample(batch: FlightMemory) -> NDArray[Any]:
    """Copy the last IMU sample of all flights, as blocks."""
    return np.asarray(batch._exchange[["gyro", "accel"]].copy())
