"""Calibration: the numbers of a sensor suite from the log of a flight.

The first part of the log is for the search (`search.py`), the rest validates its result.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np

from quad_gym.estimation.logs import Log, Reading, read_log
from quad_gym.estimation.logs.parts import longest_part, naming
from quad_gym.estimation.logs.quantities import compared
from quad_gym.estimation.numbers import has
from quad_gym.estimation.plausibility import implausible
from quad_gym.estimation.replaying import origin_of
from quad_gym.estimation.search import Calibrated, NumberSearch
from quad_gym.estimation.validation import Validation, validate
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.suites import sensor_suite

_IRON_TAU = 30.0
"""Prior correlation time of hard iron that is constant in the suite [s]: currents of motors change
in flight."""
_DRIFT, _DRIFT_TAU = 3.0, 5.0
"""Prior drift of GNSS in a suite without, in standard deviations of its noise, and its correlation
time [s]: receivers filter their positions."""
_AIDS = ("gnss", "camera", "barometer", "magnetometer", "optical_flow", "range_finder")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`."""

    suite: SensorSuite  #: the suite with the numbers that were found
    prior: SensorSuite  #: the suite before
    numbers: tuple[Calibrated, ...]
    before: Validation  #: the suite before, on the validation part of the log
    after: Validation  #: the suite with the numbers that were found, on this part
    split: float  #: time at which this part begins [s]

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
        absent = [name for name in _AIDS if getattr(self.suite, name) and name not in found]
        return (
            *(
                f"the log does not determine {n.number.name} ({n.value:.3g}, {n.prior:.3g} before)"
                for n in silent
            ),
            *(
                f"the log has no {name.replace('_', ' ')}: the suite keeps its own"
                for name in absent
            ),
        )


def calibrate(
    log: Any,
    *,
    sensors: SensorSuite | str,
    start: Mapping[str, Any] | None = None,
    share: float = 0.5,
    delays: bool = True,
    progress: Callable[[str], None] | None = None,
    **reading: Unpack[Reading],
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
        progress: Called with a sentence before each step.
        **reading: Keywords of `read_log`: `body`, `instance`, `topic`, `columns`, `from_`, `until`.

    Raises:
        ValueError: If the log or an argument is invalid, units or axes of the log are implausible,
            or the heading at the start is unknown.
    """
    suite = sensor_suite(sensors) if isinstance(sensors, str) else sensors
    check.instance("sensors", suite, SensorSuite)
    check.number("share", share, least=0.05, most=0.95)
    check.flag("delays", delays)
    whole = longest_part(read_log(log, **reading))
    with naming(whole):
        return _calibrated(whole, suite, dict(start or {}), share, delays, reading, progress)


def _calibrated(
    whole: Log,
    suite: SensorSuite,
    start: dict[str, Any],
    share: float,
    delays: bool,
    reading: Reading,
    progress: Callable[[str], None] | None,
) -> Calibration:
    """Search and validate, see `calibrate`."""
    placed = origin_of(whole, suite)
    whole = compared(whole, placed)
    wrong = [*whole.problems, *implausible(whole, reading.get("body", "flu"))]
    if wrong:
        raise ValueError(f"a calibration must have a log in SI units: {'; '.join(wrong)}")
    prior = _prior_of(placed, whole)
    time = whole.imu.time
    split = float(time[0] + share * (time[-1] - time[0]))
    report = progress or (lambda _: None)
    search = NumberSearch(whole.until(split), prior, start, delays)
    report(f"Search for {len(search.numbers)} numbers in a part of the flight")
    search.begin()
    report("Search in all of the first part")
    search.fit()
    report("Search with the tails and correlations of the innovations")
    search.adapt()
    search.fit()
    report("Intervals")
    found = search.intervals()
    if search.keep_priors(found):
        found = search.intervals()
    report("Validation")
    new = prior
    for each in found:
        new = each.number.put(new, each.value)
    new = _like_the_log(new, whole)
    before, after = (validate(whole, s, start, split) for s in (prior, new))
    return Calibration(new, prior, found, before, after, split)


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
    if gnss is not None and has(log, "baseline"):
        gnss = gnss.replace(heading_error_sigma=0.0)  # the mounting of the IMU shows it
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
        late = float(np.median(stream.received - stream.time)) + getattr(suite.log_delays, name)
        latency = min(max(0.0, round(late * rate) / rate), 2.0 * ticks / rate)
        changes[name] = params.replace(rate=rate / ticks, latency=latency)
    return suite.replace(**changes)
