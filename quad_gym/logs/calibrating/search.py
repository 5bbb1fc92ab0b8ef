"""Search for the numbers of a sensor suite."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from quad_gym.estimation.engine import Floats
from quad_gym.logs.calibrating.likelihood import (
    PART,
    SETTLING,
    Likelihood,
    in_flight,
    left_out,
    loss_of,
    tails,
)
from quad_gym.logs.formats import Log
from quad_gym.logs.formats.clocks import naming
from quad_gym.logs.replaying.replay import replay
from quad_gym.logs.replaying.results import correlation_time
from quad_gym.params.sensor_table import AID_PARAMS, READINGS
from quad_gym.params.suites import LogDelays, SensorSuite

# --------------------------------------------------------------------------------------------------
# Numbers of a sensor suite that a calibration finds, with their priors.
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Number:
    """A number of a suite, as a coordinate x of the search.

    A positive number is its prior value times exp(spread x), another one its prior value plus
    spread x, where x has a standard normal prior.
    """

    sensor: str
    """part of the suite, such as "imu"; empty: the suite itself"""
    field: str  #: field of that part
    spread: float  #: standard deviation of the prior: of the logarithm, or of the number
    axes: tuple[int, ...] = ()  #: elements of a field of several numbers; they change together
    positive: bool = True  #: False: the number may have either sign
    unit: str = "-"
    step: float = 0.1  #: step of numerical derivatives, in coordinates
    limit: float = math.inf  #: largest absolute value

    @property
    def of_log(self) -> bool:
        """True if the number changes the log before the filter: a delay, or the mounting."""
        return self.field in (_MOUNTING, _COMPASS) or self.sensor == _DELAYS

    def ends(self, prior: float) -> tuple[float, float]:
        """Return bounds of the coordinate; at rest, a sensor is at most about as noisy."""
        if self.positive:
            bounded = self.noise and self.field != "drift_sigma_I"
            high = self.coordinate(prior, self.limit) if self.limit < math.inf else MAX_SPREAD
            low = _MIN_SPREAD / self.spread if bounded else -MAX_SPREAD
            return low, max(min(high, MAX_SPREAD), 0.0)
        low, high = (self.coordinate(prior, end) for end in (-self.limit, self.limit))
        return max(-MAX_SPREAD, low), min(MAX_SPREAD, high)

    @property
    def noise(self) -> bool:
        """True for a standard deviation."""
        return "sigma" in self.field or "density" in self.field

    def step_for(self, period: float) -> float:
        """Return the step of derivatives with a log whose IMU has a period [s].

        The likelihood of a delay has a kink at each sample.
        """
        return max(self.step, period / self.spread) if self.sensor == _DELAYS else self.step

    @property
    def name(self) -> str:
        """Name, such as "gnss.position_sigma_I[2]"."""
        place = f"[{', '.join(map(str, self.axes))}]" if self.axes else ""
        return f"{self.sensor}.{self.field}{place}".lstrip(".")

    def of(self, suite: SensorSuite) -> float:
        """Return the number in a suite."""
        value = getattr(self.part(suite), self.field)
        return float(value[self.axes[0]] if self.axes else value)

    def value(self, prior: float, x: float) -> float:
        """Return the number at a coordinate."""
        return prior * math.exp(self.spread * x) if self.positive else prior + self.spread * x

    def coordinate(self, prior: float, value: float) -> float:
        """Return the coordinate of a number."""
        return (math.log(value / prior) if self.positive else value - prior) / self.spread

    def put(self, suite: SensorSuite, value: float) -> SensorSuite:
        """Return a suite with another number."""
        part, new = self.part(suite), cast("Any", value)
        if self.axes:
            values = list(getattr(part, self.field))
            for axis in self.axes:
                values[axis] = value
            new = tuple(values)
        changes = {self.field: new}
        if self.field == _LEVER and part.secondary_antenna_B is not None:  # with the same baseline
            moves = np.subtract(new, part.primary_antenna_B)
            changes["secondary_antenna_B"] = tuple((part.secondary_antenna_B + moves).tolist())
        part = part.replace(**changes)
        return suite.replace(**{self.sensor: part}) if self.sensor else part

    def part(self, suite: SensorSuite) -> Any:
        """Return the part of a suite that has the number."""
        return getattr(suite, self.sensor) if self.sensor else suite


_LEVEL, _UP = (0, 1), (2,)
_LEVER, _PRECISE = "primary_antenna_B", 0.1  #: [m]
_WIDE, _NARROW = 1.5, 0.7  #: logarithms: factors of 4.5 and 2
_DELAYS, _MOUNTING, _COMPASS = "log_delays", "log_rotation", "log_compass_rotation"
MAX_SPREAD, _MIN_SPREAD = 3.0, -0.3
"""Bounds of a coordinate; and of the logarithm of a standard deviation over the suite's."""

