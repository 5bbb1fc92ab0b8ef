"""Calibration: the numbers of a sensor suite from logs of flights.

The first part of a log, or the first ones of several logs, are for the search (`search.py`); the
rest validates its result. Of several logs, all then enter the numbers: the search goes on from the
validated ones. Biases of the IMU are found first, for each flight by itself.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from quad_gym.logs.calibrating.likelihood import Validation, in_flight, pooled, validate
from quad_gym.logs.calibrating.search import Calibrated, NumberSearch, has_heading
from quad_gym.logs.double import in_double
from quad_gym.logs.formats import Log, Reading, read_log
from quad_gym.logs.formats.clocks import longest_part, naming
from quad_gym.logs.formats.quantities import compared
from quad_gym.logs.replaying.measurements import implausible
from quad_gym.logs.replaying.replay import judged, named_start, origin_of, replay
from quad_gym.logs.replaying.rules import BEYOND, MAX_BIAS
from quad_gym.params import checks as check
from quad_gym.params.sensor_table import SENSOR_PARAMS
from quad_gym.params.suites import SensorSuite, sensor_suite

_IRON_TAU = 30.0
"""Prior correlation time of hard iron that is constant in the suite [s]: currents of motors change
in flight."""
_DRIFT, _DRIFT_TAU = 3.0, 5.0
"""Prior drift of GNSS in a suite without, in standard deviations of its noise, and its correlation
time [s]: receivers filter their positions."""
_INACCURATE = 5.0  #: reported standard deviation of a fix over the median that leaves it out [-]
_AT_REST = 2.0  #: time at rest that shows the bias of the gyro [s]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`."""

    suite: SensorSuite  #: the suite with the numbers that were found
    prior: SensorSuite  #: the suite before
    numbers: tuple[Calibrated, ...]
    before: Validation  #: the suite before, on the validation part of the log
    after: Validation
    """the suite with the numbers that were found, on this part; of several logs, with the numbers
    of the first ones"""
    split: float  #: time at which this part begins [s]; of several logs, all of the later ones
    used: int = 1  #: number of logs with which the validated numbers were found
    disputes: tuple[str, ...] = ()
    """sentences on positions and velocities of GNSS that contradict each other"""

    @property
    def verdict(self) -> str:
        """The verdict in a line, such as "usable: NIS per degree of freedom 0.6 to 1.3"."""
        return self.after.verdict

    @property
    def delays(self) -> dict[str, float]:
        """Times by which the stamps of sensors are late [s], as in `suite.log_delays`."""
        numbers = [found for found in self.numbers if found.number.sensor == "log_delays"]
        return {found.number.field: found.value for found in numbers}

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on numbers that the log does not determine, and on sensors that it lacks."""
        silent = [n for n in self.numbers if not n.determined]
        found = {n.number.sensor for n in self.numbers}
        absent = [name for name in SENSOR_PARAMS if getattr(self.suite, name) and name not in found]
        return (
            *self.disputes,
            *(
                f"the log does not determine {n.number.name} ({n.value:.3g}, {n.prior:.3g} before)"
                for n in silent
            ),
            *(
                f"the log has no {name.replace('_', ' ')}: the suite keeps its own"
                for name in absent
            ),
        )


@in_double
def calibrate(
    log: Any,
    *,
    sensors: SensorSuite | str,
    start: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    share: float = 0.5,
    delays: bool = True,
    rotation: bool = False,
    progress: Callable[[str], None] | None = None,
    **reading: Unpack[Reading],
) -> Calibration:
    """Find the numbers of a sensor suite from the log of a flight, or of several.

    Where the process computes in single precision, another one does this in double precision.

    Args:
        log: A table or a file, see `read_log`; or a list of them, of one vehicle.
        sensors: The suite to begin with, or its name: its sensors, mounting and filter stay, and
            its numbers are the centers of the priors.
        start: Keywords of `initialize`, such as `{"heading": 0.5}`; a list of them for several
            logs, or one for all.
        share: Share of the log, from its beginning, that the search uses, or of the logs; the rest
            is for validation. Of several logs, all enter the numbers after the validation.
        delays: True: find delays of time stamps, too; False: keep the suite's.
        rotation: True: find the rotation from the IMU to the axes of the body; False: the axes of
            the IMU are the body's, and the magnetometer is rotated.
        progress: Called with a sentence before each step.
        **reading: Keywords of `read_log`: `body`, `instance`, `topic`, `columns`, `from_`, `until`.

    Raises:
        ValueError: If a log or an argument is invalid, units or axes of the log are implausible,
            the heading at the start is unknown, or an argument cannot be pickled in single
            precision.
    """
    suite = sensor_suite(sensors) if isinstance(sensors, str) else sensors
    check.instance("sensors", suite, SensorSuite)
    check.number("share", share, least=0.05, most=0.95)
    check.flag("delays", delays)
    check.flag("rotation", rotation)
    logs, begins, placed, disputes = _logs_and_starts(log, start, suite, reading)
    prior = _prior_of(placed, logs[0], rotation)
    report = progress or (lambda _: None)
    if len(logs) == 1:
        used, time = 1, logs[0].imu.time
        split = float(time[0] + share * (time[-1] - time[0]))
        flights, later = [logs[0].until(split)], {"": 0}
    else:
        used, split = max(1, min(len(logs) - 1, round(share * len(logs)))), -math.inf
        flights = logs
        later = {_name_of(logs[k], k): k for k in range(used, len(logs))}
    report("Biases of the IMU")
    biases = [turn_on_biases(*each, prior) for each in zip(flights, begins, strict=True)]
    flights = [_without(part, found) for part, found in zip(flights, biases, strict=True)]

    def searched(
        count: int, before: NumberSearch | None = None
    ) -> tuple[NumberSearch, tuple[Calibrated, ...], SensorSuite]:
        """Return the search in the first logs, its numbers, and the suite with them."""
        search = NumberSearch(flights[:count], prior, begins[:count], delays, rotation)
        found, new = _searched(search, report, before), prior
        for number in found:
            new = number.number.put(new, number.value)
        return search, found, _with_biases(_like_the_log(new, logs[0]), biases[:count])

    search, found, new = searched(used)
    report("Validation")
    before, after = (
        pooled({n: validate(logs[k], s, begins[k], split) for n, k in later.items()})
        for s in (prior, new)
    )
    if used < len(flights):
        _, found, new = searched(len(flights), search)
    return Calibration(new, prior, found, before, after, split, used, tuple(disputes))


def _logs_and_starts(
    log: Any, start: Any, suite: SensorSuite, reading: Reading
) -> tuple[list[Log], list[dict[str, Any]], SensorSuite, list[str]]:
    """Return the logs, checked, the start of each, the suite at the first place, and disputes."""
    several = list(log) if isinstance(log, list | tuple) else [log]
    starts: list[Any] = list(start) if isinstance(start, list | tuple) else [start] * len(several)
    if len(starts) != len(several) or not several:
        raise ValueError(f"start must be one for each of {len(several)} logs, got {len(starts)}")
    logs = [longest_part(read_log(each, **reading)) for each in several]
    placed, body = origin_of(logs[0], suite), reading.get("body", "flu")
    begins, disputes = [dict(each or {}) for each in starts], list[str]()
    for k, each in enumerate(logs):
        with naming(each):
            checked = _checked(each, placed, body)
            logs[k], wrong = judged(checked, placed, named_start(begins[k]), reported_noise=False)
            disputes += [finding.text for finding in wrong]
    return logs, begins, placed, disputes


def _searched(
    search: NumberSearch, report: Callable[[str], None], before: NumberSearch | None
) -> tuple[Calibrated, ...]:
    """Return the numbers that a search finds, from its beginning or after one in fewer logs."""
    if before is not None:
        report("Fitting to all logs")
        search.take(before)
        search.fit()
    else:
        report(f"Fitting {len(search.numbers)} parameters to part of the flight")
        search.begin()
        report("Fitting to all training data")
        search.fit()
        report("Refitting with heavy tails and autocorrelation")
        search.adapt()
    report("Computing intervals")
    found = search.intervals()
    return search.intervals() if search.keep_priors(found) else found


def _checked(log: Log, placed: SensorSuite, body: str) -> Log:
    """Return a log of the place of a suite, with fixes as accurate as they mostly are.

    Raises:
        ValueError: If the log has wrong units, or comes from another place.
    """
    log = compared(log, placed)
    if wrong := [*log.problems, *implausible(log, body)]:
        raise ValueError(f"a calibration must have a log in SI units: {'; '.join(wrong)}")
    origin = None if placed.gnss is None else np.array(placed.gnss.reference_antenna_G)
    if origin is not None and (other := log.origin(origin)) is not None and other is not origin:
        raise ValueError("logs of a calibration must come from places within 100 km")
    sigmas = _reported(log)
    if sigmas is None or log.gnss is None:
        return log
    accurate = ~(sigmas.max(axis=1) > _INACCURATE * np.nanmedian(sigmas.max(axis=1)))
    return replace(log, gnss=log.gnss.rows(accurate))


def _reported(log: Log) -> Any:
    """Return the standard deviations (n, 3) of positions that a receiver reports, or None."""
    sigmas = None if log.gnss is None else log.gnss.values.get("gnss_sigma")
    if sigmas is None:
        return None
    known = np.where(np.isfinite(sigmas) & (sigmas > 0.0), sigmas, np.nan)
    return known if np.isfinite(known).any(axis=0).all() else None


def _name_of(log: Log, k: int) -> str:
    return f"log {k + 1} {Path(str(log.about.get('file', ''))).name}".strip()


def turn_on_biases(log: Log, start: dict[str, Any], suite: SensorSuite) -> dict[str, Any]:
    """Return biases of the IMU (3,) in a flight that its suite does not admit; 0 for others.

    Of the gyro from its mean at rest, if there are two seconds; otherwise from a replay with wide
    priors, and noise of the IMU as large as its samples admit.
    """
    imu, time = suite.imu, log.imu.time
    dt = float(np.median(np.diff(time)))
    changes = {}
    for name, least in (("accel", 0.5), ("gyro", 0.1)):
        rough = float(np.diff(log.imu.values[name], axis=0).std()) * math.sqrt(0.5 * dt)
        changes[f"{name}_bias_sigma"] = max(getattr(imu, f"{name}_bias_sigma"), least)
        changes[f"{name}_noise_density"] = max(getattr(imu, f"{name}_noise_density"), rough)
    wide = suite.replace(imu=imu.replace(**changes))
    result = replay(log, sensors=wide, start=start, reported_noise=False)
    late = result.time > 0.5 * (result.time[0] + result.time[-1])
    still = ~in_flight(log, time)
    found = {}
    for name, first in (("accel", 9), ("gyro", 12)):
        bias = getattr(result, f"{name}_bias")[late].mean(axis=0)
        sigma = result.sigma[late, first : first + 3].mean(axis=0)
        if name == "gyro" and still.sum() * dt > _AT_REST:
            bias, sigma = log.imu.values[name][still].mean(axis=0), 0.0 * sigma
        large = np.abs(bias).max() > BEYOND * getattr(imu, f"{name}_bias_sigma")
        possible = large and np.abs(bias).max() < MAX_BIAS[name]
        found[name] = np.where((np.abs(bias) > 3.0 * sigma) & possible, bias, 0.0)
    return found


def _without(log: Log, biases: Mapping[str, Any]) -> Log:
    """Return a log without biases of its IMU."""
    values = {name: value - biases[name] for name, value in log.imu.values.items()}
    return replace(log, imu=replace(log.imu, values=values))


def _with_biases(suite: SensorSuite, biases: Sequence[Mapping[str, Any]]) -> SensorSuite:
    """Return a suite with the mean biases of flights, and with their spread between flights."""
    changes: dict[str, Any] = {}
    imu: dict[str, Any] = {}
    for name in ("accel", "gyro"):
        each = np.array([found[name] for found in biases])
        spread = float(each.std(axis=0, ddof=min(1, len(each) - 1)).max())
        changes[f"log_{name}_bias"] = tuple(each.mean(axis=0).tolist())
        field = f"{name}_bias_sigma"
        imu[field] = math.hypot(getattr(suite.imu, field), spread)
    return suite.replace(imu=suite.imu.replace(**imu), **changes)


def _prior_of(suite: SensorSuite, log: Log, rotation: bool) -> SensorSuite:
    """Return the suite with errors that change slowly, and with the magnetic field of the log.

    Noise of positions begins with what the receiver reports, if this is less than the suite's.
    """
    imu, gnss, compass, stream = suite.imu, suite.gnss, suite.magnetometer, log.magnetometer
    root = math.sqrt(imu.dt)  # vibration and density are one white noise in a log
    imu = imu.replace(
        accel_noise_density=imu.accel_noise * root,
        gyro_noise_density=imu.gyro_noise * root,
        accel_vibration=0.0,
        gyro_vibration=0.0,
    )
    if gnss is not None and (sigmas := _reported(log)) is not None:
        least = np.minimum(np.nanmedian(sigmas, axis=0), gnss.position_sigma_I)
        gnss = gnss.replace(position_sigma_I=tuple(least.tolist()))
    if gnss is not None and not gnss.drifts:
        drift = tuple(_DRIFT * sigma for sigma in gnss.position_sigma_I)
        gnss = gnss.replace(drift_sigma_I=drift, drift_tau=_DRIFT_TAU)
    if gnss is not None and has_heading(log):
        if rotation:  # which shows it
            gnss = gnss.replace(heading_error_sigma=0.0)
    elif gnss is not None:
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


def _like_the_log(suite: SensorSuite, log: Log) -> SensorSuite:
    """Return the suite with rates and latencies of the log, as far as flights can have them."""
    rate, changes = suite.imu.rate, {}
    for name, stream in log.streams.items():
        params = getattr(suite, name, None)
        if name == "imu" or params is None or len(stream) < 3:
            continue
        measured = 1.0 / float(np.median(np.diff(stream.time)))
        ticks = max(1, round(rate / measured))
        late = float(np.median(stream.received - stream.time))
        late += vars(suite.log_delays).get(name, 0.0)
        latency = min(max(0.0, round(late * rate) / rate), 2.0 * ticks / rate)
        changes[name] = params.replace(rate=rate / ticks, latency=latency)
    return suite.replace(**changes)
