"""Checks of the units and axes of a log, and of a suite against a replay, as plain sentences.

Each sentence states a number, the expected one, and the likely cause.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from quad_gym.estimation.logs import Floats, Log
from quad_gym.estimation.results import Measured, Replay, by_sensor
from quad_gym.params.sensors import SensorSuite

LEAST_FORCE, MOST_FORCE = 5.0, 20.0
"""Mean specific force of a flight [m/s^2]; the mean vertical part is gravity in any long flight."""
FORCE_CAUSES = (
    (0.5, "gravity subtracted from the accelerometer?"),
    (2.0, "accelerometer in g?"),
    (25.0, "unit or scale of the accelerometer?"),
    (50.0, "accelerometer in ft/s^2?"),
    (500.0, "unit or scale of the accelerometer?"),
    (math.inf, "accelerometer in milli-g or cm/s^2?"),
)
"""Likely causes of other values, each up to a mean specific force [m/s^2]."""
MOST_RATE = 35.0  #: largest angular rate that gyros measure [rad/s]: 2000 deg/s
MOST_MEAN_RATE = 10.0
"""Mean angular rate of a vehicle over a log [rad/s]: one and a half turns per second."""
MOST_FIELD = 5.0  #: ratio of the mean magnetic field and the suite's, either way [-]
MOST_HEIGHT = 20_000.0  #: mean height by a barometer [m]
MOST_NIS = 10.0  #: mean NIS of the measurements used, over their degrees of freedom [-]
MOST_REJECTED = 0.1  #: share of the measurements of a sensor that the gate rejects [-]
MOST_CORRELATED, FEWEST = 0.8, 50
"""Correlation of successive innovations of GNSS that all axes exceed, and the number of innovations
that shows it: they are then no noise, but errors of the clock, or motion that the filter misses."""
MOST_BIAS = 4.0
"""Root mean square of an estimated bias, over the standard deviation in the suite [-]: a wrong
field, clock or mounting moves the biases before it moves the innovations."""
MOST_DIVERGED = 0.25  #: share of the samples at which the filter counts as diverged [-]

FIELD_UNITS = {1e4: "gauss", 1e6: "microtesla", 1e7: "milligauss", 1e9: "nanotesla"}
"""Units in which a field is written, by how many of them one tesla has."""

NAMES = {
    "gnss_position": "GNSS position",
    "gnss_baseline": "GNSS baseline",
    "gnss_velocity": "GNSS velocity",
    "features": "camera features",
    "barometer": "barometer",
    "magnetometer": "magnetometer",
}
"""Sensors in sentences."""

ADVICE = (
    "Check the units, axes and time stamps of the log, or use a suite with the noise, delays and "
    "mounting of these sensors: `quad-gym calibrate LOG` finds noise, delays and lever arms."
)


class MisfitError(ValueError):
    """The suite cannot be used with the log."""


def problems_of(log: Log, body: str, suite: SensorSuite, result: Replay) -> tuple[str, ...]:
    """Return sentences on units and axes of a log, and on a suite that does not fit."""
    found = [*implausible(log, body, suite)]
    if result.status:
        found.append(f"the filter failed in some cycles ({result.status.name})")
    diverged = float(np.mean(result.diverged))
    if diverged > MOST_DIVERGED:
        found.append(
            f"the filter counted as diverged for {_percent(diverged)} of the time: do not rely on "
            "its estimates"
        )
    if not result.measured and result.unused:
        found.append(f"{nothing_in_common(result.unused)}: the estimates are dead reckoning")
    return (*found, *_misfits(result.measured), *_biases(result, suite))


def implausible(log: Log, body: str, suite: SensorSuite) -> Iterator[str]:
    """Yield sentences on units and axes of a log."""
    gyro, accel = (log.imu.values[name] for name in ("gyro", "accel"))
    yield from _force(accel, body)
    yield from _rates(gyro)
    yield from _aids(log, suite)


def nothing_in_common(unused: tuple[str, ...]) -> str:
    """Return a sentence on a suite that has none of the sensors of a log."""
    return f"this suite uses no measurement of this log, which has {', '.join(unused)}"


def _force(accel: Floats, body: str) -> Iterator[str]:
    """Units and axes of the accelerometer, by gravity."""
    size, upward = float(np.linalg.norm(accel, axis=1).mean()), accel.mean(axis=0)
    if not LEAST_FORCE <= size <= MOST_FORCE:
        cause = next(cause for most, cause in FORCE_CAUSES if size <= most)
        yield f"mean specific force is {size:.1f} m/s^2, 9.8 expected: {cause}"
    axis = int(np.argmax(np.abs(upward)))
    if abs(upward[axis]) < 0.5 * size or (axis == 2 and upward[2] > 0.0):
        return
    sign = "+" if upward[axis] > 0.0 else "-"
    pointing = f"mean specific force points along the body's {sign}{'xyz'[axis]}"
    if axis == 2:
        other = {"flu": "frd", "frd": "flu"}[body]
        yield f"{pointing} axis, +z expected: body='{other}' (--body {other})?"
    else:
        yield f"{pointing} axis, +z expected: axes of the IMU other than forward, left and up?"


def _rates(gyro: Floats) -> Iterator[str]:
    """Units of the gyro."""
    sizes = np.linalg.norm(gyro, axis=1)
    if np.abs(gyro).max() > MOST_RATE:
        yield (
            f"angular rates reach {np.abs(gyro).max():.3g} rad/s, gyros measure up to "
            f"{MOST_RATE:g} rad/s: gyro in deg/s?"
        )
    elif sizes.mean() > MOST_MEAN_RATE:
        yield (
            f"mean angular rate is {sizes.mean():.3g} rad/s, at most {MOST_MEAN_RATE:g} expected: "
            "gyro in deg/s?"
        )


def _aids(log: Log, suite: SensorSuite) -> Iterator[str]:
    """Units of magnetometer and barometer, where the suite uses them."""
    if suite.magnetometer is not None and log.magnetometer is not None:
        field = log.magnetometer.values["magnetometer"]
        size = float(np.nanmean(np.linalg.norm(field, axis=1)))
        ratio = size / suite.magnetometer.strength
        if not 1.0 / MOST_FIELD <= ratio <= MOST_FIELD:
            near = {abs(np.log(ratio / n)): f"field in {unit}?" for n, unit in FIELD_UNITS.items()}
            cause = near[min(near)] if min(near) < np.log(MOST_FIELD) else "unit of the field?"
            yield (
                f"mean magnetic field is {size:.3g} T, {suite.magnetometer.strength:.3g} expected: "
                f"{cause}"
            )
    if suite.barometer is not None and log.barometer is not None and not log.barometer_from_start:
        height = float(np.nanmean(log.barometer.values["barometer"]))
        if abs(height) > MOST_HEIGHT:
            yield f"mean barometric height is {height:.6g} m: pressure in Pa in place of a height?"


def _misfits(measured: Mapping[str, Measured]) -> Iterator[str]:
    """Sensors whose innovations are larger than the suite has them."""
    for name, m in by_sensor(measured).items():
        freedom, rejected = m.innovation.shape[1], m.rejected
        nis, share = m.nis[np.isfinite(m.nis)], float(rejected.mean())
        used = m.nis[np.isfinite(m.nis) & ~rejected]
        large = len(used) and used.mean() > MOST_NIS * freedom
        if large or (share > MOST_REJECTED and rejected.sum() > 1):
            yield (
                f"{NAMES[name]}: mean NIS {nis.mean():.3g}, {freedom} expected, {_percent(share)} "
                "rejected: this suite does not describe this log"
            )
        elif name.startswith("gnss") and (rho := _correlation(m)) > MOST_CORRELATED:
            yield (
                f"{NAMES[name]}: successive innovations have a correlation of {rho:.2f}, 0 "
                "expected: time stamps or noise of this suite do not describe this log"
            )


def _correlation(m: Measured) -> float:
    """Return the correlation of successive innovations after the start, the least of all axes."""
    scaled = (m.innovation / m.sigma)[np.isfinite(m.nis)]
    scaled = scaled[len(scaled) // 5 :]
    if len(scaled) < FEWEST:
        return 0.0
    both = (scaled[1:] * scaled[:-1]).mean(axis=0) / (scaled**2).mean(axis=0)
    return float(both.min())


def _biases(result: Replay, suite: SensorSuite) -> Iterator[str]:
    """Biases of the IMU that the suite does not admit."""
    for name, unit in (("accel", "m/s^2"), ("gyro", "rad/s")):
        found = np.sqrt((getattr(result, f"{name}_bias") ** 2).mean(axis=0)).max()
        sigma = getattr(suite.imu, f"{name}_bias_sigma")
        if not found <= MOST_BIAS * sigma:
            word = {"accel": "accelerometer", "gyro": "gyro"}[name]
            yield (
                f"{word}: estimated bias {found:.2g} {unit}, {sigma:.2g} expected: magnetic field, "
                "time stamps, mounting or noise of this suite do not describe this log"
            )


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"
