"""Rules of the verdict on innovations, times and motion, and on unexplained changes."""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from quad_gym.frames import ecef_to_enu
from quad_gym.logs.formats import Floats, Log
from quad_gym.logs.formats.clocks import PAUSE
from quad_gym.logs.replaying.results import (
    MIN_COUNT,
    Finding,
    Fit,
    InnovationSeries,
    Replay,
    Severity,
    correlations,
    exceeds,
    larger,
    runs_beyond_chance,
)
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite
from quad_gym.rotations import quaternion_to_dcm

# --------------------------------------------------------------------------------------------------
# What the rules of a verdict look at: a log, its replay, and the innovations of each sensor.
# --------------------------------------------------------------------------------------------------

FALSE_ALARM = 1e-3  #: probability of a chance event that counts as a finding

_READINGS = {reading.together: reading for reading in READINGS.values()}

NAMES = {name: name.replace("gnss", "GNSS").replace("_", " ") for name in _READINGS}
NAMES["features"] = "camera features"
"""Readings in sentences, all blocks of one together."""


def _observing(*states: str) -> tuple[str, ...]:
    return tuple(n for n, reading in _READINGS.items() if {*states} & {*reading.observes})


_VERTICAL = "gnss_velocity"  #: also corrects the height, by its vertical part
MEASURED_BY = {
    "position": _observing("position", "velocity"),
    "height": tuple(n for n in _READINGS if n in (*_observing("height"), _VERTICAL)),
    "heading": _observing("heading"),
}
"""Readings that correct a quantity."""
OF_SENSOR = {
    name: reading.observes[0]
    for name, reading in _READINGS.items()
    if reading.observes in (("height",), ("heading",))
}
"""Quantities of readings; the position for others."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """A replay to be judged."""

    log: Log  #: corrected by the suite
    body: str  #: axes of the IMU in a table, "flu" or "frd"
    suite: SensorSuite
    result: Replay  #: its rows until the motors stop for good
    sensors: Mapping[str, InnovationSeries]  #: innovations, of all blocks of a sensor together
    fits: Mapping[str, Fit]  #: their statistics
    start: Mapping[str, Any] = field(default_factory=dict)  #: that the caller has given
    reports: Collection[str] = ()  #: sensors that report the accuracy with which they are used


def reported_by(log: Log) -> frozenset[str]:
    """Return the measurements of GNSS whose accuracy a receiver reports."""
    values = {} if log.gnss is None else log.gnss.values
    return frozenset(
        name
        for name, reading in READINGS.items()
        if reading.reported and np.isfinite(values.get(reading.sigma, math.nan)).any()
    )


def lost(quantity: str, text: str) -> Finding:
    """Return a finding with which a quantity cannot be used."""
    return Finding(quantity=quantity, severity=Severity.LOST, text=text)


def uncertain(quantity: str, text: str) -> Finding:
    """Return a finding with which a quantity has larger errors than its standard deviation."""
    return Finding(quantity=quantity, severity=Severity.UNCERTAIN, text=text)


def note(quantity: str, text: str) -> Finding:
    """Return a finding for information."""
    return Finding(quantity=quantity, severity=Severity.NOTE, text=text)


# --------------------------------------------------------------------------------------------------
# Changes of an estimate that its IMU samples do not explain.
#
# From each of many instants, the estimate is propagated with IMU samples for some time. In a
# consistent filter the later estimate differs from this by at most the standard deviation of the
# propagation, because measurements then only remove a part of it. A filter that follows a drift or
# a jump of GNSS, or finds out that it was wrong, changes by many standard deviations.
# --------------------------------------------------------------------------------------------------

HORIZONS = (0.5, 2.0)
"""Durations of the propagations [s]: jumps, and changes within the seconds after which a filter
accepts measurements that it has rejected."""
IMPACT = 30.0
"""Specific force of a touchdown [m/s^2]: samples do not show a shock in full."""
SETTLED = 5.0  #: time after the start from which changes of the estimate count [s]
GRAVITY = 9.80665  #: [m/s^2]


class Change(NamedTuple):
    """Largest unexplained change of a quantity."""

    quantity: str  #: "position", "velocity", "tilt" or "heading"
    time: float  #: [s]
    size: float  #: [m], [m/s] or [rad]
    ratio: float  #: largest ratio of a component to its standard deviation


def changes(log: Log, result: Replay, settled: float) -> tuple[list[Change], int]:
    """Return the largest changes after a time, and the number of components that were compared.

    Changes within `SETTLED` after a pause do not count, as the filter starts again. The standard
    deviations of the propagation leave out correlations of the estimate's errors.
    """
    time = result.time
    rows = np.flatnonzero(time >= settled)
    if len(rows) < 3 or not np.isfinite(result.sigma[rows]).all():
        return [], 0
    first = rows[0]
    time, dt = time[first:], np.diff(time[first:])
    R = quaternion_to_dcm(result.quaternion[first:])
    r, v = result.position[first:], result.velocity[first:]
    gyro, accel = (increments(log, result, name)[first:] for name in ("gyro", "accel"))
    turns = gyro - result.gyro_bias[first:-1] * dt[:, np.newaxis]
    steps = accel - result.accel_bias[first:-1] * dt[:, np.newaxis]
    predicted = small_rotations(-turns) @ R[:-1]
    middle = 0.5 * (R[:-1] + predicted)
    gains = np.einsum("kji,kj->ki", middle, steps) - np.outer(dt, [0.0, 0.0, GRAVITY])
    V = np.vstack([np.zeros(3), np.cumsum(gains, axis=0)])
    S = np.cumsum((V[:-1] + 0.5 * gains) * dt[:, np.newaxis], axis=0)
    S = np.vstack([np.zeros(3), S])
    W = np.cumsum(np.einsum("kji,kj->ki", R[1:], _small_angles(R[1:], predicted)), axis=0)
    W = np.vstack([np.zeros(3), W])
    hardest = np.linalg.norm(accel, axis=1)  # parts may follow each other without time between
    np.divide(hardest, dt, out=hardest, where=dt > 0.0)
    # a pause shortly before the first row counts, too
    pauses = np.where(np.diff(result.time) > PAUSE, result.time[1:], -np.inf)
    began = np.maximum.accumulate(np.append(-np.inf, pauses))[first:]
    found: dict[str, Change] = {}
    count = 0
    for T in HORIZONS:
        i = np.searchsorted(time, np.arange(time[0], time[-1] - T, 0.25 * T))
        i = i[i < len(time) - 1]  # samples may be farther apart than T
        j = np.minimum(np.searchsorted(time, time[i] + T), len(time) - 1)
        span = (time[j] - time[i])[:, np.newaxis]
        calm = np.array([hardest[a : b + 1].max() for a, b in zip(i, j, strict=True)]) < IMPACT
        calm &= time[i] - began[j] >= SETTLED
        i, j, span = i[calm], j[calm], span[calm]
        far = v[j] - v[i] - (V[j] - V[i])
        moved = r[j] - r[i] - v[i] * span - (S[j] - S[i] - V[i] * span)
        turned = W[j] - W[i]
        sigma = _propagated(result, first + i, span)
        for quantity, values, errors in (
            ("position", moved, sigma[0]),
            ("velocity", far, sigma[1]),
            ("tilt", turned[:, :2], sigma[2][:, :2]),
            ("heading", turned[:, 2:], sigma[2][:, 2:]),
        ):
            count += values.size
            ratios = (np.abs(values) / errors).max(axis=1)
            if not len(ratios):
                continue
            k = int(np.argmax(ratios))
            if quantity not in found or ratios[k] > found[quantity].ratio:
                size = float(np.linalg.norm(values[k]))
                found[quantity] = Change(quantity, float(time[i[k]]), size, float(ratios[k]))
    return list(found.values()), count


def increments(log: Log, result: Replay, name: str) -> Floats:
    """Return integrals (n - 1, 3) of IMU samples between the rows of a replay."""
    stamps, values = log.imu.time, log.imu.values[name]
    steps = np.diff(stamps)[:, np.newaxis]
    held = values[1:] if result.sensors.imu.samples == "average" else values[:-1]
    total = np.vstack([np.zeros(3), np.cumsum(held * steps, axis=0)])
    at = np.column_stack([np.interp(result.time, stamps, axis) for axis in total.T])
    return np.diff(at, axis=0)


def small_rotations(turns: Floats) -> Floats:
    """Return matrices (n, 3, 3) of rotation vectors (n, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(turns, axis=1)[:, np.newaxis, np.newaxis]
    K = np.zeros((len(turns), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        K[:, j, i], K[:, i, j] = turns[:, k], -turns[:, k]
    safe = np.maximum(angle, 1e-9)
    return np.eye(3) + np.sin(angle) / safe * K + (1.0 - np.cos(angle)) / safe**2 * (K @ K)


def _small_angles(later: Floats, predicted: Floats) -> Floats:
    """Return rotation vectors (n, 3) in B from predicted to later attitudes, if they are small."""
    D = later @ predicted.swapaxes(1, 2)
    parts = (D[:, 1, 2] - D[:, 2, 1], D[:, 2, 0] - D[:, 0, 2], D[:, 0, 1] - D[:, 1, 0])
    return 0.5 * np.stack(parts, axis=1)


def _propagated(result: Replay, rows: Floats, span: Floats) -> tuple[Floats, Floats, Floats]:
    """Return standard deviations (k, 3) of position, velocity and attitude after a span (k, 1)."""
    imu = result.sensors.imu
    r, v, e, b_a, b_g = np.split(result.sigma[rows] ** 2, 5, axis=1)
    turn = e + span**2 * b_g + imu.gyro_noise**2 * imu.dt * span
    tilt = turn[:, :2].max(axis=1, keepdims=True)
    force = b_a.max(axis=1, keepdims=True) + GRAVITY**2 * tilt * [1.0, 1.0, 0.0]
    white = imu.accel_noise**2 * imu.dt * span
    position = r + span**2 * v + 0.25 * span**4 * force + white * span**2 / 3.0
    return np.sqrt(position), np.sqrt(v + span**2 * force + white), np.sqrt(turn)


# --------------------------------------------------------------------------------------------------
# Rules of the verdict on innovations: their size, correlation, and runs of rejections.
# --------------------------------------------------------------------------------------------------

RATIO = 2.0  #: ratio of true and assumed standard deviations with which a filter still works [-]
MAX_REJECTED = 0.1  #: share of the measurements of a sensor that the gate rejects [-]
LONG_RUN = 0.1  #: share of the measurements of a sensor that are rejected in one run [-]
MAX_MEAN = 25.0
"""Mean NIS per degree of freedom that no noise model explains: standard deviations five times as
large. Outliers that chance explains are left out of the mean."""
MAX_CORRELATED = 0.8  #: correlation of successive innovations of GNSS that noise does not have
PESSIMISTIC = 0.3
"""NIS per degree of freedom below which noise is assumed much too large: innovations of such a
filter are correlated, as it follows the measurements slowly."""
PATIENCE = 10.0  #: time for which GNSS may be rejected [s]


def misfits(case: Evidence) -> Iterator[Finding]:
    """Innovations that are larger, smaller or more correlated than the suite has them."""
    for name, fit in case.fits.items():
        m, quantity = case.sensors[name], OF_SENSOR.get(name, "position")
        yield from _size(case, name, m, fit)
        if name.startswith("gnss") and len(m.nis) >= MIN_COUNT:
            yield from _correlated(name, m, quantity)
    small = {name: fit for name, fit in case.fits.items() if fit.mean_nis < PESSIMISTIC}
    for name in small:
        if name in case.reports:
            yield note("position", f"{NAMES[name]}: {_smooth(name, case.sensors[name])}")
    if assumed := {n: _factor(fit) for n, fit in small.items() if n not in case.reports}:
        listed = ", ".join(f"{NAMES[n]} {factor:.2g}" for n, factor in assumed.items())
        yield note(
            "log",
            f"the suite's noise is pessimistic, by factors of about: {listed}; a calibration finds "
            "the noise from the log (quad-gym calibrate)",
        )


def _factor(fit: Fit) -> float:
    return 1.0 / math.sqrt(max(fit.mean_nis, 1e-6))


def _smooth(name: str, m: InnovationSeries) -> str:
    """Return a sentence on innovations that are smaller than a receiver's accuracy."""
    known = np.isfinite(m.nis) & ~m.gated
    size, sigma = (float(np.sqrt((v[known] ** 2).mean())) for v in (m.innovation, m.sigma))
    unit = "m/s" if name == "gnss_velocity" else "m"
    return (
        f"innovations are {size:.2g} {unit}, where {sigma:.2g} {unit} follow from the accuracy "
        "that the receiver reports: its errors change slowly, which innovations do not show"
    )


def _nis(name: str, fit: Fit) -> str:
    return f"{NAMES[name]}: NIS per degree of freedom {fit.mean_nis:.3g}, 1 expected"


def _size(case: Evidence, name: str, m: InnovationSeries, fit: Fit) -> Iterator[Finding]:
    """Innovations of a sensor that are too large, or rejected for long."""
    quantity = OF_SENSOR.get(name, "position")
    known = np.isfinite(m.nis)
    nis, d = m.nis[known], fit.freedoms
    others = any(other in case.fits for other in MEASURED_BY[quantity] if other != name)
    shared = quantity == "height" and others
    ratio = RATIO**2 if not shared else RATIO**4
    many = exceeds(m.rejected[known], MAX_REJECTED)
    heavy = larger(nis, d, RATIO) and fit.mean_nis > 2.0 * ratio  # in the median, and in the mean
    rows = known & (m.time > m.time[0] + SETTLED)
    runs = runs_beyond_chance(m.rejected[rows], FALSE_ALARM)
    longest = max(runs, key=lambda run: run[1] - run[0], default=None)
    share = 0.0 if longest is None else (longest[1] - longest[0] + 1) / len(nis)
    rejected = f"{100.0 * fit.rejected:.0f} % rejected"
    far = _mean_with_runs(m, known, rows, runs) > MAX_MEAN * d
    if larger(nis, d, ratio) or heavy or (not shared and (many or far)):
        text = f"{_nis(name, fit)}, {rejected}: the suite's noise model does not fit this log"
        yield lost(quantity, text)
    elif many or larger(nis, d, RATIO):
        factor = math.sqrt(max(fit.median_nis, 1.0))
        yield uncertain(
            quantity,
            f"{_nis(name, fit)}, {rejected}: errors {factor:.1f} times the suite's standard "
            "deviations",
        )
    if longest is None:
        return
    since, until = m.time[rows][list(longest)]
    text = f"{NAMES[name]} rejected for {until - since:.1f} s from {since:.1f} s on"
    long = quantity == "position" and until - since >= PATIENCE
    if not shared and (long or share > LONG_RUN):
        yield lost(quantity, f"{text}: it drifts or jumps, or others do")
    elif not many:
        yield uncertain(quantity, text)


def _mean_with_runs(
    m: InnovationSeries, known: np.ndarray, rows: np.ndarray, runs: list[tuple[int, int]]
) -> float:
    """Return the mean NIS without the rejections that chance explains."""
    counts = known & ~m.rejected
    settled = np.flatnonzero(rows)
    for begin, end in runs:
        counts[settled[begin : end + 1]] = True
    return float(m.nis[counts].mean()) if counts.any() else math.inf


def _correlated(name: str, m: InnovationSeries, quantity: str) -> Iterator[Finding]:
    """Innovations whose successive values are correlated, in the worst axis of each quantity."""
    scaled = (m.innovation / m.sigma)[np.isfinite(m.nis) & ~m.gated]
    scaled = scaled[len(scaled) // 5 :]
    if len(scaled) < MIN_COUNT:
        return
    rho, size = correlations(scaled), (scaled**2).mean(axis=0)
    parts = ((0, 1), "position"), ((2,), "height")
    for axes, part in parts if name == "gnss_position" else (((*range(len(rho)),), quantity),):
        worst = max(axes, key=lambda k: rho[k])
        # the lower end of the interval, by Fisher's transformation
        sure = math.tanh(math.atanh(min(rho[worst], 0.999)) - 3.0 / math.sqrt(len(scaled) - 3))
        if sure > MAX_CORRELATED and size[worst] > PESSIMISTIC:
            text = (
                f"{NAMES[name]}: autocorrelation of innovations {rho[worst]:.2f} (expected 0): "
                "check the suite's time stamps and noise"
            )
            severity = Severity.UNCERTAIN if part == "height" else Severity.LOST
            yield Finding(quantity=part, severity=severity, text=text)


# --------------------------------------------------------------------------------------------------
# Rules of the verdict on times: clocks, times without a correction, and the end of the log.
# --------------------------------------------------------------------------------------------------

LATE = 0.5  #: share of late measurements above which the clocks do not agree [-]
MANY_LOST = 0.05  #: share of lost samples of the IMU that is worth a note [-]
SHORT_PAUSE = 0.3  #: time without samples of the IMU in which a vehicle turns by some degrees [s]
BLOCK = 20  #: measurements in a row that are late together, so that a clock has changed
APART = 0.15  #: time by which clocks that run apart differ more at the end of a log [s]
LAGS = np.arange(-1.5, 1.501, 0.03)  #: differences of the clocks of IMU and GNSS that are tried [s]
WINDOW, CHANGE = 10.0, 0.9
"""Times over which a difference of clocks is sought, and over which velocities change [s]."""
FITS, CLEAR, SCATTER = 0.6, 2.0, 0.1
"""Share of the squared changes of velocity that a lag leaves unexplained, at most; how many times
more another lag leaves; and scatter of the lags about a line, at most [s]."""
WINDOWS = 4  #: lags that show a line


def late(case: Evidence) -> Iterator[Finding]:
    """Measurements that are older than the window at their arrival."""
    for sensor, ages in case.result.late.items():
        stream = case.log.streams[sensor]
        count, name = len(stream), sensor.replace("gnss", "GNSS").replace("_", " ")
        share = len(ages) / count
        low, middle, high = np.percentile(ages, [5.0, 50.0, 95.0])
        text = f"{len(ages)} of {count} measurements of {name} arrive too late for the window"
        since, length = _late_block(stream.received - stream.time, float(ages.min()))
        stepped = length > max(BLOCK, LONG_RUN * count) and 0 < since < count - length + 1
        if high - low < 0.2 * middle and stepped:
            text += (
                f", all from {stream.received[since]:.1f} s on, by about {middle:.2f} s: the time "
                "stamps step back there, as with a leap second or a clock that is set; use "
                f"--until {stream.received[since]:.1f}, or correct the stamps"
            )
        elif high - low < 0.2 * middle:
            text += (
                f", all by about {middle:.2f} s: the clocks differ, use log_delays.{sensor} = "
                f"{-middle:.2f} in the suite, or a longer window"
            )
        quantity = OF_SENSOR.get(sensor, "position")
        if share > LATE or stepped:
            yield lost(quantity, text)
        elif exceeds(np.arange(count) < len(ages), MAX_REJECTED):
            yield uncertain(quantity, text)


def _late_block(ages: Floats, least: float) -> tuple[int, int]:
    """Return begin and length of the longest run of ages that are at least `least`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ages >= least - 1e-9, [0]])))
    if not len(edges):
        return 0, 0
    k = int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[2 * k]), int(edges[2 * k + 1] - edges[2 * k])


def clocks(case: Evidence) -> Iterator[Finding]:
    """Clocks of IMU and GNSS that run apart.

    In each window, the changes of the GNSS velocity are compared with those by the specific forces
    of the IMU, for many differences of the two clocks. That which explains them best changes with
    time if one clock is faster.
    """
    found = _clock_lags(case)
    if len(found) < WINDOWS or np.ptp(found[:, 0]) < 2.0 * WINDOW:
        return
    time, lag = found.T
    slope, first = np.polyfit(time, lag, 1)
    scatter = float(np.std(lag - first - slope * time))
    span = float(np.ptp(time))
    doubt = scatter / (float(np.std(time)) * math.sqrt(len(time)))
    if abs(slope) * span < APART or scatter > SCATTER or abs(slope) < CERTAIN * doubt:
        return
    begin, end = (first + slope * t for t in time[[0, -1]])
    yield lost(
        "log",
        f"the clocks of IMU and GNSS run apart by {100.0 * abs(slope):.2g} %: velocities of GNSS "
        f"fit samples of the IMU stamped {begin:+.2f} s from theirs at {time[0]:.0f} s, and "
        f"{end:+.2f} s at {time[-1]:.0f} s. Put both on one clock: multiply the stamps of the IMU "
        f"by {1.0 / (1.0 + slope):.4f}",
    )


def _clock_lags(case: Evidence) -> Floats:
    """Return middles of windows, and differences of the stamps of IMU and GNSS, (n, 2) [s]."""
    log, result, none = case.log, case.result, np.empty((0, 2))
    gnss = log.gnss
    if gnss is None or result.sensors.gnss is None or len(result) < BLOCK:
        return none
    velocity = gnss.values.get("gnss_velocity_I")
    if velocity is None and "gnss_velocity_G" in gnss.values:
        origin = np.array(result.sensors.gnss.reference_antenna_G)
        velocity = gnss.values["gnss_velocity_G"] @ ecef_to_enu(origin).T
    if velocity is None:
        return none
    rows = np.flatnonzero(np.isfinite(velocity).all(axis=1))
    rows = rows[np.argsort(gnss.time[rows], kind="stable")]
    stamps, velocity = gnss.time[rows], velocity[rows]
    later = np.searchsorted(stamps, stamps + CHANGE)
    first = np.flatnonzero(later < len(stamps))
    later = later[first]
    reach = float(LAGS[-1])
    inside = (stamps[first] - reach > result.time[0]) & (stamps[later] + reach < result.time[-1])
    inside &= stamps[later] - stamps[first] < 2.0 * CHANGE
    first, later = first[inside], later[inside]
    changed = velocity[later] - velocity[first]
    dt = np.diff(result.time)[:, np.newaxis]
    R = quaternion_to_dcm(result.quaternion)
    steps = increments(log, result, "accel") - result.accel_bias[:-1] * dt
    gains = np.einsum("kji,kj->ki", 0.5 * (R[:-1] + R[1:]), steps) - dt * [0.0, 0.0, GRAVITY]
    total = np.vstack([np.zeros(3), np.cumsum(gains, axis=0)])

    def between(begin: Floats, end: Floats) -> Floats:
        parts = [np.interp(end, result.time, v) - np.interp(begin, result.time, v) for v in total.T]
        return np.column_stack(parts)

    predicted = np.array([between(stamps[first] + L, stamps[later] + L) for L in LAGS])
    middle = 0.5 * (stamps[first] + stamps[later])
    found = []
    for begin in np.arange(result.time[0] + SETTLED, result.time[-1] - WINDOW, 0.5 * WINDOW):
        rows = np.flatnonzero((middle >= begin) & (middle < begin + WINDOW))
        if len(rows) < BLOCK:
            continue
        told = changed[rows] - changed[rows].mean(axis=0)
        rest = told - predicted[:, rows] + predicted[:, rows].mean(axis=1, keepdims=True)
        left = (rest**2).sum(axis=(1, 2))
        best = int(np.argmin(left))
        if 0 < best < len(LAGS) - 1 and left[best] < min(
            FITS * float((told**2).sum()), float(left.max()) / CLEAR
        ):
            found.append((begin + 0.5 * WINDOW, LAGS[best]))
    return np.array(found).reshape(-1, 2)


def gaps(case: Evidence) -> Iterator[Finding]:
    """Times without a measurement that corrects position or height, over all parts of a log.

    A pause of the IMU is no flown time, and no correction: without GNSS, a part begins where the
    part before has ended.
    """
    result, sensors = case.result, case.sensors
    steps = np.diff(result.time)
    flown = np.concatenate([[0.0], np.cumsum(np.where(steps > PAUSE, 0.0, steps))])
    for quantity in ("position", "height"):
        some = [sensors[name] for name in MEASURED_BY[quantity] if name in sensors]
        times = np.concatenate([np.empty(0), *(m.time[~m.gated] for m in some)])
        edges = np.sort(np.concatenate([result.time[[0, -1]], times]))
        lengths = np.diff(np.interp(edges, result.time, flown))
        k = int(np.argmax(lengths))
        since, until, length = float(edges[k]), float(edges[k + 1]), float(lengths[k])
        if length < PATIENCE and len(times):
            continue
        text = f"nothing corrects it for {length:.0f} s"
        inside = [n for n in MEASURED_BY[quantity] if _refused(sensors, n, since, until)]
        if inside:
            text = f"{NAMES[inside[0]]} rejected for {length:.0f} s"
        axes = slice(0, 2) if quantity == "position" else slice(2, 3)
        during = (result.time >= since) & (result.time <= until)
        sigma = float(np.linalg.norm(result.sigma[during, axes], axis=1).max())
        known = "" if math.isnan(sigma) else f", standard deviation up to {sigma:.3g} m"
        where = f" from {since:.1f} s on" if len(times) else ", the whole log"
        yield lost(quantity, f"{text}{where}: dead reckoning{known}")
        if quantity == "position":
            return  # which the height shares


def _refused(
    sensors: Mapping[str, InnovationSeries], name: str, since: float, until: float
) -> bool:
    """Return True if a sensor was rejected between two times."""
    m = sensors.get(name)
    return m is not None and bool((m.gated & (m.time > since) & (m.time < until)).any())


def lost_samples(case: Evidence) -> Iterator[Finding]:
    """Samples of the IMU that the log lacks."""
    steps = np.diff(case.log.imu.time)
    steps = steps[steps <= PAUSE]
    if len(steps) < BLOCK:
        return
    usual = float(np.quantile(steps, 0.2))
    missing = float(np.maximum(np.round(steps / usual) - 1.0, 0.0)[steps > 1.5 * usual].sum())
    share = missing / (missing + len(steps))
    most = float(steps.max())
    count = int((steps > max(SHORT_PAUSE, 10.0 * usual)).sum())
    if count:
        yield uncertain(
            "attitude",
            f"the IMU has {count} {'pause' if count == 1 else 'pauses'} of up to {most:.2f} s, in "
            "which the attitude is extrapolated",
        )
    elif share > MANY_LOST:
        yield note(
            "attitude",
            f"the log lacks about {100.0 * share:.0f} % of the IMU's samples, for up to "
            f"{most:.3f} s: of averaged samples nothing is lost, of others motion is",
        )


def flagged(case: Evidence) -> Iterator[Finding]:
    """A filter that is flagged as diverged at the end, of the log or of a part before a pause."""
    result = case.result
    ends = [*np.flatnonzero(np.diff(result.time) > PAUSE).tolist(), len(result) - 1]
    for row in ends:
        if not np.asarray(result.diverged)[row]:
            continue
        time = float(result.time[row])
        names = [name for name, m in case.sensors.items() if _ends_refused(m, time)]
        if not names:
            continue  # accepted since
        refused = " and ".join(NAMES[name] for name in names)
        quantities = [OF_SENSOR.get(name, "position") for name in names]
        quantity = "position" if "position" in quantities else quantities[0]
        where = "at the end" if row == ends[-1] else f"at {time:.1f} s, before a pause"
        yield lost(quantity, f"the filter is flagged as diverged {where}, as it rejects {refused}")
        return


def _ends_refused(m: InnovationSeries, time: float) -> Any:
    """Return True if the last two measurements before a time were rejected."""
    last = m.rejected[m.time <= time][-2:]
    return len(last) == 2 and last.all()


# --------------------------------------------------------------------------------------------------
# Rules of the verdict on the motion: what the IMU does not explain, biases, and headings.
# --------------------------------------------------------------------------------------------------

SUDDEN = 4.0
"""Ratio of true and assumed standard deviations of dead reckoning over seconds [-]: measurements
correct a filter more often, so that noise of the IMU matters less."""
SMALL = {"attitude": math.radians(1.0), "heading": math.radians(2.0)}
"""Changes of the attitude that do not matter [rad]: mounting is no more accurate."""
MAX_BIAS = {"accel": 2.0, "gyro": 0.2}
"""Biases that no sensor has [m/s^2], [rad/s]: data sheets of cheap parts admit 0.5 m/s^2 and 0.09
rad/s (TDK ICM-20948)."""
WRONG = math.radians(20.0)  #: error of a heading at the start that matters [rad]
CERTAIN = 4.0  #: standard deviations beyond which such an error is no chance
TILTED = math.radians(10.0)  #: error of roll and pitch at the start that matters [rad]
OFFSET, FIRST_ONES = 1.0, 3
"""Error of a given position or velocity that matters [m], [m/s]; measurements that show it."""
BEYOND = 4.0  #: ratio of a bias and its standard deviation in the suite that is worth a note [-]
RESET = 15.0
"""The same ratio, beyond which a filter that was flagged as diverged before it estimated the bias
has been wrong until then [-]: measurements correct a consistent one by a few."""


def unexplained(case: Evidence) -> Iterator[Finding]:
    """Changes of the estimate that the IMU does not explain."""
    from scipy.stats import norm

    result = case.result
    known = result.time[np.asarray(result.heading_known, bool)]
    if not len(known):
        return
    found, count = changes(case.log, result, float(known[0]) + SETTLED)
    if not found:
        return
    limit = SUDDEN * float(norm.isf(0.5 * FALSE_ALARM / count))
    worst: dict[str, Change] = {}
    for each in found:
        quantity = {"tilt": "attitude", "velocity": "position"}.get(each.quantity, each.quantity)
        least = SMALL.get(quantity, 0.0)
        if each.size > least and each.ratio > max(
            limit, getattr(worst.get(quantity), "ratio", 0.0)
        ):
            worst[quantity] = each
    for quantity, each in worst.items():
        size = f"{each.size:.3g} m"
        if each.quantity == "velocity":
            size = f"{each.size:.3g} m/s of velocity"
        elif quantity != "position":
            size = f"{math.degrees(each.size):.3g} degrees"
        yield lost(
            quantity,
            f"the estimate changes by {size} at about {each.time:.1f} s, {each.ratio:.0f} standard "
            "deviations, which the IMU does not explain: the filter was wrong before, or follows "
            "wrong measurements",
        )


class _FirstPart(NamedTuple):
    """Rows of a replay until the first pause."""

    time: Floats  #: (n,) time since the start [s]
    R_BI: Floats  #: (n, 3, 3) attitudes
    turns: Floats  #: (n - 1, 3) turns by the gyro between the rows [rad]
    white: Floats  #: (n,) variance of their sum by the gyro's noise [rad^2]
    sigma: Floats  #: (n, 15) standard deviations of the estimates


def _first_part(case: Evidence) -> _FirstPart | None:
    """Return the first part of a replay; None: it is too short, or its uncertainty is unknown."""
    result = case.result
    pause = np.flatnonzero(np.diff(result.time) > PAUSE)
    count = int(pause[0]) + 1 if len(pause) else len(result)
    time, sigma = result.time[:count], result.sigma[:count]
    if count < 3 or time[-1] - time[0] < SETTLED or not np.isfinite(sigma).all():
        return None
    T = time - time[0]
    turns = increments(case.log, result, "gyro")[: count - 1]
    white = result.sensors.imu.gyro_noise_density**2 * T
    return _FirstPart(T, quaternion_to_dcm(result.quaternion[:count]), turns, white, sigma)


def _turned_back(case: Evidence, part: _FirstPart, k: int) -> Floats:
    """Return the attitude (3, 3) at the start from row k, by the gyro with the bias of then."""
    steps = np.diff(part.time[: k + 1])[:, np.newaxis]
    turns = part.turns[:k] - case.result.gyro_bias[k] * steps
    back = part.R_BI[k]
    for step in small_rotations(turns[::-1]):
        back = step @ back
    return np.asarray(back)


def given_heading(case: Evidence) -> Iterator[Finding]:
    """A given heading that the flight contradicts: a cause of large innovations."""
    if "heading" in case.start:
        yield from _heading_at_start(case)


def first_heading(case: Evidence) -> Iterator[Finding]:
    """A measured heading at the start that the flight contradicts."""
    if "heading" not in case.start:
        yield from _heading_at_start(case)


def _heading_at_start(case: Evidence) -> Iterator[Finding]:
    """A heading at the start that the flight contradicts.

    The gyro, with the bias of a later estimate, turns that estimate back to the start. The heading
    there has the error of the estimate, and of the turn.
    """
    part = _first_part(case)
    if part is None or not case.result.heading_known[0]:
        return
    sigma, last = part.sigma, len(part.time) - 1
    # an estimate that was thrown by a wrong start has recovered at the end
    spread = math.sqrt(
        sigma[last, 8] ** 2 + (part.time[last] * sigma[last, 14]) ** 2 + part.white[last]
    )
    if spread > WRONG:
        return
    both = part.R_BI[0], _turned_back(case, part, last)
    headings = [math.atan2(R[0, 1], R[0, 0]) for R in both]
    off = math.remainder(headings[0] - headings[1], 2.0 * math.pi)
    if abs(off) < max(WRONG, CERTAIN * math.hypot(spread, float(sigma[0, 8]))):
        return
    text = f"the heading at the start is off by about {math.degrees(abs(off)):.0f} degrees"
    given = case.start.get("heading")
    if given is not None:
        text = (
            f"the given heading at the start (--heading {math.degrees(given):.0f}) is off by about "
            f"{math.degrees(abs(off)):.0f} degrees, as the motion shows"
        )
        other = math.remainder(0.5 * math.pi - given - headings[1], 2.0 * math.pi)
        if abs(other) < WRONG:
            text += ": it counts from east toward north, not from north (--heading-from-north)"
    yield lost("heading", text)


def first_tilt(case: Evidence) -> Iterator[Finding]:
    """Roll and pitch at the start that the flight contradicts, in the same way."""
    part = _first_part(case)
    if part is None:
        return
    tilt, drift = part.sigma[:, 6:8].max(axis=1), part.sigma[:, 12:14].max(axis=1)
    spread = np.sqrt(tilt**2 + (part.time * drift) ** 2 + part.white)
    later = np.flatnonzero(part.time >= SETTLED)
    k = int(later[np.argmin(spread[later])])
    back = _turned_back(case, part, k)
    off = 2.0 * math.asin(0.5 * float(np.linalg.norm(part.R_BI[0][:, 2] - back[:, 2])))
    if off > max(TILTED, CERTAIN * math.hypot(spread[k], float(tilt[0]))):
        yield uncertain(
            "attitude",
            f"roll and pitch at the start are off by about {math.degrees(off):.0f} degrees: the "
            "vehicle stood on a slope or moved; give the specific force of a slope (accel), or "
            "begin at rest (--from)",
        )


def first_place(case: Evidence) -> Iterator[Finding]:
    """A given position or velocity at the start that the first measurements contradict."""
    if "position" not in case.start:
        return
    for name, quantity, unit in (
        ("gnss_position", "position", "m"),
        ("gnss_velocity", "velocity", "m/s"),
    ):
        m = case.sensors.get(name)
        if m is None or len(m.time) < FIRST_ONES or m.innovation.shape[1] != 3:
            continue
        off = np.median(m.innovation[:FIRST_ONES], axis=0)
        sigma = np.median(m.sigma[:FIRST_ONES], axis=0)
        size = float(np.linalg.norm(off))
        if size < OFFSET or not (np.abs(off) > CERTAIN * sigma).any():
            continue
        which = "given position" if quantity == "position" else "velocity"
        text = f"the {which} at the start contradicts the first measurements of GNSS by about"
        remedy = "leave it out (--start-position): GNSS then shows the start"
        if quantity == "velocity":
            remedy = "the vehicle is not at rest: begin at rest (--from), or give its velocity"
        yield lost("position", f"{text} {size:.3g} {unit}: {remedy}")


def unknown_heading(case: Evidence) -> Iterator[Finding]:
    """A heading that no sensor and no motion shows until the end."""
    if not case.result.heading_known[-1]:
        yield uncertain(
            "heading",
            "unknown until the end: no sensor measures it, and the motion does not show it; "
            "give a heading or the course (--heading, --course)",
        )


def biases(case: Evidence) -> Iterator[Finding]:
    """Biases of the IMU that the suite, or any sensor, does not admit."""
    result, suite = case.result, case.suite
    for name, unit in (("accel", "m/s^2"), ("gyro", "rad/s")):
        found = np.sqrt((getattr(result, f"{name}_bias") ** 2).mean(axis=0)).max()
        sigma = getattr(suite.imu, f"{name}_bias_sigma")
        text = (
            f"{'accelerometer' if name == 'accel' else 'gyro'}: estimated bias {found:.2g} {unit}"
        )
        if not found <= max(MAX_BIAS[name], BEYOND * sigma):
            yield lost(
                "attitude",
                f"{text}, which no sensor has: check the suite's magnetic field, time stamps, "
                "mounting and noise",
            )
        elif found > BEYOND * sigma:
            text = f"{text}, {sigma:.2g} expected by the suite"
            size = np.linalg.norm(getattr(result, f"{name}_bias"), axis=1)
            since = int(np.argmax(size > 0.5 * found))
            if found > RESET * sigma and np.asarray(result.diverged)[: since + 1].any():
                yield lost(
                    "attitude",
                    f"{text}, found by a reset at about {result.time[since]:.1f} s: the filter was "
                    "wrong before",
                )
            else:
                yield note("attitude", text)
