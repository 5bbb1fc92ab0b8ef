"""Likelihood of a log, with many sets of numbers at once, and validation of a suite by it."""

import math
import os
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quad_gym.estimation.engine import Floats
from quad_gym.estimation.inputs import Tape
from quad_gym.logs.formats import Log
from quad_gym.logs.formats.clocks import running_motors
from quad_gym.logs.replaying.log_start import SPAN
from quad_gym.logs.replaying.player import Player
from quad_gym.logs.replaying.replay import replay
from quad_gym.logs.replaying.results import (
    Finding,
    Fit,
    Replay,
    Severity,
    by_sensor,
    fit_of,
    name_of,
)
from quad_gym.logs.replaying.verdict import in_one_line
from quad_gym.packing import blocks_of
from quad_gym.params.suites import SensorSuite
from quad_gym.records import FREEDOMS, WIDTH, aligned_zeros, parts_of, places_of_lanes
from quad_gym.records.inputs import SAME_TIME

# --------------------------------------------------------------------------------------------------
# Many filters on one log: a set of parameters for each lane, a block of lanes for each thread.
# --------------------------------------------------------------------------------------------------


def innovations_of_sets(player: Player, tape: Tape, suites: Sequence[SensorSuite]) -> Floats:
    """Run a tape with filters of suites that differ in numbers only.

    Returns:
        (m, blocks, REPORTED, sets) innovations of each update.
    """
    engines = [player.started(suite)._engine for suite in suites]
    first, tape = engines[0], tape.without_estimates()

    def run(k: int) -> Floats:
        chosen = [engines[min(i, len(engines) - 1)] for i in range(k, k + WIDTH)]
        parts = (
            _side_by_side([getattr(engine, name) for engine in chosen])
            for name in ("blocks", "params", "_ticks", "steps")
        )
        return first.run_block(tape, first.empty_slots(tape), *parts)[1]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(run, range(0, len(engines), WIDTH)))
    return np.concatenate(found, axis=-1)[..., : len(engines)]


def _side_by_side(blocks: Sequence[Any]) -> Any:
    """Return one block with a lane of each of WIDTH blocks."""
    found = aligned_zeros(1, blocks[0].dtype)
    parts, places = parts_of(found)[0], places_of_lanes(found.dtype)
    for lane, block in enumerate(blocks):
        parts[places[:, lane]] = parts_of(block)[0, places[:, 0]]
    return found


# --------------------------------------------------------------------------------------------------
# Likelihood of a log: innovations of filters with many sets of numbers at once.
#
# The innovation of each measurement is Gaussian with the covariance that the filter predicts, if
# its numbers are correct. Real measurements have heavier tails; the loss of a measurement is
# therefore
#
#     (nu + d) / 2 log(1 + NIS / (nu - 2)) + sum log sigma_i,
#
# Student's t with the predicted covariance, d numbers and nu degrees of freedom: 5 at first, then
# as the innovations of each sensor have them (`tails`), up to 100, where it is nearly Gaussian.
# Correlations between sensors, and between axes, are left out: a composite likelihood, whose
# derivative is zero on average at the right numbers, too.
#
# A filter with all measurements predicts over tenths of a second only, where errors of a receiver
# that are smooth in time look like motion, and are best explained by noise of the IMU. The loss
# therefore has a second part with equal weight: of a filter that uses a measurement of each sensor
# every half second, so that its predictions reach further. Sensors whose innovations are white have
# no such errors, and all their measurements count fully.
#
# Sources: F. C. Schweppe, IEEE Trans. Information Theory 11(1), 1965, for prediction errors; K. L.
# Lange, R. J. A. Little and J. M. G. Taylor, J. American Statistical Association 84(408), 1989, for
# Student's t.
# --------------------------------------------------------------------------------------------------

NU = (5.0, 8.0, 15.0, 100.0)
"""Degrees of freedom of Student's t; of 5, a tenth of its weight lies beyond two scales."""
SETTLING = 5.0  #: time after the start whose measurements do not count [s]
SPACING = 0.5
"""Time between the measurements of a sensor in the second, thinned log [s]: errors that are
correlated over shorter times count less in it, and noise of the IMU more."""
PART = 0.1  #: length of the parts of a log whose losses are told apart [s]
_MIN_COUNT = 50
_TOGETHER = 64  #: suites, as their innovations take memory
_WINDOW = 0.5  #: [s]
_VIBRATES = 3.0  #: ratio of the vibration in flight and in the quietest second [-]
_TURNS, _TILTS = 0.05, 0.5
"""Change of mean rates [rad/s] and of mean specific force [m/s^2] that no vehicle at rest shows."""
_CALM = 5.0  #: longest time without vibration and motion in flight [s]


