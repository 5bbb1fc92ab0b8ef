"""Filter consistency: flights that test it, statistics, findings and figures.

If the covariance P is correct, the normalized estimation error squared (NEES) e^T P^-1 e has a
chi-square distribution with as many degrees of freedom as coordinates, so that its mean over n
independent flights is within a known band with a probability of 95 %, at each instant. The same
holds for the normalized innovation squared (NIS) of a measurement, and innovations are white. The
error e is truth minus estimate in the filter's error coordinates; the truth comes from the
simulator, not from the filter's model.

The criterion is practical: the mean must be within the 95 % band of a mean over at most 1,000
flights (2.3 % about the expected value for 15 coordinates, 5 % for 3) at 90 % of the instants.

Source: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 5.4.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym import records
from quad_gym.analysis import plots
from quad_gym.analysis.metrics import (
    STATE_DIMENSION,
    RunningSummary,
    TrackingSummary,
    mean_band,
    nees,
    state_error,
)
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.params import checks as check
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.task import TaskParams
from quad_gym.rotations import quaternion_to_dcm

# --------------------------------------------------------------------------------------------------
# Filter consistency: statistics over many flights, compared with those of a consistent filter.
# --------------------------------------------------------------------------------------------------

PARTS = {
    "state": slice(0, STATE_DIMENSION),
    "position": slice(0, 3),
    "velocity": slice(3, 6),
    "attitude": slice(6, 9),
    "accel_bias": slice(9, 12),
    "gyro_bias": slice(12, 15),
}
"""Parts of the error state, in the order of the covariance: all of it, and blocks of three."""

FIELDS = {"position": "r", "velocity": "v", "accel_bias": "b_a", "gyro_bias": "b_g"}
"""Fields of the true values; the fields of estimates end in `_hat`."""

CONSISTENT_SHARE = 0.9
"""Share of instants that must be inside the band for a filter to be called consistent."""

BAND_FLIGHTS = 1000
"""Highest number of flights for which the band is computed.

