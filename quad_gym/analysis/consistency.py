"""Filter consistency: statistics over many flights, with the bands of a consistent filter.

If the covariance P is right, the normalized estimation error squared (NEES) e^T P^-1 e is
chi-square with the number of its coordinates, so that its mean over n independent flights lies in a
known band 95 times in 100, at each instant. So is the innovation squared (NIS) of a measurement,
and innovations are white. The error e is truth minus estimate in the filter's
error coordinates, with the truth from the simulator, not from the filter's model.

Source: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 5.4.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.analysis.metrics import STATE_DIMENSION, nees, state_error
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import (
    AID_BLOCKS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    FREEDOMS,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    WIDTH,
    Aid,
    GateDecision,
)
from quad_gym.rotations import euler_to_dcm, quaternion_to_dcm

PARTS = {
    "state": slice(0, STATE_DIMENSION),
    "position": slice(0, 3),
    "velocity": slice(3, 6),
    "attitude": slice(6, 9),
    "accel_bias": slice(9, 12),
    "gyro_bias": slice(12, 15),
}
"""The whole error state and its blocks of three, as of the covariance."""

CONSISTENT_SHARE = 0.9
"""Share of instants in the 95 % band from which a filter is called consistent."""

BAND_FLIGHTS = 1000
"""Flights whose mean the band is for, where there are more. The means over more flights have less
chance in them; they are then judged by how far off they are, some 2 % for the whole state, and not
by whether enough flights can tell."""

NEGLIGIBLE_CORRELATION = 0.02
"""Of innovations: it does not matter, even where flights enough can tell it from zero."""

Floats = NDArray[np.float64]


def flight_errors(batch: FlightBatch) -> Floats:
    """(count, 15) errors of a batch's filters, in the coordinates of their covariances."""
    truth = {
        "position": batch.record("r"),
        "velocity": batch.record("v"),
        "R_BI": quaternion_to_dcm(batch.record("q")),
        "accel_bias": batch.record("b_a"),
        "gyro_bias": batch.record("b_g"),
    }
    estimate = {
        "position": batch.record("r_hat"),
        "velocity": batch.record("v_hat"),
        "R_BI": batch.record("R_hat"),
        "accel_bias": batch.record("b_a_hat"),
        "gyro_bias": batch.record("b_g_hat"),
    }
    return state_error(truth, estimate)


