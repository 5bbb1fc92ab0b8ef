"""Calibration: the numbers of a sensor suite from the log of a flight.

The search maximizes the likelihood of the innovations (`likelihood.py`) in the first part of the
log, with priors about the numbers of a suite (`numbers.py`): delays of time stamps one after the
other on grids, all others by quasi-Newton steps, whose derivatives are differences between filters
that run side by side.

The likelihood alone makes noise too small where errors are correlated in time, such as errors of a
magnetometer near motors: innovations are then as small as predicted, but not white, and the filter
counts the same error many times. Noise of such sensors becomes larger by sqrt(tau), at most four
times, where tau is the integrated autocorrelation time of the innovations in samples, before the
other numbers are fitted again. The rest of the log validates the result.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quad_gym.estimation.engine import Floats
from quad_gym.estimation.likelihood import SETTLING, Likelihood, in_flight, tails
from quad_gym.estimation.logs import Log
from quad_gym.estimation.numbers import Number, has_baselines, numbers_in
from quad_gym.estimation.replaying import origin_of, replay
from quad_gym.estimation.tables import read_log
from quad_gym.estimation.validation import Validation, validate
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.suites import sensor_suite

_STEP = 0.1  #: step of numerical derivatives, in standard deviations of the prior
_LARGEST, _LEAST = 3.0, -0.3
"""Bounds of a coordinate; and of the logarithm of a standard deviation over the suite's, because a
sensor in flight is hardly better than at rest."""
_SILENT = 0.8
"""Ratio of standard deviations after and before above which a log does not determine a number."""
_COARSE_NOISE = ("imu.accel_noise_density", "imu.gyro_noise_density")
"""Noise that the search begins with twice: as large as the samples admit, and at its prior."""
_FEW_STEPS, _STEPS = 8, 25  #: steps of the search from each beginning, and after
_CLUSTER, _CLUSTERS = 5.0, 20
"""Length of independent parts of a log [s], shorter in short logs; their least number."""
_FEWEST_TAILS = 30  #: number of innovations that determines their tails
_COARSE, _FINE = np.arange(-1.0, 1.01, 0.1), np.arange(-0.1, 0.11, 0.05)
_DELAY_SPREAD = 0.3  #: standard deviation of the prior of a delay [s]
_LEAST_GAIN = 3.0
"""Drop of the log likelihood, two steps of a grid from its maximum, that determines a delay."""
_IRON_TAU = 30.0
"""Prior correlation time of hard iron that is constant in the suite [s]: currents of motors change
in flight."""
_DRIFT, _DRIFT_TAU = 3.0, 5.0
"""Prior drift of GNSS in a suite without, in standard deviations of its noise, and its correlation
time [s]: receivers filter their positions."""
_WHITE = {
    "gnss.position_sigma_I[0, 1]": ("gnss_position", slice(0, 2), 1.5),
    "gnss.position_sigma_I[2]": ("gnss_position", slice(2, 3), 1.5),
    "gnss.velocity_sigma": ("gnss_velocity", slice(3), 2.0),
    "magnetometer.noise_sigma": ("magnetometer", slice(3), 2.0),
}
"""White noise that is inflated where innovations are correlated: their sensor, its axes, and the
largest factor, which is smaller where the filter estimates a correlated error of the sensor."""


class Calibrated(NamedTuple):
    """A number that a calibration has found."""

    number: Number
    prior: float
    value: float
    low: float  #: lower end of its 95 % interval
    high: float
    determined: bool  #: false: the log does not determine it, so that it keeps its prior value


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`."""

    suite: SensorSuite
    """the suite with the numbers that were found"""
    prior: SensorSuite
    """the suite before"""
    numbers: tuple[Calibrated, ...]
    delays: Mapping[str, float]
    """times by which the stamps of sensors are late [s], also in `suite.log_delays`"""
    before: Validation
    """the suite before, on the validation part of the log"""
    after: Validation
    """the suite with the numbers that were found, on this part"""
    split: float
    """time at which this part begins [s]"""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on numbers that the log does not determine."""
        return tuple(
            f"the log does not determine {found.number.name}: it keeps {found.value:.3g}"
            for found in self.numbers
            if not found.determined
        )


def calibrate(
    log: Any,
    *,
    sensors: SensorSuite | str,
    start: Mapping[str, Any] | None = None,
    share: float = 0.5,
    delays: bool = True,
    body: str = "flu",
    progress: Callable[[str], None] | None = None,
) -> Calibration:
    """Find the numbers of a sensor suite from the log of a flight.

    Args:
        log: A table or a file, see `read_log`.
        sensors: The suite to begin with, or its name: its sensors, mounting and filter stay, and
            its numbers are the centers of the priors.
        start: Keywords of `initialize`, such as `{"heading": 0.5}`.
        share: Share of the log, from its beginning, that the search uses; the rest is for
            validation.
        delays: True: find delays of time stamps, too; False: keep the suite's.
        body: Axes of a table, see `read_log`.
        progress: Called with a sentence before each step.

    Raises:
        ValueError: If the log or an argument is invalid, or the heading at the start is unknown.
    """
    suite = sensor_suite(sensors) if isinstance(sensors, str) else sensors
    check.instance("sensors", suite, SensorSuite)
    check.number("share", share, least=0.05, most=0.95)
    check.flag("delays", delays)
    whole = read_log(log, body=body)
    prior = _prior_of(origin_of(whole, suite), whole)
    time = whole.imu.time
    split = float(time[0] + share * (time[-1] - time[0]))
    search = _Search(whole.until(split), prior, dict(start or {}), progress or (lambda _: None))
    if delays:
        search.find_delays(coarse=True)
    search.fit(first=True)
    if delays:
        search.find_delays(coarse=False)
    search.adapt()
    search.fit()
    search.progress("Intervals")
    found = search.intervals()
    search.progress("Validation")
    new = _like_the_log(search.suite(), whole, search.delays)
    before, after = (validate(whole, s, start, split) for s in (prior, new))
    return Calibration(new, prior, found, dict(search.delays), before, after, split)


def _prior_of(suite: SensorSuite, log: Log) -> SensorSuite:
    """Return the suite with errors that change slowly, and with the magnetic field of the log."""
    imu, gnss, compass, stream = suite.imu, suite.gnss, suite.magnetometer, log.magnetometer
    root = math.sqrt(imu.dt)  # vibration and density are one white noise in a log
    imu = imu.replace(
        accel_noise_density=imu.accel_noise * root,
        gyro_noise_density=imu.gyro_noise * root,
        accel_vibration=0.0,
        gyro_vibration=0.0,
    )
    if gnss is not None and not gnss.drifts:
        drift = tuple(_DRIFT * sigma for sigma in gnss.position_sigma_I)
        gnss = gnss.replace(drift_sigma_I=drift, drift_tau=_DRIFT_TAU)
    if gnss is not None and not has_baselines(log):
        gnss = gnss.replace(secondary_antenna_B=None)
    suite = suite.replace(imu=imu, gnss=gnss)
    if compass is None or stream is None:
        return suite
    field = stream.values["magnetometer"]
    accel = np.column_stack(
        [np.interp(stream.time, log.imu.time, axis) for axis in log.imu.values["accel"].T]
    )
    sizes = np.linalg.norm(field, axis=1)
    up = (field * accel).sum(axis=1) / np.linalg.norm(accel, axis=1)
    compass = compass.replace(
        strength=float(sizes.mean()),
        inclination=-math.asin(float(np.clip(up.mean() / sizes.mean(), -0.99, 0.99))),
        hard_iron_tau=min(compass.hard_iron_tau, _IRON_TAU),
    )
    return suite.replace(magnetometer=compass)


def _like_the_log(suite: SensorSuite, log: Log, delays: Mapping[str, float]) -> SensorSuite:
    """Return the suite with rates and latencies of the log, as far as flights can have them."""
    rate, changes = suite.imu.rate, {}
    for name, stream in log.streams.items():
        params = getattr(suite, name, None)
        if name == "imu" or params is None or len(stream) < 3:
            continue
        measured = 1.0 / float(np.median(np.diff(stream.time)))
        ticks = max(1, round(rate / measured))
        late = float(np.median(stream.received - stream.time)) + delays.get(name, 0.0)
        latency = min(max(0.0, round(late * rate) / rate), 2.0 * ticks / rate)
        changes[name] = params.replace(rate=rate / ticks, latency=latency)
    log_delays = suite.log_delays.replace(**delays)
    return suite.replace(**changes, log_delays=log_delays)


class _Search:
    """The search for the numbers of a suite."""

    def __init__(
        self,
        log: Log,
        prior: SensorSuite,
        start: dict[str, Any],
        progress: Callable[[str], None],
    ) -> None:
        self.log, self.prior, self.start, self.progress = log, prior, start, progress
        self.nu: dict[str, float] = {}
        self.measured = {name for name in log.streams if getattr(prior, name, None) is not None}
        self.numbers = numbers_in(prior, log)
        self.values = np.array([number.of(prior) for number in self.numbers])
        self.low = np.array([_lowest(number) for number in self.numbers])
        own = vars(prior.log_delays)
        self.delays = {name: own[name] for name in own if name in self.measured}
        self.x = np.clip(self._first(), self.low, _LARGEST)

    def _first(self) -> Floats:
        """Return where the search begins: with noise as wide as the log may need."""
        x = np.zeros(len(self.numbers))
        for k, (number, value) in enumerate(zip(self.numbers, self.values, strict=True)):
            wide = {"gnss.velocity_sigma": 4.0, "magnetometer.hard_iron_sigma": 3.0}
            if number.positive:
                x[k] = number.coordinate(value, wide.get(number.name, 1.0) * value)
            if number.name in _COARSE_NOISE:  # of the largest that the samples admit
                x[k] = max(0.0, number.coordinate(value, self._roughness(number)))
        return x

    def _roughness(self, number: Number) -> float:
        """Return the noise density of the IMU if its samples changed by noise only."""
        values = self.log.imu.values[number.field.split("_")[0]]
        dt = float(np.median(np.diff(self.log.imu.time)))
        return float(np.diff(values, axis=0).std()) * math.sqrt(0.5 * dt)

    def suite(self, x: Floats | None = None, gate: bool = True) -> SensorSuite:
        """Return the suite at coordinates."""
        found, x = self.prior, self.x if x is None else x
        if not gate:  # whose decisions are no smooth function of the numbers
            found = found.replace(estimator=found.estimator.replace(false_alarm_probability=0.0))
        for number, value, place in zip(self.numbers, self.values, x, strict=True):
            found = number.put(found, number.value(value, float(place)))
        return found

    def find_delays(self, coarse: bool) -> None:
        """Find the delay of each sensor, with the others as they are."""
        for name in self.delays:
            self.progress(f"Delay of {name}: {1e3 * self.delays[name]:.0f} ms so far")
            if coarse:
                self._scan(name, _COARSE)
            self._scan(name, _FINE)

    def _scan(self, name: str, steps: Floats) -> None:
        """Find the delay of a sensor by a parabola through losses on a grid about the present one.

        Delays have a normal prior about zero. A delay that hardly changes the loss stays.
        """
        delays = self.delays[name] + steps
        margin, suites = max(0.0, -float(delays.min())), [self.suite(gate=False)]
        total = np.empty(len(delays))
        for k, delay in enumerate(delays):
            log = self.log.without_delays(self.delays | {name: float(delay)})
            found = Likelihood(log, self.prior, self.start, fewer=False, margin=margin)
            total[k] = found.losses(suites).sum()
        loss = total + 0.5 * (delays / _DELAY_SPREAD) ** 2
        k = int(np.clip(np.argmin(loss), 2, len(loss) - 3))
        near = slice(k - 2, k + 3)
        bend, slope, _ = np.polyfit(delays[near] - delays[k], loss[near], 2)
        reach = float(steps[1] - steps[0])
        if 4.0 * bend * reach**2 < _LEAST_GAIN:
            return
        step = float(np.clip(-0.5 * slope / bend, -2.0 * reach, 2.0 * reach))
        self.delays[name] = float(np.clip(delays[k] + step, -2.0, 2.0))

    def fit(self, first: bool = False) -> None:
        """Find the numbers with the delays as they are.

        Args:
            first: True: the likelihood has several maxima, as noise of the IMU and drift of GNSS
                both explain large innovations; begin with much and with little of the first.
        """
        self.progress(f"Search for {len(self.numbers)} numbers")
        log = self.log.without_delays(self.delays)
        self._current = Likelihood(log, self.prior, self.start, self.nu)
        if first:
            little = np.where([n.name in _COARSE_NOISE for n in self.numbers], 0.0, self.x)
            tried = [self._minimize(x, _FEW_STEPS) for x in (self.x, little)]
            self.x = min(tried, key=lambda found: float(found.fun)).x
        self.x = self._minimize(self.x, _STEPS).x

    def _minimize(self, x: Floats, steps: int) -> Any:
        """Return the result of a quasi-Newton search from coordinates."""
        from scipy.optimize import minimize

        return minimize(
            self._loss,
            np.clip(x, self.low, _LARGEST),
            jac=True,
            method="L-BFGS-B",
            bounds=[(low, _LARGEST) for low in self.low],
            options={"maxiter": steps, "ftol": 1e-5},
        )

    def _loss(self, x: Floats) -> tuple[float, Floats]:
        """Return the loss per thousand, with the prior, and its derivative."""
        points = [x, *(x + s * _STEP * e for e in np.eye(len(x)) for s in (1.0, -1.0))]
        losses = self._current.losses([self.suite(p, gate=False) for p in points])
        total = losses.sum(axis=0) + 0.5 * np.array([p @ p for p in points])
        return total[0] / 1e3, (total[1::2] - total[2::2]) / (2.0 * _STEP * 1e3)

    def adapt(self) -> None:
        """Find the tails of the innovations, and widen noise where these are correlated in time."""
        log = self.log.without_delays(self.delays)
        measured = replay(
            log, sensors=self.suite(), start=self.start, reported_noise=False
        ).measured
        scaled = {}
        for name, m in measured.items():
            counts = in_flight(log, m.time) & (m.time > m.time[0] + SETTLING) & np.isfinite(m.nis)
            scaled[name] = (m.innovation / m.sigma)[counts]
            if len(scaled[name]) > _FEWEST_TAILS:
                self.nu[name] = tails(m.nis[counts], scaled[name].shape[1])
        for k, number in enumerate(self.numbers):
            sensor, axes, most = _WHITE.get(number.name, ("", slice(0), 1.0))
            if sensor not in scaled:
                continue
            tau = max(correlation_time(column) for column in scaled[sensor][:, axes].T)
            factor = min(math.sqrt(tau), most)
            if factor == 1.0:
                continue
            value = factor * number.value(self.values[k], float(self.x[k]))
            wide = number.coordinate(self.values[k], value)
            self.low[k] = min(max(self.low[k], wide), _LARGEST - 0.1)

    def intervals(self) -> tuple[Calibrated, ...]:
        """Return the numbers with 95 % intervals.

        The covariance is H^-1 J H^-1 (Godambe), with the curvature H from differences of
        derivatives and J the sum of squares of the derivatives over parts of the log.
        """
        n = len(self.x)
        axes, (row, column) = _STEP * np.eye(n), np.triu_indices(n, 1)
        points = [self.x, *(self.x + s * e for e in axes for s in (1.0, -1.0))]
        points += [self.x + axes[i] + axes[j] for i, j in zip(row, column, strict=True)]
        losses = self._current.losses([self.suite(p, gate=False) for p in points])
        total = losses.sum(axis=0)
        ahead, back, both = total[1 : 2 * n : 2], total[2 : 2 * n + 1 : 2], total[2 * n + 1 :]
        H = np.diag(ahead + back - 2.0 * total[0])
        H[row, column] = H[column, row] = both - ahead[row] - ahead[column] + total[0]
        H /= _STEP**2
        slopes = (losses[:, 1 : 2 * n : 2] - losses[:, 2 : 2 * n + 1 : 2]) / (2.0 * _STEP)
        times = self._current.times
        length = min(_CLUSTER, (times.max() - times.min()) / _CLUSTERS)
        parts = ((times - times.min()) // length).astype(int)
        sums = np.array([slopes[parts == part].sum(axis=0) for part in np.unique(parts)])
        J = sums.T @ sums
        values, vectors = np.linalg.eigh(H)
        information = (vectors * np.maximum(values, 0.0)) @ vectors.T + np.eye(n)
        root = np.linalg.solve(information, np.linalg.cholesky(J + np.eye(n)))
        sigmas = np.minimum(np.sqrt((root**2).sum(axis=1)), 1.0)
        found = []
        for k, (number, prior) in enumerate(zip(self.numbers, self.values, strict=True)):
            value, low, high = (
                number.value(prior, float(self.x[k] + s * sigmas[k])) for s in (0.0, -1.96, 1.96)
            )
            determined = bool(sigmas[k] < _SILENT)
            found.append(Calibrated(number, prior, value, low, high, determined))
        return tuple(found)


def _lowest(number: Number) -> float:
    """Return the lower bound of a coordinate."""
    standard_deviation = "sigma" in number.field or "density" in number.field
    standard_deviation &= number.field != "drift_sigma_I"
    return _LEAST / number.spread if standard_deviation else -_LARGEST


def correlation_time(values: Floats) -> float:
    """Return the integrated autocorrelation time of numbers, in samples; 1 if they are white.

    The sum ends with the first correlation that white noise would also have, to two standard
    deviations.
    """
    centered, least = values - values.mean(), max(0.05, 2.0 / math.sqrt(len(values)))
    variance, tau = float((centered**2).mean()), 1.0
    for lag in range(1, len(values) // 4):
        rho = float((centered[:-lag] * centered[lag:]).mean()) / variance
        if rho < least:
            break
        tau += 2.0 * rho
    return tau