With more flights the band is a fixed tolerance, 2.3 % for the whole state: with enough flights,
deviations from the expected value would be significant even if they are negligible."""

NEGLIGIBLE_CORRELATION = 0.02
"""Autocorrelation of innovations that is negligible even if it is statistically significant."""

Floats = NDArray[np.float64]


def flight_errors(batch: FlightBatch, *, rotation_vector: bool = False) -> Floats:
    """Errors of a batch's filters in the coordinates of their covariances, (count, 15).

    With `rotation_vector`, those of the attitude are rotation vectors in every suite.
    """
    truth = {name: batch.record(field) for name, field in FIELDS.items()}
    estimate = {name: batch.record(f"{field}_hat") for name, field in FIELDS.items()}
    R_BI, R_hat = quaternion_to_dcm(batch.record("q")), batch.record("R_hat")
    return state_error(
        truth | {"R_BI": R_BI},
        estimate | {"R_BI": R_hat},
        rotation_vector=rotation_vector or batch.sensors.flow_alone,
    )


@dataclass(frozen=True)
class MeanSquare:
    """Mean NEES or NIS over flights as a function of time, with the band of a consistent filter."""

    name: str
    """Name of the part of the state, or of the sensor"""
    dimension: int
    """Degrees of freedom, which is the expected mean of a consistent filter"""
    time: Floats
    """Time since the start, (t,) [s]"""
    mean: Floats
    """Means over flights, (t,) [-]"""
    low: Floats
    """Lower ends of the 95 % band of a mean over at most `BAND_FLIGHTS` flights, (t,)"""
    high: Floats
    """Upper ends of this band, (t,)"""

    @property
    def share_inside(self) -> float:
        """Share of instants whose mean is inside the band."""
        return float(((self.mean >= self.low) & (self.mean <= self.high)).mean())

    @property
    def overall(self) -> float:
        """Mean over flights and instants."""
        return float(self.mean.mean())

    @property
    def tolerance(self) -> float:
        """Half width of the band relative to the expected mean, averaged over time."""
        return float(0.5 * (self.high - self.low).mean() / self.dimension)

    @property
    def consistent(self) -> bool:
        """True if the mean is inside the band at `CONSISTENT_SHARE` of the instants or more."""
        return self.share_inside >= CONSISTENT_SHARE

    def since(self, start: float) -> "MeanSquare":
        """Select the instants from `start` on [s]; a ValueError if there are none."""
        kept = self.time >= start - 1e-9
        if not kept.any():
            raise ValueError(f"start must be before the last instant, got {start}")
        parts = (part[kept] for part in (self.time, self.mean, self.low, self.high))
        return MeanSquare(self.name, self.dimension, *parts)


def verdict(part: MeanSquare) -> str:
    """Describe a mean square in one sentence.

    Relative to the covariance, the errors are larger by the square root of mean over dimension.
    """
    inside = f"within {100 * part.tolerance:.2g} % of it at {100 * part.share_inside:.0f} %"
    what = (
        f"{part.name}: mean {part.overall:.2f}, expected {part.dimension}, {inside} of the instants"
    )
    if part.consistent:
        return f"{what}: consistent."
    ratio = float(np.sqrt(part.overall / part.dimension))
    percent = f"{100.0 * abs(ratio - 1.0):.1f} %"
    if ratio < 1.0:
        return f"{what}: too cautious, errors are {percent} smaller than its covariance implies."
    size = f"{percent} larger than" if ratio < 2.0 else f"{ratio:.1f} times as large as"
    return f"{what}: overconfident, errors are {size} its covariance implies."


def _mean_square(
    name: str, dimension: int, time: Floats, means: ArrayLike, counts: ArrayLike
) -> MeanSquare:
    """Means over `counts` flights, with their band."""
    low, high = mean_band(dimension, np.minimum(counts, BAND_FLIGHTS))
    return MeanSquare(name, dimension, time, np.asarray(means, np.float64), low, high)


class NeesRecorder:
    """Recorder of NEES, errors and standard deviations over time."""

    def __init__(self) -> None:
        self._time: list[float] = []
        self._means: dict[str, list[float]] = {name: [] for name in PARTS}
        self._errors: list[Floats] = []
        self._sigmas: list[Floats] = []
        self._count = 0

    def add(self, batch: FlightBatch, time: float) -> None:
        """Record the present instant of flights that all started `time` ago [s]."""
        errors, P = flight_errors(batch), batch.covariance()
        self._count = batch.count
        self._time.append(time)
        for name, part in PARTS.items():
            self._means[name].append(float(nees(errors[:, part], P[:, part, part]).mean()))
        self._errors.append(np.sqrt((errors**2).mean(axis=0)))
        self._sigmas.append(np.sqrt(np.diagonal(P, axis1=1, axis2=2).mean(axis=0)))

    def nees(self) -> dict[str, MeanSquare]:
        """Mean NEES over time of each part of the state, by the names of `PARTS`.

        Parts for which an estimator has no covariance after its start are left out.
        """
        later = slice(min(1, len(self._time) - 1), None)
        time, counts = np.array(self._time), np.full(len(self._time), self._count)
        return {
            name: _mean_square(name, part.stop - part.start, time, self._means[name], counts)
            for name, part in PARTS.items()
            if not np.isnan(self._means[name][later]).all()
        }

    def time(self) -> Floats:
        """Times of the recorded instants, (t,) [s]."""
        return np.array(self._time)

    def errors(self) -> tuple[Floats, Floats]:
        """Root mean square of errors and of standard deviations over flights, (t, 15) each."""
        return np.array(self._errors), np.array(self._sigmas)


SENSOR_BLOCKS = {
    READINGS[name].label: tuple(range(blocks.start, blocks.stop))
    for name, blocks in records.BLOCKS_OF.items()
}
"""Blocks of the measurement by sensor. Errors of features in one image are correlated through
attitude and position, so that only the first one is used: the values of an instant are independent.
"""


@dataclass(frozen=True)
class Whiteness:
    """Autocorrelation of a sensor's innovations, each over its expected standard deviation."""

    name: str
    """Name of the sensor"""
    correlation: Floats
    """Autocorrelation at lags of 1, 2, ... measurements, (lags,) [-]"""
    band: Floats
    """Half widths of the 95 % band of white innovations, (lags,)"""

    @property
    def largest(self) -> float:
        """Autocorrelation with the largest magnitude."""
        return float(self.correlation[np.abs(self.correlation).argmax()])

    @property
    def white(self) -> bool:
        """True if no correlation exceeds its band by more than `NEGLIGIBLE_CORRELATION`."""
        return bool((np.abs(self.correlation) <= self.band + NEGLIGIBLE_CORRELATION).all())


