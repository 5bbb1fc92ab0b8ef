"""What becomes of a filter after a fault: how soon it is right again, and whether it says so.

* **Right** is a flight whose nine errors of position, velocity and attitude have a normalized
  square below the chi-square quantile that holds 99.73 % of a consistent filter's, as 3 sigma do of
  a single number. Where that filter has 0.27 % of its flights outside at any instant, one has gone
  astray that has more.
* **Told** is a flight of which `filter_diverged` of `info` is true at the same instant.
* **Far off** is one in which any of these errors exceeds six of its deviations. A missed alarm is a
  flight that is far off for `MISSED_AFTER` on end and not told in all that time; a false alarm is
  one that is told anew without a fault.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.consistency import flight_errors
from quad_gym.analysis.metrics import chi_square_quantile, nees
from quad_gym.batch.flight_batch import FlightBatch

RIGHT = 0.9973
"""Share of a consistent filter's flights that are right at an instant: as 3 sigma."""
FAR_OFF = 6.0
"""Deviations."""
MISSED_AFTER = 2.0
"""Time that a flight may be far off without being told [s]."""
WANTED = 0.99
"""Share of flights that are to be right or told."""
MOTION = slice(0, 9)
"""Position, velocity and attitude."""

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Recovery:
    """What was seen of flights, instant by instant."""

    time: NDArray[np.float64]
    """(t,) since the start [s]"""
    right: Flags
    """(t, flights)"""
    told: Flags
    """(t, flights)"""
    far_off: Flags
    """(t, flights)"""

    def share(self, flags: Flags, time: float) -> float:
        """Share of flights at an instant."""
        return float(flags[self.index(time)].mean())

    def index(self, time: float) -> int:
        """Number of the instant nearest to `time` [s]."""
        return int(np.abs(self.time - time).argmin())

    @property
    def silent(self) -> Flags:
        """(t, flights) neither right nor told."""
        return ~(self.right | self.told)

    def time_to(self, flags: Flags, since: float) -> float:
        """How long after `since` it takes until `flags` hold for WANTED of the flights, for good.

        Of some hundred flights of a filter that is right, chance alone has some outside now and
        then: only an instant at which twice as many lack is one before the recovery.

        Returns:
            Time [s]; infinite if they never do.
        """
        after = self.time > since + 1e-9
        share = flags[after].mean(axis=1)
        lacking = np.flatnonzero(share < 1.0 - 2.0 * (1.0 - WANTED))
        share[: lacking[-1] + 1 if lacking.size else 0] = 0.0
        enough = np.flatnonzero(share >= WANTED)
        return float(self.time[after][enough[0]] - since) if enough.size else np.inf

    def missed_alarms(self) -> Flags:
        """(flights,) which were far off for MISSED_AFTER on end without being told."""
        return longest(self.far_off & ~self.told) * self._every >= MISSED_AFTER - 1e-9

    def long_far_off(self) -> Flags:
        """(flights,) which were far off for MISSED_AFTER on end, told or not."""
        return longest(self.far_off) * self._every >= MISSED_AFTER - 1e-9

    def alarms(self) -> int:
        """How often flights were told anew."""
        before = np.vstack([np.zeros_like(self.told[:1]), self.told[:-1]])
        return int((self.told & ~before).sum())

    @property
    def hours(self) -> float:
        """Time flown by all flights together [h]."""
        return float(self.right.size * self._every / 3600.0)

    @property
    def _every(self) -> float:
        return float(self.time[1] - self.time[0])


def longest(flags: Flags) -> NDArray[np.int64]:
    """(n,) the longest run of instants, the first axis, at which flags hold."""
    best = np.zeros(flags.shape[1:], np.int64)
    run = best.copy()
    for now in flags:
        run = np.where(now, run + 1, 0)
        best = np.maximum(best, run)
    return best


def follow_recovery(
    batch: FlightBatch, *, seeds: Sequence[int], duration: float, every: float = 0.1
) -> Recovery:
    """Fly, and note which flights are right, told or far off.

    Args:
        batch: Flights that nothing ends and whose filters watch their innovations.
        seeds: One per flight.
        duration: Length of the flights [s].
        every: Time between two looks [s].

    Raises:
        ValueError: If there are fewer than two looks.
    """
    stride = max(1, round(every * batch.sensors.imu.rate))
    looks = round(duration * batch.sensors.imu.rate) // stride
    if looks < 2:
        raise ValueError(f"duration must be at least twice every, got {duration} and {every}")
    bound = chi_square_quantile(MOTION.stop - MOTION.start, RIGHT)
    shape = (looks, batch.count)
    right, told, far_off = np.zeros(shape, bool), np.zeros(shape, bool), np.zeros(shape, bool)
    batch.reset(seeds=seeds)
    for k in range(looks):
        for _ in range(stride):
            batch.step()
        errors, covariances = flight_errors(batch)[:, MOTION], batch.covariance()[:, MOTION, MOTION]
        sigma = np.sqrt(np.einsum("nii->ni", covariances))
        right[k] = nees(errors, covariances) < bound
        told[k] = batch.record("diverged") > 0.0
        far_off[k] = (np.abs(errors) > FAR_OFF * sigma).any(axis=1)
    time = np.array([batch.sensors.imu.dt * stride * k for k in range(1, looks + 1)])
    return Recovery(time, right, told, far_off)
