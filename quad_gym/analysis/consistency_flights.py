"""Flights that test a filter's consistency, and their findings, in numbers and in words."""

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
    start_matched,
    verdict,
)
from quad_gym.analysis.metrics import RunningSummary, TrackingSummary
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.params.task import TaskParams


def endless(task: TaskParams) -> TaskParams:
    """A task in which nothing ends a flight, so that all flights last equally long."""
    return task.replace(  # type: ignore[no-any-return]
        duration=0.0, out_of_bounds=1e9, min_height=-1e9, max_tilt=math.pi
    )


@dataclass(frozen=True)
class Findings:
    """What was found about a filter."""

    nees: dict[str, MeanSquare]
    """by the names of `quad_gym.analysis.consistency.PARTS`"""
    nis: dict[str, MeanSquare]
    """by sensor"""
    whiteness: dict[str, Whiteness]
    """of the innovations, by sensor"""
    errors: Floats
    """(t, 15) root mean square errors over flights"""
    claimed: Floats
    """(t, 15) root mean square deviations that the filters claim"""
    tracking: TrackingSummary
    """distance of the true position from the reference, (flights,) [m]"""
    astray: NDArray[np.bool_]
    """(flights,) whether a flight was ever farther from its reference than `ASTRAY`"""
    failed: int
    """filters that failed in a cycle"""
    counted_as_noise: frozenset[str] = frozenset()
    """sensors whose constant error the filter counts as white noise: their innovations are smaller
    than it claims, and alike over time, while the state is consistent"""

    def since(self, start: float) -> "Findings":
        """What counts if the first instants do not: mean squares from `start` on [s]."""
        nees = {name: part.since(start) for name, part in self.nees.items()}
        nis = {name: part.since(start) for name, part in self.nis.items()}
        return replace(self, nees=nees, nis=nis)

    @property
    def consistent(self) -> bool:
        """Whether everything is as a consistent filter's.

        Of sensors whose constant error counts as noise, innovations must not be too large.
        """
        apart = self.counted_as_noise
        squares = [*self.nees.values(), *(p for name, p in self.nis.items() if name not in apart)]
        small = all(part.overall <= part.dimension for n, part in self.nis.items() if n in apart)
        white = all(part.white for name, part in self.whiteness.items() if name not in apart)
        return self.failed == 0 and white and small and all(part.consistent for part in squares)

    def sentences(self) -> dict[str, str]:
        """Verdicts in plain English, by what they are on."""
        why = " Expected: the filter counts a constant error as noise."
        known = dict.fromkeys(self.counted_as_noise, why)
        said = {f"nees_{name}": f"NEES of the {verdict(part)}" for name, part in self.nees.items()}
        for name, part in self.nis.items():
            said[f"nis_{name}"] = f"NIS of the {verdict(part)}{known.get(name, '')}"
        for name, white in self.whiteness.items():
            largest = f"autocorrelation at most {white.largest:+.3f}"
            judged = "white" if white.white else "not white"
            told = f"Innovations of the {name}: {largest}: {judged}."
            said[f"innovations_{name}"] = told + known.get(name, "")
        return said


ASTRAY = 5.0
"""Distance from the reference beyond which a flight counts as astray [m]."""


def measure_consistency(
    batch: FlightBatch,
    *,
    seeds: Sequence[int],
    duration: float,
    every: float = 0.05,
    settle: float = 0.0,
    matched: bool = False,
    progress: Callable[[float], Any] = lambda time: None,
) -> Findings:
    """Fly, and compare errors and innovations with what the filters claim.

    Args:
        batch: Flights that nothing ends, see `endless`, which keep their innovations.
        seeds: One per flight.
        duration: Length of the flights [s].
        every: Time between two looks at the errors [s].
        settle: Innovations before do not count for their autocorrelation [s].
        matched: Whether the filters start with errors drawn from their own covariance.
        progress: Called now and then with the time flown [s].

    Raises:
        ValueError: If duration and every are not positive, or a step is more than a tick.
    """
    if not (duration > 0.0 and every > 0.0):
        raise ValueError(f"duration and every must be above 0, got {duration} and {every}")
    if batch.clocks.ticks_between("control") != 1:
        raise ValueError("batch must be controlled at its IMU rate, so that nothing is missed")
    dt = batch.sensors.imu.dt
    steps, stride = round(duration / dt), max(1, round(every / dt))
    squares = NeesRecorder()
    bins = dt * stride * np.arange(steps // stride + 1)
    innovations = InnovationRecorder(batch, bins, settle)
    tracking = RunningSummary(batch.count, steps)
    astray = np.zeros(batch.count, bool)
    batch.reset(seeds=seeds)
    if matched:
        start_matched(batch, int(seeds[0]))
    squares.add(batch, 0.0)
    for step in range(1, steps + 1):
        batch.step()
        innovations.add(batch, step * dt)
        distance = batch.result("position_error")
        tracking.add(distance)
        astray |= ~(distance < ASTRAY)
        if step % stride == 0:
            squares.add(batch, step * dt)
            progress(step * dt)
    errors, claimed = squares.errors()
    return Findings(
        nees=squares.nees(),
        nis=innovations.nis(),
        whiteness=innovations.whiteness(),
        errors=errors,
        claimed=claimed,
        tracking=tracking.result(),
        astray=astray,
        failed=int((batch.record("filter_status") != 0).sum()),
        counted_as_noise=_counted_as_noise(batch),
    )


def _counted_as_noise(batch: FlightBatch) -> frozenset[str]:
    """The sensors of `Findings.counted_as_noise`."""
    gnss = batch.sensors.gnss
    return frozenset({"baseline"} if gnss is not None and gnss.heading_errs else ())