# fmt: off
_OF_AIDS = {
    "barometer": (Number(sensor="barometer", field="bias_sigma", spread=_WIDE, unit="m"),),
    "magnetometer": (
        Number(sensor="magnetometer", field="hard_iron_sigma", spread=_WIDE, unit="T"),
        Number(sensor="magnetometer", field="hard_iron_tau", spread=_NARROW, unit="s"),
        Number(sensor="magnetometer", field="declination", spread=0.3, positive=False, unit="rad"),
        Number(sensor="magnetometer", field="inclination", spread=0.1, positive=False, unit="rad",
               limit=1.5),
        Number(sensor="magnetometer", field="strength", spread=0.2, unit="T"),
    ),
}  #: further numbers of aiding sensors than their noise
NUMBERS = (
    *(
        Number(
            sensor=_DELAYS, field=name, spread=0.3, positive=False, unit="s", step=1 / 30, limit=1.8
        )
        for name in vars(LogDelays())
    ),
    *(
        Number(sensor="", field=_MOUNTING, axes=(k,), spread=0.1, positive=False, unit="rad")
        for k in range(3)
    ),
    *(  # the declination is its yaw
        Number(sensor="", field=_COMPASS, axes=(k,), spread=0.1, positive=False, unit="rad")
        for k in range(2)
    ),
    Number(sensor="imu", field="accel_noise_density", spread=2.5, unit="m/s^2/sqrt(Hz)"),
    Number(sensor="imu", field="gyro_noise_density", spread=2.0, unit="rad/s/sqrt(Hz)"),
    Number(sensor="imu", field="accel_bias_sigma", spread=_NARROW, unit="m/s^2",
           limit=0.5),
    Number(sensor="imu", field="gyro_bias_sigma", spread=_WIDE, unit="rad/s"),
    Number(sensor="gnss", field="position_sigma_I", axes=_LEVEL, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="position_sigma_I", axes=_UP, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_sigma_I", axes=_LEVEL, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_sigma_I", axes=_UP, spread=_WIDE, unit="m"),
    Number(sensor="gnss", field="drift_tau", spread=_WIDE, unit="s"),
    Number(sensor="gnss", field="velocity_sigma", spread=_WIDE, unit="m/s"),
    Number(sensor="gnss", field="baseline_sigma", spread=_WIDE, unit="rad",
           limit=3.0),
    *(
        Number(sensor="gnss", field=_LEVER, axes=(k,), spread=0.15, positive=False, unit="m")
        for k in range(3)
    ),
    Number(sensor="camera", field="pixel_sigma", spread=_WIDE, unit="pixels"),
    *(
        number
        for name, kind in AID_PARAMS.items()
        for number in (
            Number(sensor=name, field="noise_sigma", spread=_WIDE, unit=kind.unit),
            *_OF_AIDS.get(name, ()),
        )
    ),
)
# fmt: on
"""Numbers that a calibration finds. The spreads are engineering judgment: data sheets describe a
sensor at rest, and vibration, airflow and motor currents multiply its noise. A flight with little
tilt cannot separate a bias of the accelerometer from the tilt: its prior is narrow, up to 0.5 m/s^2
of data sheets (TDK ICM-20948)."""


