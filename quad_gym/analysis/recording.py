"""Recording of many flights, for tables and figures.

For each instant, only sums and percentiles over all flights are stored, so that a hundred thousand
flights fit into memory.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.consistency import flight_errors
from quad_gym.analysis.metrics import RunningSummary, TrackingSummary, nees
from quad_gym.analysis.plots import Band, Trace
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import Ending, Source
from quad_gym.rotations import quaternion_to_dcm

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Recording:
    """Results of a batch of n flights."""

    tracking: TrackingSummary
    """Distance of the true position from the reference, (n,) [m]"""
    estimation: TrackingSummary | None
    """Distance between estimated and true position, (n,) [m]; None without a filter"""
    ending: NDArray[np.int64]
    """Reasons why flights ended early, (n,), see `Ending`; 0: completed"""
    ended_at: Floats
    """Times at which flights ended early, (n,) [s]; NaN: completed"""
    trace: Trace
    """First flight, up to its ending"""
    band: Band
    """5th to 95th percentile of the tracking errors of flights in progress"""
    nees_time: Floats
    """Times at which NEES was computed, (k,) [s]"""
    nees: Floats
    """NEES of the whole state, (k, n); NaN after an ending and without a filter"""

    @property
    def finished(self) -> NDArray[np.bool_]:
        """True for flights that were completed, (n,)."""
        return np.asarray(self.ending == Ending.NONE)

    @property
    def nees_last_half(self) -> Floats:
        """NEES values of all flights in the last half of the time, (m,) without NaN."""
        late = self.nees[self.nees_time >= 0.5 * self.nees_time[-1]]
        return np.asarray(late[np.isfinite(late)])

    def count(self, *, filter_failed: bool) -> int:
        """Number of flights that ended early: by a failure of the filter, or else by a crash."""
        of_filter = self.ending == Ending.FILTER_FAILED
        return int((~self.finished & (of_filter == filter_failed)).sum())

    def ending_names(self) -> list[str]:
        """Name of each flight's ending, or "finished"."""
        names = {int(e): str(e) for e in Ending} | {0: "finished"}
        return [names[int(code)] for code in self.ending]


def record_flights(
    batch: FlightBatch,
    seeds: Sequence[int],
    steps: int,
    *,
    nees_samples: int = 20,
    progress: Callable[[range], Iterable[int]] | None = None,
) -> Recording:
    """Fly and record all flights of a batch with built-in PD control.

    A flight is recorded up to the step before the one that ends its episode.

    Args:
        batch: Flights of `Control.PD` without autoreset.
        seeds: Seeds of the flights.
        steps: Number of control periods.
        nees_samples: Number of evenly spaced instants at which NEES is computed.
        progress: Function that wraps the range of instants, such as `tqdm.tqdm`.

    Returns:
        Recording of `steps + 1` instants, of which the start is the first.
    """
    count = batch.count
    times = np.arange(steps + 1, dtype=np.float64) / batch.clocks.control_rate
    estimating = batch.source == Source.ESTIMATE
    flying = np.ones(count, bool)
    ending, ended_at = np.zeros(count, np.int64), np.full(count, np.nan)
    tracking, estimation = RunningSummary(count, steps + 1), RunningSummary(count, steps + 1)
    position, quaternion = np.empty((steps + 1, 3)), np.empty((steps + 1, 4))
    error, percentiles = np.full(steps + 1, np.nan), np.full((2, steps + 1), np.nan)
    samples = np.unique(np.linspace(0, steps, nees_samples + 1).round().astype(int)[1:])
    nees_values = np.full((len(samples), count), np.nan)

    instants = range(steps + 1)
    for step in instants if progress is None else progress(instants):
        if step == 0:
            batch.reset(seeds=seeds)
        else:
            batch.step()
            over = flying & (batch.result("terminated") + batch.result("truncated") > 0.0)
            ending[over], ended_at[over] = batch.result("ending")[over], times[step]
            flying &= ~over
        errors = batch.record("position_error")
        tracking.add(errors, flying)
        estimation.add(batch.record("estimation_error"), flying)
        if flying.any():
            percentiles[:, step] = np.percentile(errors[flying], (5.0, 95.0))
        position[step], quaternion[step] = batch.record("r")[0], batch.record("q")[0]
        error[step] = errors[0]
        row = int(np.searchsorted(samples, step))
        if estimating and samples[row] == step and flying.any():
            errors_hat, P = flight_errors(batch), batch.covariance()
            nees_values[row, flying] = nees(errors_hat[flying], P[flying])

    alike = bool(np.allclose(percentiles[0], percentiles[1], equal_nan=True))
    share = "all" if alike else "5 to 95 % of"
    shown = slice(0, len(times) if flying[0] else int((times < ended_at[0]).sum()))
    return Recording(
        tracking=tracking.result(),
        estimation=estimation.result() if estimating else None,
        ending=ending,
        ended_at=ended_at,
        trace=Trace(
            time=times[shown],
            position=position[shown],
            heading=quaternion_to_dcm(quaternion[shown])[:, 0, :2],
            reference=reference_of_flight(batch, 0, times[shown]),
            error=error[shown],
        ),
        band=Band(
            low=percentiles[0, shown],
            high=percentiles[1, shown],
            label=f"{share} {count:,} flights" if count > 1 else "the only flight",
        ),
        nees_time=times[samples],
        nees=nees_values,
    )


