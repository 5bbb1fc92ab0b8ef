"""Recovery of filters after faults, and detection of divergence.

* A flight is **consistent** while the NEES of position, velocity and attitude is below
  the 99.73 % chi-square quantile with nine degrees of freedom, which corresponds to 3 sigma of a
  single number. A consistent filter exceeds it in 0.27 % of the flights at any instant.
* A flight is **flagged** while `info["filter_diverged"]` is true.
* A flight has a **large error** while any of these nine errors exceeds six standard
  deviations. A missed alarm is a flight with large errors for `MISSED_AFTER` without interruption
  that is not flagged in that time; a false alarm is a new flag without a fault.
* A flight is **consistent in measured quantities** while the NEES of the coordinates that sensors
  of its suite measure is below this quantile: a filter without a compass, for example, cannot know
  of errors of its heading.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.consistency import flight_errors
from quad_gym.analysis.metrics import chi_square_quantile, nees
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite

CONSISTENT = 0.9973
"""Probability of the chi-square quantile below which a flight is consistent, as for 3 sigma."""
LARGE = 6.0  #: number of standard deviations beyond which an error counts as large
MISSED_AFTER = 2.0
"""Duration of large errors without a flag after which an alarm counts as missed [s]."""
REQUIRED = 0.99  #: required share of flights that are consistent or flagged
MOTION = slice(0, 9)  #: coordinates of position, velocity and attitude in the error state
_MEASURED_BY = {0: "position", 1: "position", 2: "height", 8: "heading"}
"""Quantity that a sensor observes, by coordinate; without any, errors of the coordinate stay.
Velocity and tilt are observed by each of them."""

Flags = NDArray[np.bool_]


def measured_coordinates(sensors: SensorSuite) -> list[int]:
    """Coordinates of `MOTION` that a sensor of the suite measures."""
    readings = (READINGS[name] for name in READINGS if sensors.blocks_of(name) > 0)
    observed = {quantity for reading in readings for quantity in reading.observes}
    return [i for i in range(MOTION.stop) if _MEASURED_BY.get(i) in {None, *observed}]


@dataclass(frozen=True)
class Recovery:
    """Consistency, flags and large errors of flights over time."""

    time: NDArray[np.float64]
    """Time since the start, (t,) [s]"""
    consistent: Flags
    """True while a flight is consistent, (t, flights)"""
    flagged: Flags
    """True while a flight is flagged as diverged, (t, flights)"""
    large_error: Flags
    """True while a flight has a large error, (t, flights)"""
    consistent_in_measured: Flags
    """True while a flight is consistent in measured quantities, (t, flights)"""

    def share(self, flags: Flags, time: float) -> float:
        """Share of flights with a flag, (t, flights), at the instant nearest to a time [s]."""
        return float(flags[np.abs(self.time - time).argmin()].mean())

    @property
    def undetected(self) -> Flags:
        """Undetected failures, (t, flights): True while neither consistent nor flagged."""
        return ~(self.consistent | self.flagged)

    def flagged_since(self, start: float) -> Flags:
        """True for flights that were flagged at any time after `start` [s], (flights,)."""
        return np.asarray(self.flagged[self.time > start + 1e-9].any(axis=0))

    def time_to(self, flags: Flags, since: float) -> float:
        """Time after `since` until `flags` hold permanently for a `REQUIRED` share of flights [s].

        Even of a consistent filter, some of a hundred flights occasionally exceed the quantile by
        chance. Shares above 1 - 2 (1 - `REQUIRED`) therefore do not interrupt a recovery. The time
        is infinite if the share is never reached.
        """
        after = self.time > since + 1e-9
        share = flags[after].mean(axis=1)
        lacking = np.flatnonzero(share < 1.0 - 2.0 * (1.0 - REQUIRED))
        share[: lacking[-1] + 1 if lacking.size else 0] = 0.0
        enough = np.flatnonzero(share >= REQUIRED)
        return float(self.time[after][enough[0]] - since) if enough.size else np.inf

    def missed_alarms(self) -> Flags:
        """True for flights with large errors for `MISSED_AFTER` and no flag, (flights,)."""
        return self._for_long(self.large_error & ~self.flagged)

    def long_large_error(self) -> Flags:
        """True for flights with large errors for `MISSED_AFTER`, flagged or not, (flights,)."""
        return self._for_long(self.large_error)

    def _for_long(self, flags: Flags) -> Flags:
        """True for flights with flags for `MISSED_AFTER` without interruption, (flights,)."""
        best = run = np.zeros(flags.shape[1:], np.int64)
        for now in flags:
            run = np.where(now, run + 1, 0)
            best = np.maximum(best, run)
        return np.asarray(best * self._every >= MISSED_AFTER - 1e-9)

    def alarms(self) -> int:
        """Number of times that a flag was newly raised, in all flights together."""
        before = np.vstack([np.zeros_like(self.flagged[:1]), self.flagged[:-1]])
        return int((self.flagged & ~before).sum())

    @property
    def hours(self) -> float:
        """Total flight time of all flights [h]."""
        return float(self.consistent.size * self._every / 3600.0)

    @property
    def _every(self) -> float:
        return float(self.time[1] - self.time[0])


def follow_recovery(
    batch: FlightBatch, *, seeds: Sequence[int], duration: float, every: float = 0.1
) -> Recovery:
    """Fly, and record which flights are consistent, flagged, or have large errors.

    Args:
        batch: Flights of a task without endings, whose filters monitor their innovations.
        seeds: Seeds of the flights.
        duration: Length of the flights, at least two evaluations [s].
        every: Time between two evaluations [s].
    """
    stride = max(1, round(every * batch.sensors.imu.rate))
    looks = round(duration * batch.sensors.imu.rate) // stride
    if looks < 2:
        raise ValueError(f"duration must be at least twice every, got {duration} and {every}")
    bound = chi_square_quantile(MOTION.stop - MOTION.start, CONSISTENT)
    measured = measured_coordinates(batch.sensors)
    bound_of_measured = chi_square_quantile(len(measured), CONSISTENT)
    shape = (looks, batch.count)
    consistent, flagged, large_error, in_measured = np.zeros((4, *shape), bool)
    batch.reset(seeds=seeds)
    for k in range(looks):
        for _ in range(stride):
            batch.step()
        errors, covariances = flight_errors(batch)[:, MOTION], batch.covariance()[:, MOTION, MOTION]
        sigma = np.sqrt(np.einsum("nii->ni", covariances))
        consistent[k] = nees(errors, covariances) < bound
        of_measured = covariances[:, measured][:, :, measured]
        in_measured[k] = nees(errors[:, measured], of_measured) < bound_of_measured
        flagged[k] = batch.record("diverged") > 0.0
        large_error[k] = (np.abs(errors) > LARGE * sigma).any(axis=1)
    time = np.array([batch.sensors.imu.dt * stride * k for k in range(1, looks + 1)])
    return Recovery(time, consistent, flagged, large_error, in_measured)