class InnovationRecorder:
    """Recorder of NIS over time and of the autocorrelation of innovations, for each sensor.

    Args:
        batch: Flights with `innovations=True`.
        bins: Edges of the intervals of time over which NIS is averaged, (k + 1,) [s].
        settle: Time before which innovations are left out of the autocorrelation [s].
        lags: Largest lag of the autocorrelation, in measurements.
    """

    def __init__(
        self, batch: FlightBatch, bins: ArrayLike, settle: float = 0.0, lags: int = 20
    ) -> None:
        self._bins, self._settle = np.asarray(bins, np.float64), settle
        size = self._bins.size - 1
        past = np.full((lags, batch.count, 3), np.nan)
        self._past = {name: past.copy() for name in SENSOR_BLOCKS}
        self._sums, self._counts, self._products, self._pairs, self._squares = (
            {name: np.zeros(count) for name in SENSOR_BLOCKS}
            for count in (size, size, lags, lags, 2)
        )

    def add(self, batch: FlightBatch, time: float) -> None:
        """Record the measurements of the present instant, `time` after the start [s]."""
        valid = batch.record("block_valid") > 0.0
        if not valid.any():
            return
        valid &= (
            batch.record("gate") != records.GateDecision.UNSURE
        )  # the filter does not use these
        nis, innovation = batch.record("block_nis"), batch.record("innovation")
        white = innovation / batch.record("innovation_sigma")
        span = min(int(np.searchsorted(self._bins, time - 1e-9, "right")), self._bins.size - 1) - 1
        for name, blocks in SENSOR_BLOCKS.items():
            seen = valid[:, blocks]
            flights = np.flatnonzero(seen.any(axis=1))
            if flights.size:
                taken = np.array(blocks)[seen[flights].argmax(axis=1)]
                self._sums[name][span] += nis[flights, taken].sum()
                self._counts[name][span] += flights.size
                if time >= self._settle:
                    self._correlate(name, flights, white[flights, taken])

    def _correlate(self, name: str, flights: NDArray[np.intp], white: Floats) -> None:
        """Multiply innovations by earlier ones of the flight, and add up the products."""
        past = self._past[name][:, flights]
        products = past * white
        self._products[name] += np.nansum(products, axis=(1, 2))
        self._pairs[name] += np.isfinite(products).sum(axis=(1, 2))
        self._squares[name] += np.nansum(white**2), np.isfinite(white).sum()
        self._past[name][1:, flights] = past[:-1]
        self._past[name][0, flights] = white

    def nis(self) -> dict[str, MeanSquare]:
        """Mean NIS over time of each sensor that has measured, by name."""
        middle, found = 0.5 * (self._bins[1:] + self._bins[:-1]), {}
        for name, blocks in SENSOR_BLOCKS.items():
            some = self._counts[name] > 0
            if some.any():
                counts, freedoms = self._counts[name][some], records.FREEDOMS[blocks[0]]
                means = self._sums[name][some] / counts
                found[name] = _mean_square(name, freedoms, middle[some], means, counts)
        return found

    def whiteness(self) -> dict[str, Whiteness]:
        """Autocorrelation of the innovations of each sensor that has measured often enough."""
        found = {}
        for name in SENSOR_BLOCKS:
            pairs, (total, number) = self._pairs[name], self._squares[name]
            if pairs.min() > 0:
                correlation = self._products[name] / pairs * number / total
                found[name] = Whiteness(name, correlation, 1.96 / np.sqrt(pairs))
        return found


# --------------------------------------------------------------------------------------------------
# Flights that test a filter's consistency, with findings as numbers and as sentences.
# --------------------------------------------------------------------------------------------------


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


EVERY = 0.05  #: evaluation interval of errors, and least length of flights [s]
ASTRAY = 5.0  #: distance from the reference beyond which a flight counts as lost [m]


