"""Recording of many flights, for tables and figures.

For each instant, only sums and percentiles over all flights are stored, so that a hundred thousand
flights fit into memory.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.consistency import flight_errors
from quad_gym.analysis.metrics import NO_CRASHES, RunningSummary, TrackingSummary, nees
from quad_gym.analysis.plots import Band, Trace
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import Ending, Source
from quad_gym.rotations import quaternion_to_dcm

Floats = NDArray[np.float64]
_NEES_SAMPLES = 20
"""Number of evenly spaced instants at which NEES is computed."""


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
    """5th to 95th percentile of the tracking errors, see `Tracer.percentiles`"""
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
    progress: Callable[[range], Iterable[int]] = iter,
) -> Recording:
    """Fly a batch of `Control.PD` without autoreset, and record `steps + 1` instants.

    A flight is recorded from its start up to the step before the one that ends its episode.

    Args:
        batch: Flights.
        seeds: Seeds of the flights.
        steps: Number of control periods.
        progress: Function that wraps the range of instants, such as `tqdm.tqdm`.
    """
    count = batch.count
    times = np.arange(steps + 1, dtype=np.float64) / batch.clocks.control_rate
    estimating = batch.source == Source.ESTIMATE
    flying = np.ones(count, bool)
    ending, ended_at = np.zeros(count, np.int64), np.full(count, np.nan)
    tracer, tracking, estimation = Tracer(), *(RunningSummary(count, steps + 1) for _ in range(2))
    samples = np.unique(np.linspace(0, steps, _NEES_SAMPLES + 1).round().astype(int)[1:])
    nees_values = np.full((len(samples), count), np.nan)

    for step in progress(range(steps + 1)):
        if step == 0:
            batch.reset(seeds=seeds)
        else:
            batch.step()
            over = flying & (batch.result("terminated") + batch.result("truncated") > 0.0)
            ending[over], ended_at[over] = batch.result("ending")[over], times[step]
            flying &= ~over
        tracer.add(step, batch, flying)
        tracking.add(batch.record("position_error"), flying)
        estimation.add(batch.record("estimation_error"), flying)
        row = int(np.searchsorted(samples, step))
        if estimating and samples[row] == step and flying.any():
            errors_hat, P = flight_errors(batch), batch.covariance()
            nees_values[row, flying] = nees(errors_hat[flying], P[flying])

    trace = tracer.trace()
    low, _, high = tracer.percentiles[:, : len(trace.time)]
    share = "all" if np.allclose(low, high, equal_nan=True) else "5 to 95 % of"
    return Recording(
        tracking=tracking.result(),
        estimation=estimation.result() if estimating else None,
        ending=ending,
        ended_at=ended_at,
        trace=trace,
        band=Band(low, high, f"{share} {count:,} flights" if count > 1 else "the only flight"),
        nees_time=times[samples],
        nees=nees_values,
    )


class Tracer:
    """Recorder of the errors of all episodes over time, and of the path of the first one.

    Its method `add` is a `watch` of `evaluation.roll_out`, without same-step autoreset.
    """

    def __init__(self) -> None:
        self._percentiles: list[Floats] = []
        self._shares: list[float] = []
        self._path: list[tuple[Floats, Floats, Floats, Floats]] = []
        self._gates: Floats | None = None
        self._control_rate = 0.0

    def add(self, step: int, batch: FlightBatch, flying: NDArray[np.bool_]) -> None:
        """Record the present instant; `flying` (n,) is True for episodes in progress."""
        first, errors = np.zeros(1, np.intp), batch.record("position_error")
        if step == 0:
            self._control_rate = batch.clocks.control_rate
            self._flying, self._crashed = flying.copy(), np.zeros(len(flying), bool)
            if batch.task.kind == "waypoints":
                self._gates = batch.record("gates", first)[0, : batch.task.gate_count]
        if (ended := self._flying & ~flying).any():
            regular = (Ending.TIME_LIMIT, *NO_CRASHES)
            self._crashed[ended] = ~np.isin(batch.result("ending")[ended], regular)
        self._flying = flying.copy()
        counted = np.where(self._crashed, batch.task.out_of_bounds, errors)[flying | self._crashed]
        shares = np.percentile(counted, (5.0, 50.0, 95.0)) if counted.size else [np.nan] * 3
        self._percentiles.append(np.asarray(shares))
        self._shares.append(1.0 - float(self._crashed.mean()))
        if flying[0]:
            q, place = batch.record("q", first)[0], batch.record("r", first)[0]
            self._path.append((place, q, batch.read("reference_position", first)[0], errors[0]))

    @property
    def time(self) -> Floats:
        """Times since the start, (k,) [s]."""
        return np.arange(len(self._percentiles)) / self._control_rate

    @property
    def percentiles(self) -> Floats:
        """5th, 50th and 95th percentile of the errors, (3, k) [m].

        A crashed episode counts with the bound `out_of_bounds` of the task from its crash on, so
        that crashes never lower a percentile. Episodes that ended otherwise are left out.
        """
        return np.stack(self._percentiles, axis=1)

    @property
    def not_crashed(self) -> Floats:
        """Share of the episodes that have not crashed, (k,)."""
        return np.array(self._shares)

    def trace(self) -> Trace:
        """Path of the first flight, up to its end."""
        position, q, reference, error = map(np.array, zip(*self._path, strict=True))
        places, heading = reference if self._gates is None else self._gates, quaternion_to_dcm(q)
        return Trace(self.time[: len(position)], position, heading[:, 0, :2], places, error)
