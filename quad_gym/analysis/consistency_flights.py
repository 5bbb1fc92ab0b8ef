"""Flights that test a filter's consistency, with findings as numbers and as sentences."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.consistency import (
    Floats,
    InnovationRecorder,
    MeanSquare,
    NeesRecorder,
    Whiteness,
    verdict,
)
from quad_gym.analysis.metrics import RunningSummary, TrackingSummary
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.params.task import TaskParams


def endless(task: TaskParams) -> TaskParams:
    """Remove all endings from a task, so that all flights have the same length."""
    return task.replace(  # type: ignore[no-any-return]
        duration=0.0, out_of_bounds=1e9, min_height=-1e9, max_tilt=math.pi
    )


@dataclass(frozen=True)
class Findings:
    """Findings about the consistency of a filter."""

    nees: dict[str, MeanSquare]
    """Mean NEES over time, by the names of `quad_gym.analysis.consistency.PARTS`"""
    nis: dict[str, MeanSquare]
    """Mean NIS over time, by sensor"""
    whiteness: dict[str, Whiteness]
    """Autocorrelation of the innovations, by sensor"""
    time: Floats
    """Times of the errors since the start, (t,) [s]"""
    errors: Floats
    """Root mean square errors over flights, (t, 15)"""
    claimed: Floats
    """Root mean square of the filters' standard deviations over flights, (t, 15)"""
    tracking: TrackingSummary
    """Distance of the true position from the reference, (flights,) [m]"""
    astray: NDArray[np.bool_]
    """True for flights that were ever farther than `ASTRAY` from their reference, (flights,)"""
    failed: int
    """Number of filters with a numerical failure"""
    counted_as_noise: frozenset[str] = frozenset()
    """Sensors with a constant error that the filter models as white noise: their innovations are
    smaller than the filter expects, and correlated over time, although the state is consistent"""

    def since(self, start: float) -> "Findings":
        """Select mean squares from `start` on [s], to leave out the first instants."""
        nees = {name: part.since(start) for name, part in self.nees.items()}
        nis = {name: part.since(start) for name, part in self.nis.items()}
        return replace(self, nees=nees, nis=nis)

    @property
    def consistent(self) -> bool:
        """True if NEES, NIS, whiteness and status are those expected of a consistent filter.

        Where a constant error is modeled as noise, innovations only must not be too large.
        """
        apart = self.counted_as_noise
        squares = [*self.nees.values(), *(p for name, p in self.nis.items() if name not in apart)]
        small = all(part.overall <= part.dimension for n, part in self.nis.items() if n in apart)
        white = all(part.white for name, part in self.whiteness.items() if name not in apart)
        return self.failed == 0 and white and small and all(part.consistent for part in squares)

    def sentences(self) -> dict[str, str]:
        """Verdicts in plain English, by quantity."""
        why = " Expected: the filter models a constant error as noise."
        known = dict.fromkeys(self.counted_as_noise, why)
        said = {f"nees_{name}": f"NEES of the {verdict(part)}" for name, part in self.nees.items()}
        for name, part in self.nis.items():
            said[f"nis_{name}"] = f"NIS of the {verdict(part)}{known.get(name, '')}"
        for name, white in self.whiteness.items():
            found = f"largest autocorrelation {white.largest:+.3f}: {'' if white.white else 'not '}"
            said[f"innovations_{name}"] = f"Innovations of the {name}: {found}white."
            said[f"innovations_{name}"] += known.get(name, "")
        return said


ASTRAY = 5.0  #: distance from the reference beyond which a flight counts as lost [m]


def measure_consistency(
    batch: FlightBatch,
    *,
    seeds: Sequence[int],
    duration: float,
    every: float = 0.05,
    settle: float = 0.0,
    progress: Callable[[float], Any] = lambda time: None,
) -> Findings:
    """Fly, and compare errors and innovations with the covariances of the filters.

    Args:
        batch: Flights of a task without endings, see `endless`, with `innovations=True` or a user's
            estimator, whose innovations are unknown.
        seeds: Seeds of the flights.
        duration: Length of the flights [s].
        every: Evaluation interval of the errors [s].
        settle: Time before which innovations are left out of the autocorrelation [s].
        progress: Function called repeatedly with the time flown so far [s].

    Raises:
        ValueError: If `duration` or `every` is not positive, or the control rate of the batch is
            not its IMU rate.
    """
    if not (duration > 0.0 and every > 0.0):
        raise ValueError(f"duration and every must be above 0, got {duration} and {every}")
    if batch.clocks.ticks_per_step != 1:
        raise ValueError("batch must be controlled at its IMU rate, so that no sample is missed")
    dt = batch.sensors.imu.dt
    steps, stride = round(duration / dt), max(1, round(every / dt))
    squares = NeesRecorder()
    bins = dt * stride * np.arange(steps // stride + 1)
    innovations = InnovationRecorder(batch, bins, settle) if batch.innovations else None
    tracking = RunningSummary(batch.count, steps)
    astray = np.zeros(batch.count, bool)
    batch.reset(seeds=seeds)
    squares.add(batch, 0.0)
    for step in range(1, steps + 1):
        batch.step()
        if innovations is not None:
            innovations.add(batch, step * dt)
        distance = batch.result("position_error")
        tracking.add(distance)
        astray |= ~(distance < ASTRAY)
        if step % stride == 0:
            squares.add(batch, step * dt)
            progress(step * dt)
    errors, claimed = squares.errors()
    gnss = batch.sensors.gnss
    return Findings(
        nees=squares.nees(),
        nis={} if innovations is None else innovations.nis(),
        whiteness={} if innovations is None else innovations.whiteness(),
        time=squares.time(),
        errors=errors,
        claimed=claimed,
        tracking=tracking.result(),
        astray=astray,
        failed=int((batch.record("filter_status") != 0).sum()),
        counted_as_noise=frozenset({"baseline"} if gnss and gnss.heading_errs else ()),
    )