def numbers_in(suite: SensorSuite, log: Log, delays: bool, rotation: bool) -> list[Number]:
    """Return the numbers of the sensors that a suite and a log have.

    With or without delays, and with the rotation of the IMU or of the magnetometer only.
    """
    measured = {name for name in log.streams if getattr(suite, name, None) is not None}
    paired = "gnss" in measured and has_heading(log)
    others = {
        # with axes in B
        _MOUNTING: rotation and (paired or bool(measured & {"camera", "magnetometer"})),
        _COMPASS: not rotation and "magnetometer" in measured,
        "baseline_sigma": paired,
        "velocity_sigma": has(log, "velocity"),
        # of baselines, noise hides it
        _LEVER: not has(log, "baseline")
        and suite.gnss is not None
        and suite.gnss.position_sigma_I[0] <= _PRECISE,
    }
    found = []
    for number in NUMBERS:
        known = number.sensor in measured or number.field in (_MOUNTING, _COMPASS)
        if number.sensor == _DELAYS:
            known = delays and number.field in measured
        if known and others.get(number.field, True):
            value = getattr(number.part(suite), number.field)
            if value is not None and (not number.positive or np.all(np.asarray(value) != 0.0)):
                found.append(number)
    return found


def has_heading(log: Log) -> bool:
    """Return True if a log has baselines, or attitudes, which act as such."""
    return has(log, "baseline") or log.attitude is not None


def has(log: Log, quantity: str) -> bool:
    """Return True if a log has a quantity of GNSS, such as "baseline"."""
    given = {} if log.gnss is None else log.gnss.values
    values = [given[name] for name in READINGS[f"gnss_{quantity}"].in_logs if name in given]
    return any(np.isfinite(value).any() for value in values)


# --------------------------------------------------------------------------------------------------
# Derivatives of losses by differences, and what follows from them.
# --------------------------------------------------------------------------------------------------

_RIDGE = 0.1  #: relative increase of the diagonal of squared scores, which are estimates


def derivatives(losses: Floats, steps: Floats) -> tuple[Floats, Floats]:
    """Return scores (parts, n), and second derivatives (n,) of the sum over all parts.

    The losses (parts, 1 + 2 n) are at a point, and a step (n,) ahead and back along each axis.
    """
    count = 2 * len(steps) + 1
    ahead, back = losses[:, 1:count:2], losses[:, 2:count:2]
    bends = (ahead + back).sum(axis=0) - 2.0 * losses[:, 0].sum()
    return (ahead - back) / (2.0 * steps), bends / steps**2


def spread_between(losses: Floats, h: Floats, sizes: Sequence[int], length: int) -> Floats:
    """Return the variances (n,) of numbers between logs, from losses as in `derivatives`.

    Each log has its best number one Newton step from the common one; the variance of these beyond
    the uncertainty within each log is the method of moments of DerSimonian and Laird, Controlled
    Clinical Trials 7(3), 1986, with equal weights.
    """
    steps, errors = [], []
    for rows in np.split(losses, np.cumsum(sizes)[:-1]):
        scores, bends = derivatives(rows, h)
        H = np.maximum(bends, 0.0) + 1.0
        sums = np.add.reduceat(scores, np.arange(0, len(scores), length))
        steps.append(-scores.sum(axis=0) / H)
        errors.append((sums**2).sum(axis=0) / H**2)
    if len(steps) < 2:
        return np.zeros(len(h))
    return np.maximum(np.var(steps, axis=0, ddof=1) - np.mean(errors, axis=0), 0.0)