def in_flight(log: Log, times: Floats) -> Any:
    """Return True for the times at which the vehicle flies.

    Its accelerometer vibrates more than in the quietest second, or it turns or tilts against its
    attitude then; and the motors run, if the log has their commands. Calm times in between count.
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

    time, dt = log.imu.time, float(np.median(np.diff(log.imu.time)))
    gyro, accel = log.imu.values["gyro"], log.imu.values["accel"]
    size, count, second = (
        np.linalg.norm(accel, axis=1),
        max(3, round(_WINDOW / dt)),
        round(1.0 / dt),
    )
    squares = uniform_filter1d((size - uniform_filter1d(size, count)) ** 2, count)
    spread = np.sqrt(np.maximum(squares, 0.0))
    quiet = uniform_filter1d(spread, max(second, 1), mode="nearest")
    k = int(np.argmin(quiet))
    flies = spread > _VIBRATES * quiet[k]
    for values, most in ((gyro, _TURNS), (accel, _TILTS)):
        means = uniform_filter1d(values, max(second, 1), axis=0, mode="nearest")
        flies |= np.linalg.norm(means - means[k], axis=1) > most
    calm = max(1, round(_CALM / dt))
    flies = minimum_filter1d(maximum_filter1d(flies, calm), calm)
    found = np.interp(times, time, flies.astype(float)) > 0.5
    if (running := running_motors(log)) is not None:
        assert log.motors is not None
        held = np.clip(np.searchsorted(log.motors.time, times, side="right") - 1, 0, None)
        found &= running[held]
    return found


def thinned(log: Log) -> Log:
    """Return a log in which the measurements of a sensor are at least `SPACING` apart.

    It has all measurements of the first second, which show how the vehicle moves at the start.
    """
    changes: dict[str, Any] = {}
    for name, stream in log.streams.items():
        if name == "imu":
            continue
        kept, last, first = [], -math.inf, stream.time.min()
        for k in np.argsort(stream.time, kind="stable"):
            if stream.time[k] < first + SPAN or stream.time[k] >= last + SPACING - SAME_TIME:
                kept.append(k)
                last = stream.time[k]
        changes[name] = stream.rows(np.sort(kept))
    return replace(log, **changes)


def loss_of(nis: Floats, sigma: Floats, nu: float = NU[0]) -> Floats:
    """Return the losses (n,) of measurements with NIS (n,) and predicted sigmas (n, d)."""
    d = sigma.shape[1]
    return np.asarray(0.5 * (nu + d) * np.log1p(nis / (nu - 2.0)) + np.log(sigma).sum(axis=1))


def tails(nis: Floats, d: int) -> float:
    """Return the degrees of freedom of Student's t that describe NIS (n,) of d numbers best."""
    from scipy.special import gammaln

    scales = np.exp(np.linspace(-3.0, 3.0, 61))[:, np.newaxis] * float(np.median(nis)) / d
    losses = []
    for nu in NU:
        terms = 0.5 * (nu + d) * np.log1p(nis / (scales * (nu - 2.0))) + 0.5 * d * np.log(scales)
        constant = gammaln(0.5 * nu) - gammaln(0.5 * (nu + d)) + 0.5 * d * math.log(nu - 2.0)
        losses.append(terms.mean(axis=1).min() + constant)
    return NU[int(np.argmin(losses))]


class Likelihood:
    """Losses of the innovations of a log, and of the same log with fewer measurements.

    Measurements are processed in the order of their time stamps. They belong to parts of the log by
    their time of arrival, which neither delays nor numbers of the suite change.

    Args:
        log: The log.
        suite: Its suite, whose delays and mounting correct the log.
        start: Keywords of `initialize`.
        nu: Degrees of freedom of Student's t by sensor; 5 for others.
        white: Sensors whose innovations are white.
        margin: Time before the end of the log whose measurements do not count [s], so that losses
            with different delays contain the same measurements.
    """

    def __init__(
        self,
        log: Log,
        suite: SensorSuite,
        start: dict[str, Any],
        nu: Mapping[str, float],
        white: Collection[str],
        margin: float,
    ) -> None:
        first, last = log.streams.get("gnss", log.imu).received[0], log.imu.time[-1]
        span = (first + SETTLING, last - margin)
        right = log.corrected(suite)
        self._logs = [_LogLosses(each, suite, start, nu, span) for each in (right, thinned(right))]
        counts = [int(each.counts.sum()) for each in self._logs]
        if counts[0] < _MIN_COUNT:
            raise ValueError(
                f"a calibration must have at least {_MIN_COUNT} measurements in flight, from "
                f"{SETTLING:g} s after the start on, got {counts[0]}: use a longer part of the log "
                "(share=, --share)"
            )
        names = {name_of(block): block for block in blocks_of(suite)}
        colored = [block for name, block in names.items() if name not in white]
        many, few = (each.counted(colored) for each in self._logs)
        share = few / max(many, 1)
        self._logs[0].weights = {name: 1.0 if name in white else share for name in names}

    def losses(self, suites: Sequence[SensorSuite]) -> Floats:
        """Return the losses of parts in time, (parts, suites), of the log and the thinned one.

        The suites have the same delays and mounting as the suite of the likelihood.
        """
        whole, thin = (each.losses(suites) for each in self._logs)
        return whole + thin