def measure_consistency(
    batch: FlightBatch,
    *,
    seeds: Sequence[int],
    duration: float,
    every: float = EVERY,
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
        ValueError: If `every` is not positive, `duration` is shorter, or the control rate of the
            batch is not its IMU rate.
    """
    check.number("duration", duration, least=check.positive("every", every))
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
        counted_as_noise=frozenset(READINGS[name].label for name in batch.sensors.counted_as_noise),
    )


# --------------------------------------------------------------------------------------------------
# Figures of filter consistency: NEES and NIS, errors and standard deviations, autocorrelation.
# --------------------------------------------------------------------------------------------------

_UNITS = {
    "position": ("mm", 1e3),
    "velocity": ("mm/s", 1e3),
    "attitude": ("mrad", 1e3),
    "accel_bias": ("mm/s²", 1e3),
    "gyro_bias": ("deg/h", np.degrees(3600.0)),
}
_TOLERANCE = f"tolerance (gray): 95 % band of a mean over at most {BAND_FLIGHTS:,} flights"


def _grid(count: int, title: str, label: str = "time [s]") -> tuple[Any, Any]:
    """Make a figure with `count` axes, three in a row; four are two by two."""
    columns = 2 if count == 4 else 3
    rows = -(-count // columns)
    figure, grid = plots.panels(rows, columns, (10.0, 0.6 + 2.1 * rows), title)
    for spare in grid.ravel()[count:]:
        spare.set_visible(False)
    for axes in grid.ravel()[max(0, count - columns) : count]:
        axes.set_xlabel(label)
    return figure, grid.ravel()[:count]


def _title(name: str) -> str:
    return "whole state" if name == "state" else name.replace("_", " ")


def draw_mean_square(axes: Any, part: MeanSquare, settle: float = 0.0) -> None:
    """Draw a mean square over time with its band; the title states the share of instants inside.

    Instants before `settle` [s] are left out of the numbers in the title.
    """
    axes.fill_between(part.time, part.low, part.high, color=plots.PALE, linewidth=0.0)
    axes.axhline(part.dimension, color=plots.GREY, linewidth=0.8)
    axes.plot(part.time, part.mean, color=plots.BLUE, linewidth=1.2)
    if settle > 0.0:
        axes.axvline(settle, color=plots.VERMILLION, linewidth=0.8, linestyle=":")
    counted = part.since(settle)
    inside = f"{100 * counted.share_inside:.0f} % within ±{100 * counted.tolerance:.2g} %"
    axes.set_title(f"{_title(part.name)}: {counted.overall:.2f}, {inside}")
    reach = 3.0 * (part.high - part.low).max()
    gaps = np.abs(counted.mean - part.dimension)
    limit = max(reach, 1.15 * float(np.percentile(gaps, 98.0)))  # regardless of outliers
    axes.set_ylim(max(0.0, part.dimension - limit), part.dimension + limit)
    axes.set_xlim(0.0, part.time[-1])


@plots.house_style()
def mean_square_figure(
    quantity: str, parts: dict[str, MeanSquare], title: str, settle: float = 0.0
) -> Any:
    """Figure of the means of "NEES" of the state's parts, or "NIS" of the sensors, over time."""
    text = f"{title}\nMean {quantity} over flights (blue), and {_TOLERANCE}"
    figure, axes = _grid(len(parts), text)
    for axis, part in zip(axes, parts.values(), strict=True):
        draw_mean_square(axis, part, settle)
    return figure


@plots.house_style()
def errors_figure(time: Floats, errors: Floats, sigmas: Floats, title: str) -> Any:
    """Figure of root mean square errors and standard deviations of the filter, (t, 15) each."""
    what = "Error (blue), standard deviation of the filter (dashed)"
    text = f"{title}\n{what}; root mean square over flights"
    blocks = {name: part for name, part in PARTS.items() if name in _UNITS}
    figure, axes = _grid(len(blocks), text)
    for axis, (name, part) in zip(axes, blocks.items(), strict=True):
        unit, factor = _UNITS[name]
        for values, color, dashes in ((errors, plots.BLUE, "-"), (sigmas, plots.INK, (0, (4, 3)))):
            size = factor * np.sqrt((values[:, part] ** 2).sum(axis=1))
            axis.plot(time, size, color=color, linestyle=dashes, linewidth=1.3)
        axis.set_title(f"{_title(name)} [{unit}]")
        plots.logarithmic(axis, subs=(2.0, 5.0))
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.tick_params(axis="y", which="minor", labelsize=7.0)
        axis.set_xlim(0.0, time[-1])
    return figure


@plots.house_style()
def whiteness_figure(found: dict[str, Whiteness], title: str) -> Any:
    """Figure of the autocorrelation of each sensor's innovations, with the band of white noise."""
    text = f"{title}\nAutocorrelation of innovations, with the 95 % band of white noise (gray)"
    figure, axes = _grid(len(found), text, "lag [measurements]")
    for axis, part in zip(axes, found.values(), strict=True):
        lags = np.arange(1, part.correlation.size + 1)
        axis.fill_between(lags, -part.band, part.band, color=plots.PALE, linewidth=0.0)
        axis.axhline(0.0, color=plots.GREY, linewidth=0.8)
        axis.vlines(lags, 0.0, part.correlation, color=plots.BLUE, linewidth=1.6)
        axis.plot(
            lags, part.correlation, color=plots.BLUE, marker="o", markersize=3.0, linestyle="none"
        )
        limit = 1.2 * max(2.5 * NEGLIGIBLE_CORRELATION, np.abs(part.correlation).max())
        axis.set_ylim(-limit, limit)
        axis.set_title(f"{_title(part.name)}: largest {part.largest:+.3f}")
    return figure