class Tracer:
    """Recorder of episodes over time: the errors of all flights, and the paths of the first ones.

    Pass its method `add` to `evaluation.roll_out` as `watch`. The environment must not use
    same-step autoreset. Arrays have one entry per instant, beginning with the start.

    Args:
        paths: Number of flights whose paths are recorded.
    """

    def __init__(self, paths: int = 1) -> None:
        self._paths = paths
        self._errors: list[Floats] = []
        self._positions: list[Floats] = []
        self._headings: list[Floats] = []
        self._references: Floats | None = None
        self.control_rate = 0.0

    def add(self, step: int, batch: FlightBatch, flying: NDArray[np.bool_]) -> None:
        """Record the present instant of episodes in progress.

        Args:
            step: Number of the step; 0 at the start.
            batch: Flights.
            flying: True for episodes in progress, (n,).
        """
        first = np.arange(min(self._paths, batch.count))
        if step == 0:
            self.control_rate = batch.clocks.control_rate
            times = np.arange(batch.max_steps + 1) / self.control_rate
            gates = batch.record("gates", first)[:, : batch.task.gate_count]
            course = batch.task.kind == "waypoints"
            paths = [reference_of_flight(batch, int(i), times) for i in first]
            self._references = gates if course else np.stack(paths)
        here = flying[first, np.newaxis]
        self._errors.append(np.where(flying, batch.record("position_error"), np.nan))
        self._positions.append(np.where(here, batch.record("r", first), np.nan))
        R_BI = quaternion_to_dcm(batch.record("q", first))
        self._headings.append(np.where(here, R_BI[:, 0, :2], np.nan))

    @property
    def time(self) -> Floats:
        """Times since the start, (k,) [s]."""
        return np.arange(len(self._errors)) / self.control_rate

    @property
    def errors(self) -> Floats:
        """True position errors, (k, n) [m]; NaN after the end of an episode."""
        return np.stack(self._errors)

    @property
    def percentiles(self) -> Floats:
        """5th, 50th and 95th percentile of the errors of episodes in progress, (3, k) [m]."""
        errors = self.errors
        found = np.full((3, len(errors)), np.nan)
        flown = np.isfinite(errors).any(axis=1)
        found[:, flown] = np.nanpercentile(errors[flown], (5.0, 50.0, 95.0), axis=1)
        return found

    def trace(self, flight: int) -> Trace:
        """Path of one of the first flights, up to its end."""
        position = np.stack(self._positions)[:, flight]
        shown = np.isfinite(position[:, 0])
        assert self._references is not None
        reference = self._references[flight]
        return Trace(
            time=self.time[shown],
            position=position[shown],
            heading=np.stack(self._headings)[shown, flight],
            reference=reference[: len(shown)][shown] if len(reference) >= len(shown) else reference,
            error=self.errors[shown, flight],
        )


def reference_of_flight(batch: FlightBatch, flight: int, times: Floats) -> Floats:
    """Reference positions of a flight at given times [s], (n, 3) in I [m]."""
    followed = batch.trajectory(flight)
    if followed is not None:
        trajectory, phase = followed
        return trajectory(times + phase)
    omega, center = batch.record("ref_omega")[flight], batch.record("ref_center")[flight]
    cosines, sines = batch.record("ref_cos")[flight], batch.record("ref_sin")[flight]
    angles = omega * np.outer(times, np.arange(1, len(cosines) + 1))
    return np.asarray(center + np.cos(angles) @ cosines + np.sin(angles) @ sines)