def start_matched(batch: FlightBatch, seed: int) -> None:
    """Give all filters a start whose errors have the covariance that they claim at this instant.

    A first fix does not: a level attitude is assumed, and the covariance that goes with it is a
    guess. While tilt and accelerometer bias look alike, that guess lives on for long. The estimates
    become the truth less errors drawn from each filter's own covariance.

    Args:
        batch: The flights, just reset; only their estimates change.
        seed: Of the draws.
    """
    flights, factor = batch.count, batch.record("L")
    draws = np.random.default_rng(seed).normal(size=(flights, STATE_DIMENSION, 1))
    errors = (factor @ draws)[..., 0]
    R_BI = quaternion_to_dcm(batch.record("q"))
    R_hat = np.swapaxes(euler_to_dcm(errors[:, PARTS["attitude"]]), 1, 2) @ R_BI
    estimates = {
        "r_hat": batch.record("r") - errors[:, PARTS["position"]],
        "v_hat": batch.record("v") - errors[:, PARTS["velocity"]],
        "R_hat": R_hat,
        "b_a_hat": batch.record("b_a") - errors[:, PARTS["accel_bias"]],
        "b_g_hat": batch.record("b_g") - errors[:, PARTS["gyro_bias"]],
    }
    blocks, flight = batch.snapshot(), np.arange(flights)
    for name, values in estimates.items():
        blocks[name][flight // WIDTH, ..., flight % WIDTH] = values
    batch.restore(blocks)


def mean_band(
    dimension: int, counts: ArrayLike, probability: float = 0.95
) -> tuple[Floats, Floats]:
    """Where means of independent chi-square values lie, instant by instant.

    Args:
        dimension: Degrees of freedom of one value.
        counts: (t,) how many values each mean is of, at least 1.
        probability: Of a mean to lie in its band; what is left is split evenly.

    Returns:
        Lower and upper ends, (t,) each.

    Raises:
        ValueError: If a number is out of its range.
    """
    n = np.asarray(counts, np.float64)
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability must be between 0 and 1, got {probability}")
    if dimension < 1 or n.size == 0 or n.min() < 1:
        raise ValueError(f"dimension and counts must be at least 1, got {dimension} and {n}")
    from scipy.stats import chi2

    tail = (1.0 - probability) / 2
    return chi2.ppf(tail, dimension * n) / n, chi2.ppf(1.0 - tail, dimension * n) / n


@dataclass(frozen=True)
class MeanSquare:
    """A normalized square over time: means over flights, and the band of a consistent filter."""

    name: str
    dimension: int
    """degrees of freedom: what the mean is about if the filter is consistent"""
    time: Floats
    """(t,) since the start [s]"""
    mean: Floats
    """(t,) over flights [-]"""
    low: Floats
    """(t,) lower end of the 95 % band"""
    high: Floats
    """(t,) its upper end"""

    @property
    def share_inside(self) -> float:
        """Share of instants whose mean lies in the band."""
        return float(((self.mean >= self.low) & (self.mean <= self.high)).mean())

    @property
    def overall(self) -> float:
        """Mean over flights and instants."""
        return float(self.mean.mean())

    @property
    def consistent(self) -> bool:
        """Whether the mean lies in the band at `CONSISTENT_SHARE` of the instants or more."""
        return self.share_inside >= CONSISTENT_SHARE

    def since(self, start: float) -> "MeanSquare":
        """The same from an instant on [s].

        Raises:
            ValueError: If nothing is left.
        """
        kept = self.time >= start - 1e-9
        if not kept.any():
            raise ValueError(f"start must be before the last instant, got {start}")
        parts = (part[kept] for part in (self.time, self.mean, self.low, self.high))
        return MeanSquare(self.name, self.dimension, *parts)


def verdict(part: MeanSquare) -> str:
    """One plain sentence on a mean square.

    The square root of mean over dimension is how many times as large as claimed the errors are.
    """
    inside = f"inside its band at {100 * part.share_inside:.0f} % of the instants"
    what = f"{part.name}: mean {part.overall:.2f} where {part.dimension} is right, {inside}"
    if part.consistent:
        return f"{what}: consistent."
    ratio = float(np.sqrt(part.overall / part.dimension))
    percent = f"{100.0 * abs(ratio - 1.0):.1f} %"
    if ratio < 1.0:
        return f"{what}: too cautious, as errors are {percent} smaller than it claims."
    size = f"{percent} larger than" if ratio < 2.0 else f"{ratio:.1f} times what"
    return f"{what}: overconfident, as errors are {size} it claims."


class NeesRecorder:
    """NEES of the state and its blocks, errors and claimed deviations, instant by instant."""

    def __init__(self) -> None:
        self._time: list[float] = []
        self._means: dict[str, list[float]] = {name: [] for name in PARTS}
        self._errors: list[Floats] = []
        self._sigmas: list[Floats] = []
        self._count = 0

    def add(self, batch: FlightBatch, time: float) -> None:
        """Take in the present instant of all flights.

        Args:
            batch: The flights, all of them since the same time.
            time: Since their start [s].
        """
        errors, P = flight_errors(batch), batch.covariance()
        self._count = batch.count
        self._time.append(time)
        for name, part in PARTS.items():
            self._means[name].append(float(nees(errors[:, part], P[:, part, part]).mean()))
        self._errors.append(np.sqrt((errors**2).mean(axis=0)))
        self._sigmas.append(np.sqrt(np.diagonal(P, axis1=1, axis2=2).mean(axis=0)))

    def nees(self) -> dict[str, MeanSquare]:
        """NEES over time, by the names of `PARTS`."""
        time, found = np.array(self._time), {}
        for name, part in PARTS.items():
            dimension = part.stop - part.start
            low, high = mean_band(dimension, np.full(time.shape, min(self._count, BAND_FLIGHTS)))
            found[name] = MeanSquare(name, dimension, time, np.array(self._means[name]), low, high)
        return found

    def errors(self) -> tuple[Floats, Floats]:
        """(t, 15) root mean square errors over flights, and deviations that the filter claims."""
        return np.array(self._errors), np.array(self._sigmas)


SENSOR_BLOCKS = {
    "position": (POSITION_BLOCK,),
    "baseline": (BASELINE_BLOCK,),
    "velocity": (VELOCITY_BLOCK,),
    "feature": tuple(range(FEATURE_BLOCKS, AID_BLOCKS)),
    **{aid.name.lower(): (AID_BLOCKS + aid,) for aid in Aid},
}
"""Blocks of the measurement by sensor. Features share an attitude and a position, so that only the
first one seen is taken of each image: what is taken at one instant is independent then."""


@dataclass(frozen=True)
class Whiteness:
    """Autocorrelation of a sensor's innovations, each divided by its expected deviation."""

    name: str
    correlation: Floats
    """(lags,) at 1, 2, ... measurements apart [-]"""
    band: Floats
    """(lags,) half width of the 95 % band of white innovations"""

    @property
    def largest(self) -> float:
        """The correlation farthest from zero."""
        return float(self.correlation[np.abs(self.correlation).argmax()])

    @property
    def white(self) -> bool:
        """Whether no correlation is beyond its band by more than `NEGLIGIBLE_CORRELATION`."""
        return bool((np.abs(self.correlation) <= self.band + NEGLIGIBLE_CORRELATION).all())


class InnovationRecorder:
    """Normalized innovations squared (NIS) over time and their autocorrelation, sensor by sensor.

    Args:
        batch: The flights, which keep their innovations.
        bins: (k + 1,) ends of the spans of time over which NIS is averaged [s].
        settle: Innovations before do not count for the autocorrelation [s].
        lags: Up to how many measurements apart correlations are taken.
    """

    def __init__(
        self, batch: FlightBatch, bins: ArrayLike, settle: float = 0.0, lags: int = 20
    ) -> None:
        self._bins, self._settle = np.asarray(bins, np.float64), settle
        size = self._bins.size - 1
        self._sums = {name: np.zeros(size) for name in SENSOR_BLOCKS}
        self._counts = {name: np.zeros(size) for name in SENSOR_BLOCKS}
        shape = (lags, batch.count, 3)
        self._past = {name: np.full(shape, np.nan) for name in SENSOR_BLOCKS}
        self._products = {name: np.zeros(lags) for name in SENSOR_BLOCKS}
        self._pairs = {name: np.zeros(lags) for name in SENSOR_BLOCKS}
        self._squares = {name: np.zeros(2) for name in SENSOR_BLOCKS}

    def add(self, batch: FlightBatch, time: float) -> None:
        """Take in what was measured at the present instant, `time` after the start [s]."""
        names = ("position", "baseline", "velocity", "feature", "aid")
        valid = np.column_stack([batch.record(f"{name}_valid") for name in names]) > 0.0
        if not valid.any():
            return
        valid &= batch.record("gate") != GateDecision.UNSURE  # not made use of
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
        """Multiply innovations with those of the same flights before them."""
        past = self._past[name][:, flights]
        products = past * white
        self._products[name] += np.nansum(products, axis=(1, 2))
        self._pairs[name] += np.isfinite(products).sum(axis=(1, 2))
        self._squares[name] += np.nansum(white**2), np.isfinite(white).sum()
        self._past[name][1:, flights] = past[:-1]
        self._past[name][0, flights] = white

    def nis(self) -> dict[str, MeanSquare]:
        """NIS over time, of the sensors that measured anything."""
        middle, found = 0.5 * (self._bins[1:] + self._bins[:-1]), {}
        for name, blocks in SENSOR_BLOCKS.items():
            some = self._counts[name] > 0
            if some.any():
                counts, dimension = self._counts[name][some], FREEDOMS[blocks[0]]
                mean = self._sums[name][some] / counts
                low, high = mean_band(dimension, np.minimum(counts, BAND_FLIGHTS))
                found[name] = MeanSquare(name, dimension, middle[some], mean, low, high)
        return found

    def whiteness(self) -> dict[str, Whiteness]:
        """Autocorrelation of the innovations, of the sensors that measured often enough."""
        found = {}
        for name in SENSOR_BLOCKS:
            pairs, (total, number) = self._pairs[name], self._squares[name]
            if pairs.min() > 0:
                correlation = self._products[name] / pairs * number / total
                found[name] = Whiteness(name, correlation, 1.96 / np.sqrt(pairs))
        return found