def curvature(scores: Floats, bends: Floats) -> Floats:
    """Return second derivatives with the correlations of the scores."""
    squares = scores.T @ scores
    squares += np.diag(_RIDGE * np.diag(squares) + 1e-9)
    sizes = np.sqrt(np.maximum(bends, 0.0) / np.diag(squares))
    return squares * sizes * sizes[:, np.newaxis]


def lowest(places: Floats, losses: Floats) -> float:
    """Return the minimum of a parabola through the lowest loss on a grid and its neighbors."""
    k = int(np.clip(np.argmin(losses), 1, len(losses) - 2))
    bend, slope, _ = np.polyfit(places[k - 1 : k + 2] - places[k], losses[k - 1 : k + 2], 2)
    reach = float(places[1] - places[0])
    move = -0.5 * slope / bend if bend > 0.0 else 0.0
    return float(places[k] + np.clip(move, -reach, reach))


# --------------------------------------------------------------------------------------------------
# Search for the numbers of a sensor suite.
#
# The search maximizes the likelihood of the innovations (`likelihood.py`) in the first part of the
# log, with priors about the numbers. It begins on grids of delays, in a short part of
# the flight. Newton steps follow, whose derivatives are differences between filters: side by side
# for numbers of the suite, on a log each for delays and the mounting of the IMU. Their second
# derivatives are exact on the diagonal, and otherwise as correlated as the scores of parts of the
# log.
#
# The likelihood alone may make noise too small where errors are correlated in time, as near motors:
# innovations are as small as predicted, but not white. Noise of such sensors then becomes larger by
# sqrt(tau) (`widening`), where tau is the integrated autocorrelation time of the innovations in
# samples, and the other numbers are fitted again. The log decides: the wider noise stays if fixes
# that are left out for a second are more likely with it.
# --------------------------------------------------------------------------------------------------

_SILENT = 0.8
"""Ratio of standard deviations after and before above which a log does not determine a number."""
_COARSE_NOISE = ("imu.accel_noise_density", "imu.gyro_noise_density")  #: begun with twice
_FEW_STEPS, _STEPS = 4, 12  #: Newton steps from each beginning, and after
_SHARES = np.array([1.0, 0.75, 0.5, 0.35, 0.2, 0.1, 0.05, 0.02])
"""Shares of a Newton step that are tried side by side."""
_MIN_GAIN = 0.02  #: drop of the log likelihood in a step with which the search ends
_FINE, _LONG = 0.3, 3.0
"""Steps for intervals over those of the search: of numbers in which the loss is smooth, and of
delays in which it is not."""
_KINKED = 0.4  #: share of a second derivative that remains with long steps if kinks cause it
_SHORT = 45.0  #: time of flight that is enough for the first search [s]
_CLUSTER, _CLUSTERS = 5.0, 20
"""Length of independent parts of a log [s], shorter in short logs; their least number."""
_CLOSE = 2.0  #: rise of the loss with which undetermined numbers move back to their priors
_WIDEST = math.log(2.0)
"""Largest logarithm of the factor by which a standard deviation exceeds the best fit. The factor is
exp(2 s^2), where s is the standard deviation of its logarithm if the other numbers are known. Its
square is then the root mean square of the variance: noise that is too small costs more than noise
that is too large. The best fit to several logs is between their noise already, so that its own
standard deviation counts, not the spread of the logs."""
_MIN_COUNT = 30  #: number of innovations that describes their tails and correlations
_COARSE = np.arange(-1.0, 1.01, 0.1)  #: first grid of a delay [s]
_MARGIN = 0.2  #: time at the end of the log that changes of delays may reach [s]
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

    number: Number  #: part and field of the suite, with unit and prior
    prior: float  #: number in the suite from which the calibration starts
    value: float
    """number in the suite; a standard deviation is up to twice the best fit where the log hardly
    determines it"""
    low: float  #: lower end of its 95 % interval
    high: float  #: upper end of its 95 % interval
    determined: bool  #: False: the log does not determine it