class _LogLosses:
    """Losses of the innovations of one log, of measurements that arrive within a span of time."""

    def __init__(
        self,
        log: Log,
        suite: SensorSuite,
        start: dict[str, Any],
        nu: Mapping[str, float],
        span: tuple[float, float],
    ) -> None:
        self.suite, self.nu = suite, nu
        self.weights: Mapping[str, float] = {}  #: of sensors; 1 for others
        player = Player(log, suite, "ukf", start, False, None)
        player.write_tape()
        if not player.filter.heading_known:
            raise ValueError(
                "a calibration must know the heading at the start: give start= a heading or course "
                "(--heading, --course), or use a suite and log with a magnetometer or baseline"
            )
        self._player, self._tape = player, player.writer.tape()
        received = np.array(player.stamps).reshape(-1, 2)[:, 1]
        self.counts = in_flight(log, received) & (received > span[0]) & (received <= span[1])
        self._parts = ((received[self.counts] - span[0]) // PART).astype(int)
        self._count = max(int((span[1] - span[0]) // PART) + 1, 1)
        self._valid = self._tape.valid

    def counted(self, blocks: Sequence[int]) -> int:
        """Return the number of measurements that count, of blocks of innovations."""
        return int((self.counts & self._valid[:, blocks].any(axis=1)).sum())

    def losses(self, suites: Sequence[SensorSuite]) -> Floats:
        """Return the losses of the parts, (parts, suites)."""
        some = [suites[k : k + _TOGETHER] for k in range(0, len(suites), _TOGETHER)]
        return np.concatenate([self._losses(few) for few in some], axis=1)

    def _losses(self, suites: Sequence[SensorSuite]) -> Floats:
        found = innovations_of_sets(self._player, self._tape, suites)
        losses = np.zeros((len(found), len(suites)))
        for row, block in enumerate(blocks_of(self.suite)):
            have, d = self._valid[:, block], FREEDOMS[block]
            nis, sigma = found[have, row, 6], found[have, row, 3 : 3 + d]
            some = loss_of(nis, sigma, self.nu.get(name_of(block), NU[0]))
            losses[have] += self.weights.get(name_of(block), 1.0) * some
        # a filter that failed is as unlikely as one that is wrong by far
        counted = np.nan_to_num(losses[self.counts], nan=1e3, posinf=1e3)
        total = np.zeros((self._count, len(suites)))
        np.add.at(total, self._parts, counted)
        return total


# --------------------------------------------------------------------------------------------------
# Validation of a suite with a part of a log that was not used to find its numbers.
# --------------------------------------------------------------------------------------------------

_PERIOD, _GAP = 5, 1
"""Fixes are left out for a second in every five [s], in five replays that leave out each second."""


@dataclass(frozen=True, eq=False)
class Validation:
    """Consistency of a filter on a part of a log."""

    sensors: dict[str, Fit]
    held_out_error: tuple[float, float] | None
    """root mean square difference of the prediction from the first fix after gaps: horizontal, and
    vertical [m]; None: no fixes"""
    held_out_nis: float | None  #: mean NIS of these fixes over three
    held_out_ratios: tuple[float, float, float] | None
    """mean squared difference over its variance: east, north, up; 1 for a consistent filter"""
    diverged: float  #: share of the samples at which the filter counts as diverged
    findings: tuple[Finding, ...]  #: of the replay
    replay: Replay  #: of several logs, of the first one

    @property
    def problems(self) -> tuple[str, ...]:
        """Sentences with which the suite does not describe the log."""
        return tuple(str(f) for f in self.findings if f.severity == Severity.LOST)

    @property
    def verdict(self) -> str:
        """The verdict in a line."""
        return in_one_line(self.findings, self.sensors)


def validate(
    log: Log, suite: SensorSuite, start: Mapping[str, Any] | None, split: float
) -> Validation:
    """Replay a log, and compare the part after a time with the predictions of the filter."""
    result = replay(log, sensors=suite, start=start, reported_noise=False)
    sensors = {}
    for name, m in by_sensor(result.measured).items():
        if fit := fit_of(m, m.time > split):
            sensors[name] = fit
    diverged = float(np.mean(result.diverged[result.time > split]))
    held_out = _held_out(left_out(log, suite, start, split))
    return Validation(sensors, *held_out, diverged, result.findings, result)


def pooled(validations: Mapping[str, Validation]) -> Validation:
    """Return one validation of several logs, by name: means over measurements and over logs."""
    if len(validations) == 1:
        return next(iter(validations.values()))
    each = list(validations.values())
    sensors = {}
    for name in dict.fromkeys(name for v in each for name in v.sensors):
        fits = [v.sensors[name] for v in each if name in v.sensors]
        counts = [fit.measurements for fit in fits]
        mean, median, rejected = (
            float(np.average([getattr(fit, field) for fit in fits], weights=counts))
            for field in ("mean_nis", "median_nis", "rejected")
        )
        worst = max((fit.correlation for fit in fits), key=abs)
        sensors[name] = Fit(sum(counts), fits[0].freedoms, mean, median, rejected, worst)
    held = [v for v in each if v.held_out_error is not None]
    errors = np.array([v.held_out_error for v in held])
    level, up = np.sqrt((errors**2).mean(axis=0)).tolist() if held else (0.0, 0.0)
    each_ratios = np.array([v.held_out_ratios for v in held], float)
    ratios = each_ratios.mean(axis=0).tolist() if held else None
    findings = [
        replace(f, text=f"{f.text} ({name})") for name, v in validations.items() for f in v.findings
    ]
    findings.sort(key=lambda finding: -finding.severity)
    return Validation(
        sensors,
        (level, up) if held else None,
        float(np.mean([v.held_out_nis for v in held])) if held else None,
        None if ratios is None else tuple(ratios),
        float(np.mean([v.diverged for v in each])),
        tuple(findings),
        each[0].replay,
    )


class LeftOut(NamedTuple):
    """First fixes after a second without, predicted by the filter."""

    received: Floats  #: times of arrival, (n,) [s]
    error: Floats  #: measurement minus prediction, (n, 3) in I [m]
    sigma: Floats  #: its predicted standard deviations, (n, 3) [m]
    nis: Floats  #: (n,)


def left_out(
    log: Log, suite: SensorSuite, start: Mapping[str, Any] | None, split: float = -math.inf
) -> LeftOut | None:
    """Return the first fixes after each second without, later than a time; None: no fixes."""
    gnss = log.gnss
    if gnss is None or suite.gnss is None or len(gnss) < 3:
        return None
    parts = []
    period = float(np.median(np.diff(gnss.time)))
    begin = max(split, float(gnss.time[0]) + SETTLING)  # the start needs all fixes
    for first in range(0, _PERIOD, _GAP):
        since = gnss.time - begin - first
        kept = np.flatnonzero((since < 0.0) | (since % _PERIOD >= _GAP))
        skipped = np.diff(kept, prepend=kept[:1]) > 1
        gaps = np.diff(gnss.time[kept], prepend=gnss.time[kept[:1]])
        skipped &= gaps <= _GAP + 2.0 * period  # longer ones are outages of the log
        some = replace(log, gnss=gnss.rows(kept))
        result = replay(some, sensors=suite, start=start, reported_noise=False)
        fixes = result.measured.get("gnss_position")
        if fixes is None:
            return None
        after = np.isin(fixes.received, gnss.received[kept[skipped]]) & np.isfinite(fixes.nis)
        columns = fixes.received, fixes.innovation, fixes.sigma, fixes.nis
        parts.append([column[after] for column in columns])
    found = LeftOut(*(np.concatenate(some) for some in zip(*parts, strict=True)))
    return found if len(found.nis) else None


def _held_out(found: LeftOut | None) -> tuple[Any, Any, Any]:
    """Return errors, mean NIS and ratios of fixes that were left out."""
    if found is None:
        return None, None, None
    squares = (found.error**2).mean(axis=0)
    level, up = math.sqrt(squares[0] + squares[1]), math.sqrt(squares[2])
    ratios = tuple(((found.error / found.sigma) ** 2).mean(axis=0).tolist())
    return (level, up), float(found.nis.mean() / 3.0), ratios
