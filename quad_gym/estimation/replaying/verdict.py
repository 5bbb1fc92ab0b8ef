"""The verdict on a replay: findings by quantity, from all innovations, rejected ones included.

A finding is LOST if the estimate of its quantity cannot be used, or the suite does not describe
the sensors that measure it; UNCERTAIN if errors are larger than the suite has them; or a NOTE.
Limits are sizes that matter (`RATIO`, `MAX_REJECTED`, `PATIENCE`); a
test counts as many independent innovations as their autocorrelation leaves.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quad_gym.estimation.logs import Floats, Log
from quad_gym.estimation.logs.clocks import PAUSE
from quad_gym.estimation.logs.parts import running_motors
from quad_gym.estimation.replaying.dead_reckoning import SETTLED, Change, changes
from quad_gym.estimation.replaying.findings import Finding, Severity
from quad_gym.estimation.replaying.fits import MIN_COUNT, Fit, correlations, exceeds, fit_of, larger
from quad_gym.estimation.replaying.plausibility import implausible, nothing_in_common
from quad_gym.estimation.replaying.results import Measured, Replay, by_sensor
from quad_gym.params.aid_table import AID_PARAMS
from quad_gym.params.sensors import SensorSuite

FALSE_ALARM = 1e-3  #: probability of a chance event that counts as a finding
RATIO = 2.0  #: ratio of true and assumed standard deviations with which a filter still works [-]
MAX_REJECTED = 0.1  #: share of the measurements of a sensor that the gate rejects [-]
PATIENCE = 10.0  #: time without a measurement after which the estimate is dead reckoning [s]
MAX_CORRELATED = 0.8  #: correlation of successive innovations of GNSS that noise does not have
PESSIMISTIC = 0.3
"""NIS per degree of freedom below which noise is assumed much too large: innovations of such a
filter are correlated, as it follows the measurements slowly."""
SUDDEN = 4.0
"""Ratio of true and assumed standard deviations of dead reckoning over seconds [-]: measurements
correct a filter more often, so that noise of the IMU matters less."""
SMALL = {"attitude": math.radians(1.0), "heading": math.radians(2.0)}
"""Changes of the attitude that do not matter [rad]: mounting is no more accurate."""
LATE = 0.5  #: share of late measurements above which the clocks do not agree [-]
MAX_BIAS = {"accel": 2.0, "gyro": 0.2}
"""Biases that no sensor has [m/s^2], [rad/s]: data sheets of cheap parts admit 0.5 m/s^2 and 0.09
rad/s (TDK ICM-20948)."""
BEYOND = 4.0  #: ratio of a bias and its standard deviation in the suite that is worth a note [-]

NAMES = {
    "gnss_position": "GNSS position",
    "gnss_baseline": "GNSS baseline",
    "gnss_velocity": "GNSS velocity",
    "features": "camera features",
    **{name: name.replace("_", " ") for name in AID_PARAMS},
}
"""Sensors in sentences."""


def _observing(*states: str) -> tuple[str, ...]:
    return tuple(name for name, kind in AID_PARAMS.items() if {*states} & {*kind.observes})


MEASURED_BY = {
    "position": ("gnss_position", "gnss_velocity", "features", *_observing("position", "velocity")),
    "height": ("gnss_position", "gnss_velocity", "features", *_observing("height")),
    "heading": ("gnss_baseline", "features", *_observing("heading")),
}
"""Sensors that correct a quantity."""
OF_SENSOR = {"gnss_baseline": "heading"} | {
    name: kind.observes[0]
    for name, kind in AID_PARAMS.items()
    if kind.observes in (("height",), ("heading",))
}
"""Quantities of sensors; the position for others."""


def with_verdict(log: Log, body: str, suite: SensorSuite, result: Replay) -> Replay:
    """Return a replay with its findings, the worst first, and the verdict in a line.

    If the log has commands of the motors, it ends for the verdict where they stop for good.
    """
    whole, result = result, _until_landing(log, result)
    found = [
        Finding(quantity="log", severity=Severity.LOST, text=text)
        for text in (*log.problems, *implausible(log, body))
    ]
    if result.status:
        found.append(_lost("attitude", f"the filter failed in some cycles ({result.status.name})"))
    if not result.measured and result.unused:
        found.append(_lost("position", nothing_in_common(result.unused)))
    sensors = by_sensor(result.measured)
    found += [*_late(log, result), *_gaps(result, sensors)]
    fits = {name: fit for name, m in sensors.items() if (fit := fit_of(m))}
    for name, fit in fits.items():
        found += _misfit(name, sensors[name], fit, fits)
    found += [*_changes(log, result), *_biases(result, suite), *_unknown_heading(result)]
    found.sort(key=lambda finding: -finding.severity)
    return replace(whole, findings=tuple(found), verdict=in_one_line(found, fits))


def _until_landing(log: Log, result: Replay) -> Replay:
    """Return the rows and measurements of a replay until the motors stop."""
    running = running_motors(log)
    if running is None or not running.any():
        return result
    assert log.motors is not None
    landing = float(log.motors.time[np.flatnonzero(running)[-1]])
    rows = result.time <= landing
    if rows.all() or rows.sum() < 2:
        return result
    cut: dict[str, Any] = {
        name: value[rows]
        for name, value in vars(result).items()
        if isinstance(value, np.ndarray) and len(value) == len(rows)
    }
    measured = {
        name: Measured(*(value[m.time <= landing] for value in vars(m).values()))
        for name, m in result.measured.items()
    }
    return replace(result, **cut, measured=measured)


def _lost(quantity: str, text: str) -> Finding:
    return Finding(quantity=quantity, severity=Severity.LOST, text=text)


def _late(log: Log, result: Replay) -> Iterator[Finding]:
    """Measurements that are older than the window at their arrival."""
    for sensor, ages in result.late.items():
        count, name = len(log.streams[sensor]), sensor.replace("gnss", "GNSS").replace("_", " ")
        share = len(ages) / count
        low, middle, high = np.percentile(ages, [5.0, 50.0, 95.0])
        text = f"{len(ages)} of {count} measurements of {name} arrive too late for the window"
        if high - low < 0.2 * middle:
            text += (
                f", all by about {middle:.2f} s: the clocks differ, use log_delays.{sensor} = "
                f"{-middle:.2f} in the suite, or a longer window"
            )
        quantity = OF_SENSOR.get(sensor, "position")
        severity = Severity.LOST if share > LATE else Severity.UNCERTAIN
        if share > LATE or exceeds(np.arange(count) < len(ages), MAX_REJECTED):
            yield Finding(quantity=quantity, severity=severity, text=text)


def _gaps(result: Replay, sensors: Mapping[str, Measured]) -> Iterator[Finding]:
    """Times without a measurement that corrects position or height."""
    pauses = np.flatnonzero(np.diff(result.time) > PAUSE)
    ends = np.concatenate([result.time[[0, -1]], result.time[pauses], result.time[pauses + 1]])
    for quantity in ("position", "height"):
        some = [sensors[name] for name in MEASURED_BY[quantity] if name in sensors]
        times = [m.time[~m.gated] for m in some]
        edges = np.sort(np.concatenate([ends, *times]))
        steps = np.where(np.isin(edges[:-1], result.time[pauses]), 0.0, np.diff(edges))
        k = int(np.argmax(steps))
        since, length = float(edges[k]), float(edges[k + 1] - edges[k])
        if length < PATIENCE:
            continue
        inside = [
            n for n in MEASURED_BY[quantity] if n in sensors and _within(sensors[n], edges, k)
        ]
        text = f"nothing corrects it for {length:.0f} s"
        if inside:
            text = f"{NAMES[inside[0]]} refused for {length:.0f} s in a row"
        axes = slice(0, 2) if quantity == "position" else slice(2, 3)
        during = (result.time >= since) & (result.time <= since + length)
        sigma = float(np.linalg.norm(result.sigma[during, axes], axis=1).max())
        known = "" if math.isnan(sigma) else f", standard deviation up to {sigma:.3g} m"
        yield _lost(quantity, f"{text} from {since:.1f} s on: dead reckoning{known}")
        if quantity == "position":
            return  # which the height shares


def _within(m: Measured, edges: Floats, k: int) -> bool:
    return bool((m.gated & (m.time > edges[k]) & (m.time < edges[k + 1])).any())


def _misfit(name: str, m: Measured, fit: Fit, fits: Mapping[str, Fit]) -> Iterator[Finding]:
    """Innovations that are larger, smaller or more correlated than the suite has them."""
    quantity = OF_SENSOR.get(name, "position")
    known = np.isfinite(m.nis)
    nis, d = m.nis[known], fit.freedoms
    others = any(other in fits for other in MEASURED_BY[quantity] if other != name)
    shared = quantity == "height" and others
    says = f"{NAMES[name]}: NIS per degree of freedom {fit.mean_nis:.3g}, 1 expected"
    ratio = RATIO**2 if not shared else RATIO**4
    many = exceeds(m.rejected[known], MAX_REJECTED)
    heavy = larger(nis, d, RATIO) and fit.mean_nis > 2.0 * ratio  # in the median, and in the mean
    if larger(nis, d, ratio) or heavy or (many and not shared):
        share = _percent(fit.rejected)
        text = f"{says}, {share} rejected: the suite's noise model does not fit this log"
        yield _lost(quantity, text)
    elif many or larger(nis, d, RATIO):
        factor = math.sqrt(max(fit.median_nis, 1.0))
        yield Finding(
            quantity=quantity,
            severity=Severity.UNCERTAIN,
            text=f"{says}, {_percent(fit.rejected)} rejected: errors about {factor:.1f} times as "
            "large as the suite has them",
        )
    elif (run := _longest_run(m, known & (m.time > m.time[0] + SETTLED))) is not None:
        since, length = run
        text = f"{NAMES[name]} refused for {length:.1f} s in a row from {since:.1f} s on"
        severity = Severity.UNCERTAIN
        if quantity == "position" and length >= PATIENCE:
            severity, text = Severity.LOST, f"{text}: it drifts or jumps, or others do"
        yield Finding(quantity=quantity, severity=severity, text=text)
    if name.startswith("gnss") and len(nis) >= MIN_COUNT:
        yield from _correlated(name, m, quantity)
    if fit.mean_nis < PESSIMISTIC:
        factor = 1.0 / math.sqrt(max(fit.mean_nis, 1e-6))
        yield Finding(
            quantity=quantity,
            severity=Severity.NOTE,
            text=f"{says}: pessimistic, noise is assumed about {factor:.1f} times too large",
        )


def _correlated(name: str, m: Measured, quantity: str) -> Iterator[Finding]:
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
                f"{NAMES[name]}: successive innovations have a correlation of {rho[worst]:.2f}, 0 "
                "expected: check the suite's time stamps and noise"
            )
            severity = Severity.UNCERTAIN if part == "height" else Severity.LOST
            yield Finding(quantity=part, severity=severity, text=text)


def _longest_run(m: Measured, rows: Any) -> tuple[float, float] | None:
    """Return begin and length [s] of a run of rejections that chance does not explain."""
    rejected, times = m.rejected[rows], m.time[rows]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rejected.astype(int), [0]])))
    if not len(edges):
        return None
    lengths = edges[1::2] - edges[::2]
    k = int(np.argmax(lengths))
    begin, end = edges[2 * k], edges[2 * k + 1] - 1
    # of independent outliers that are as frequent as the rejections
    share = max(float(rejected.mean()), 0.01)
    if len(times) * share ** int(lengths[k]) > FALSE_ALARM:
        return None
    return float(times[begin]), float(times[end] - times[begin])


def _changes(log: Log, result: Replay) -> Iterator[Finding]:
    """Changes of the estimate that the IMU does not explain."""
    from scipy.stats import norm

    known = result.time[np.asarray(result.heading_known, bool)]
    if not len(known):
        return
    found, count = changes(log, result, float(known[0]) + SETTLED)
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
        yield _lost(
            quantity,
            f"the estimate changes by {size} at about {each.time:.1f} s, {each.ratio:.0f} standard "
            "deviations, which the IMU does not explain: the filter was wrong before, or follows "
            "wrong measurements",
        )


def _unknown_heading(result: Replay) -> Iterator[Finding]:
    """A heading that no sensor and no motion shows until the end."""
    if not result.heading_known[-1]:
        yield Finding(
            quantity="heading",
            severity=Severity.UNCERTAIN,
            text="unknown until the end: no sensor measures it, and the motion does not show it; "
            "give a heading or the course (--heading, --course)",
        )


def _biases(result: Replay, suite: SensorSuite) -> Iterator[Finding]:
    """Biases of the IMU that the suite, or any sensor, does not admit."""
    for name, unit in (("accel", "m/s^2"), ("gyro", "rad/s")):
        found = np.sqrt((getattr(result, f"{name}_bias") ** 2).mean(axis=0)).max()
        sigma = getattr(suite.imu, f"{name}_bias_sigma")
        text = (
            f"{'accelerometer' if name == 'accel' else 'gyro'}: estimated bias {found:.2g} {unit}"
        )
        if not found <= max(MAX_BIAS[name], BEYOND * sigma):
            yield _lost(
                "attitude",
                f"{text}, which no sensor has: check the suite's magnetic field, time stamps, "
                "mounting and noise",
            )
        elif found > BEYOND * sigma:
            yield Finding(
                quantity="attitude",
                severity=Severity.NOTE,
                text=f"{text}, {sigma:.2g} expected by the suite",
            )


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def in_one_line(findings: Sequence[Finding], fits: Mapping[str, Fit]) -> str:
    """Return the verdict in a line: usable or not, and NIS per degree of freedom."""
    if problems := [f for f in findings if f.severity == Severity.LOST]:
        return f"not usable, because {problems[0]}"
    if not fits:
        return "usable as far as known: no innovations"
    values = {name: fit.mean_nis for name, fit in fits.items()}
    low, high = min(values.values()), max(values.values())
    span = f"{low:.2g} to {high:.2g}" if len(values) > 1 else f"{low:.2g}"
    text = f"usable: NIS per degree of freedom {span}"
    for word, name, value in (
        ("pessimistic", min(values, key=values.__getitem__), 1.0 / max(low, 1e-6)),
        ("optimistic", max(values, key=values.__getitem__), high),
    ):
        if value > RATIO:
            text += f", {word} in {NAMES[name]} by a factor of {math.sqrt(value):.1f}"
    return text