class NumberSearch:
    """The search for the numbers of a suite, at coordinates x."""

    def __init__(
        self,
        logs: Sequence[Log],
        prior: SensorSuite,
        starts: Sequence[dict[str, Any]],
        delays: bool,
        rotation: bool,
    ) -> None:
        self.logs, self.prior, self.starts = list(logs), prior, starts
        self.nu: dict[str, float] = {}  #: tails of innovations by sensor, see `Likelihood`
        self.white: set[str] = set()  #: sensors whose innovations are white
        every = (n for log in logs for n in numbers_in(prior, log, delays, rotation))
        self.numbers = list(dict.fromkeys(every))
        self.kept = np.zeros(len(self.numbers), bool)  #: numbers that keep their priors
        self.values = np.array([number.of(prior) for number in self.numbers])
        ends = [number.ends(number.of(prior)) for number in self.numbers]
        self.low, self.high = np.array(ends).reshape(-1, 2).T.copy()
        self.of_log = np.array([number.of_log for number in self.numbers])
        period = max(float(np.median(np.diff(log.imu.time))) for log in logs)
        self.steps = np.diag([number.step_for(period) for number in self.numbers])
        self.x = np.clip(self._first(), self.low, self.high)
        self._margin = _MARGIN
        self._known: dict[bytes, list[Likelihood]] = {}
        self._sizes: list[int] = []  # numbers of parts of the logs

    def _first(self) -> Floats:
        """Return where the search begins: with noise as wide as the log may need."""
        x = np.zeros(len(self.numbers))
        for k, (number, value) in enumerate(zip(self.numbers, self.values, strict=True)):
            wide = {"gnss.velocity_sigma": 4.0, "magnetometer.hard_iron_sigma": 3.0}
            if number.positive:
                x[k] = number.coordinate(value, wide.get(number.name, 1.0) * value)
            if number.name in _COARSE_NOISE:  # of the largest that the samples admit
                rough = self._roughness(number)
                x[k] = max(0.0, number.coordinate(value, rough)) if rough > 0.0 else 0.0
        return x

    def _roughness(self, number: Number) -> float:
        """Return the noise density of the IMU if its samples changed by noise only."""
        found = []
        for log in self.logs:
            values = log.imu.values[number.field.split("_")[0]]
            dt = float(np.median(np.diff(log.imu.time)))
            found.append(float(np.diff(values, axis=0).std()) * math.sqrt(0.5 * dt))
        return float(np.median(found))

    def suite(self, x: Floats, gate: bool = False) -> SensorSuite:
        """Return the suite at coordinates."""
        found = self.prior
        if not gate:  # whose decisions are no smooth function of the numbers
            found = found.replace(estimator=found.estimator.replace(false_alarm_probability=0.0))
        for number, value, place in zip(self.numbers, self.values, x, strict=True):
            found = number.put(found, number.value(value, float(place)))
        return found

    def losses(self, points: Sequence[Floats]) -> Floats:
        """Return the losses of parts of all logs, (parts, points), without priors."""
        found = np.empty((0, 0))
        groups: dict[bytes, list[int]] = {}  # of points with the same delays and mounting
        for k, point in enumerate(points):
            groups.setdefault(point[self.of_log].tobytes(), []).append(k)
        for key, rows in groups.items():
            suites = [self.suite(points[k]) for k in rows]
            likelihoods = self._known.get(key) or self._likelihoods(suites[0])
            if key == self.x[self.of_log].tobytes():
                self._known = {key: likelihoods}
            each = [likelihood.losses(suites) for likelihood in likelihoods]
            self._sizes, some = [len(losses) for losses in each], np.concatenate(each)
            found = found if found.size else np.empty((len(some), len(points)))
            found[:, rows] = some
        return found

    def _likelihoods(self, suite: SensorSuite) -> list[Likelihood]:
        """Return the likelihood of each log with the delays and the mounting of a suite."""
        made = []
        for log, start in zip(self.logs, self.starts, strict=True):
            with naming(log):
                made.append(Likelihood(log, suite, start, self.nu, self.white, self._margin))
        return made

    def total(self, points: Sequence[Floats]) -> Floats:
        """Return the losses of the whole log, with priors."""
        return self.losses(points).sum(axis=0) + [0.5 * float(p @ p) for p in points]

    def begin(self) -> None:
        """Begin the search in a short part of the flight: delays on grids, and noise of the IMU.

        The likelihood has several maxima, as noise of the IMU and drift of GNSS both explain large
        innovations: the search begins with much and with little of the first.
        """
        whole = self.logs
        self.logs = [_begin_of(log, _SHORT / len(whole) + SETTLING) for log in whole]
        for k, number in enumerate(self.numbers):
            if number.sensor == "log_delays":
                self._margin = max(0.0, -float((self.values[k] + _COARSE).min())) + _MARGIN
                self._known = {}
                places = self.x[k] + _COARSE / number.spread
                places = places[(places >= self.low[k]) & (places <= self.high[k])]
                points = [np.where(np.arange(len(self.x)) == k, x, self.x) for x in places]
                self.x[k] = lowest(places, self.total(points))
        little = np.where([n.name in _COARSE_NOISE for n in self.numbers], 0.0, self.x)
        tried = [self._descend(x, ~self.of_log, _FEW_STEPS) for x in (self.x, little)]
        self.x = min(tried, key=lambda found: found[1])[0]
        self.logs, self._known = whole, {}

    def fit(self) -> None:
        """Find delays and mounting, and the numbers of the suite, in turn."""
        delays = vars(self.suite(self.x).log_delays).values()
        self._margin = _MARGIN + max(0.0, *(-delay for delay in delays))
        self._known = {}
        for again in (True, False):
            if self.of_log.any():
                self.x, _ = self._descend(self.x, self.of_log, 2)
            self.x, _ = self._descend(self.x, ~self.of_log, _STEPS)
            if again and self.nu:
                self.describe()

    def _descend(self, x: Floats, chosen: Any, steps: int) -> tuple[Floats, float]:
        """Return where Newton steps over the chosen coordinates end, and the loss there."""
        index = np.flatnonzero(chosen)
        axes, shares = self.steps[index], _SHARES[[0, 2, 4]] if self.of_log[index[0]] else _SHARES
        loss = math.inf
        for _ in range(steps):
            losses = self.losses([x, *(x + s * step for step in axes for s in (1.0, -1.0))])
            loss = float(losses[:, 0].sum() + 0.5 * x @ x)
            scores, bends = derivatives(losses, np.diag(self.steps)[index])
            slope, place = scores.sum(axis=0) + x[index], x[index]
            H = curvature(scores, bends) + np.eye(len(index))
            held = (place <= self.low[index]) & (slope > 0.0)
            held |= (place >= self.high[index]) & (slope < 0.0)
            free, step = np.flatnonzero(~held), np.zeros(len(x))
            step[index[free]] = -np.linalg.solve(H[np.ix_(free, free)], slope[free])
            step /= max(1.0, float(np.abs(step).max()))
            points = [np.clip(x + share * step, self.low, self.high) for share in shares]
            totals = self.total(points)
            best = int(np.argmin(totals))
            gain = loss - float(totals[best])
            if gain > 0.0:
                x, loss = points[best], float(totals[best])
            if gain < _MIN_GAIN:
                break
        return x, loss

    def adapt(self) -> None:
        """Fit with the tails of the innovations, and with wider noise where they are correlated.

        The wider noise stays if fixes that are left out for a second are more likely with it.
        """
        self.describe()
        self.fit()
        wide = self.widened(self.describe())
        if (wide == self.low).all():
            return
        narrow = self.x, self.low, dict(self.nu), set(self.white)
        loss = self._left_out()
        self.low, self.x = wide, np.maximum(self.x, wide)
        self.fit()
        if not self._left_out() < loss:
            self.x, self.low, self.nu, self.white = narrow
            self._known = {}

    def widened(self, scaled: dict[str, Floats]) -> Floats:
        """Return lower ends of the numbers with wider noise, from innovations over their sigmas."""
        low = self.low.copy()
        for k, number in enumerate(self.numbers):
            sensor, axes, most = _WHITE.get(number.name, ("", slice(0), 1.0))
            if len(scaled.get(sensor, ())) > _MIN_COUNT:
                factor = widening(scaled[sensor][:, axes], most)
                value = factor * number.value(self.values[k], float(self.x[k]))
                wide = number.coordinate(self.values[k], value)
                if factor > 1.0:
                    low[k] = min(max(low[k], wide), self.high[k] - 0.1)
        return low

    def _left_out(self) -> float:
        """Return the loss of fixes that are left out for a second; infinite without fixes."""
        suite, total = self.suite(self.x, gate=True), math.inf
        for log, start in zip(self.logs, self.starts, strict=True):
            if (found := left_out(log, suite, start)) is not None:
                losses = loss_of(found.nis, found.sigma)[in_flight(log, found.received)]
                total = float(losses.sum()) + (0.0 if total == math.inf else total)
        return total

    def take(self, other: "NumberSearch") -> None:
        """Begin where the search in some of the logs has ended."""
        self.nu, self.white = other.nu, other.white
        for number, x, low in zip(other.numbers, other.x, other.low, strict=True):
            k = self.numbers.index(number)
            self.x[k], self.low[k] = x, low

    def describe(self) -> dict[str, Floats]:
        """Find tails and whiteness of the innovations; return the innovations over their sigmas."""
        suite = self.suite(self.x, gate=True)
        values: dict[str, list[Floats]] = {}
        nis: dict[str, list[Floats]] = {}
        for log, start in zip(self.logs, self.starts, strict=True):
            measured = replay(log, sensors=suite, start=start, reported_noise=False).measured
            for name, m in measured.items():
                counts = in_flight(log, m.time) & np.isfinite(m.nis)
                counts &= m.time > m.time[0] + SETTLING
                values.setdefault(name, []).append((m.innovation / m.sigma)[counts])
                nis.setdefault(name, []).append(m.nis[counts])
        scaled = {name: np.concatenate(some) for name, some in values.items()}
        for name, some in nis.items():
            if len(scaled[name]) > _MIN_COUNT:
                self.nu[name] = tails(np.concatenate(some), scaled[name].shape[1])
        self.white = {
            name
            for name, each in scaled.items()
            if len(each) > _MIN_COUNT and max(map(correlation_time, each.T)) == 1.0
        }
        self._known = {}
        return scaled

    def intervals(self) -> tuple[Calibrated, ...]:
        """Return the numbers with 95 % intervals.

        The covariance is H^-1 J H^-1 (Godambe), with the curvature H from differences and J the sum
        of squares of the scores of independent parts of the log. Of several logs, the spread of
        the numbers between flights enters too.
        """
        from scipy.stats import t

        n, h = len(self.x), self._steps_of_intervals()
        axes = np.diag(h)
        row, column = np.triu_indices(n, 1)
        points = [self.x, *(self.x + s * e for e in axes for s in (1.0, -1.0))]
        points += [self.x + axes[i] + axes[j] for i, j in zip(row, column, strict=True)]
        losses = self.losses(points)
        scores, bends = derivatives(losses, h)
        total = losses.sum(axis=0)
        ahead, both = total[1 : 2 * n : 2], total[2 * n + 1 :]
        H = np.diag(bends)
        H[row, column] = (both - ahead[row] - ahead[column] + total[0]) / (h[row] * h[column])
        H[column, row] = H[row, column]
        silent = bends <= 0.0  # at a bound, where the loss has no minimum
        H[silent], H[:, silent], scores[:, silent] = 0.0, 0.0, 0.0
        values, vectors = np.linalg.eigh(H)
        information = (vectors * np.maximum(values, 0.0)) @ vectors.T + np.eye(n)
        length = max(1, round(min(_CLUSTER / PART, len(scores) / _CLUSTERS)))
        sums = np.add.reduceat(scores, np.arange(0, len(scores), length))
        sums -= sums.mean(axis=0)  # not zero at a bound
        root = np.linalg.solve(information, np.linalg.cholesky(sums.T @ sums + np.eye(n)))
        between = spread_between(losses, h, self._sizes, length)
        sigmas = np.minimum(np.sqrt((root**2).sum(axis=1) + between), 1.0)
        sigmas = np.where(self.kept, 1.0, sigmas)
        curved = np.maximum(bends, 0.0)
        alone = np.sqrt(np.maximum((sums**2).sum(axis=0), curved) + 1.0) / (curved + 1.0)
        reach = float(t.ppf(0.975, len(sums) - 1))
        found, priors = [], self.values.tolist()
        for k, (number, prior) in enumerate(zip(self.numbers, priors, strict=True)):
            square = float(alone[k]) ** 2 + float(between[k]) / len(self._sizes)
            wide = 2.0 * number.spread * square if number.noise else 0.0
            moves = (min(wide, _WIDEST / number.spread), -reach * sigmas[k], reach * sigmas[k])
            value, low, high = (number.value(prior, float(self.x[k] + move)) for move in moves)
            determined = bool(sigmas[k] < _SILENT)
            found.append(Calibrated(number, prior, value, low, high, determined))
        return tuple(found)

    def keep_priors(self, found: Sequence[Calibrated]) -> bool:
        """Move angles, delays and lever arms back to their priors if the loss hardly grows.

        The other numbers of the suite are fitted again. Return True if any number moved.
        """
        limit = float(self.total([self.x])[0]) + _CLOSE
        for k, each in enumerate(found):
            if each.determined or each.number.positive:
                continue
            moved = np.where(np.arange(len(self.x)) == k, 0.0, self.x)
            if float(self.total([moved])[0]) < limit:
                self.x, self.kept[k] = moved, True
        if self.kept.any():
            self._known = {}
            self.x, _ = self._descend(self.x, ~(self.of_log | self.kept), _FEW_STEPS)
        return bool(self.kept.any())

    def _steps_of_intervals(self) -> Floats:
        """Return steps: short where the loss is smooth, long for delays where it has kinks."""
        steps, chosen = np.diag(self.steps), np.full(len(self.steps), _FINE)
        for k in np.flatnonzero([number.sensor == "log_delays" for number in self.numbers]):
            ends = [s * share * self.steps[k] for share in (1.0, _LONG) for s in (1.0, -1.0)]
            losses = self.losses([self.x, *(self.x + end for end in ends)])
            _, (short, long) = derivatives(losses, steps[k] * np.array([1.0, _LONG]))
            chosen[k] = _LONG if short <= 0.0 or long < _KINKED * short else 1.0
        return steps * chosen


def _begin_of(log: Log, seconds: float) -> Log:
    """Return a log up to some time of flight [s]."""
    time = log.imu.time
    flying = np.cumsum(np.diff(time, prepend=time[0]) * in_flight(log, time))
    last = int(np.searchsorted(flying, seconds))
    return log.until(float(time[min(last, len(time) - 1)]))


def widening(scaled: Floats, most: float) -> float:
    """Return the factor of noise whose innovations (n, axes), over their sigmas, are correlated.

    It is sqrt(tau), but at most `most`.
    """
    tau = max(correlation_time(column) for column in scaled.T)
    return math.sqrt(min(tau, most**2))
