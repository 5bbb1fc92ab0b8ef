"""The verdict on a replay: findings by quantity, from all innovations, rejected ones included.

A finding is LOST if the estimate of its quantity cannot be used, or the suite does not describe
the sensors that measure it; UNCERTAIN if errors are larger than the suite has them; or a NOTE.
`RULES` lists the rules; their limits are sizes that matter, next to their sentences in
`rules.py`. A test counts as many independent
innovations as their autocorrelation leaves.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quad_gym.logs.formats import Log
from quad_gym.logs.formats.clocks import running_motors
from quad_gym.logs.replaying import heading_rules, rules
from quad_gym.logs.replaying.measurements import implausible, nothing_in_common
from quad_gym.logs.replaying.results import (
    QUANTITIES,
    Finding,
    Fit,
    InnovationSeries,
    Replay,
    Severity,
    by_sensor,
    fit_of,
    rejected_for_their_size,
)
from quad_gym.logs.replaying.rules import NAMES, Evidence, lost
from quad_gym.params.suites import SensorSuite


class Rule(NamedTuple):
    """A rule of the verdict."""

    find: Callable[[Evidence], Iterator[Finding]]  #: yields its findings
    lost: str  #: what makes a quantity unusable
    uncertain: str = ""  #: what makes it uncertain


def _units(case: Evidence) -> Iterator[Finding]:
    """Wrong quantities that the reader has found, units and axes."""
    for text in (*case.log.problems, *implausible(case.log, case.body)):
        yield lost("log", text)


def _failures(case: Evidence) -> Iterator[Finding]:
    """Numerical failures, and suites without a sensor of the log."""
    result = case.result
    if result.status:
        yield lost("attitude", f"the filter failed in some cycles ({result.status.name})")
    if not result.measured and result.unused:
        yield lost("position", nothing_in_common(result.unused))


RULES = (
    Rule(_units, "units, axes or clocks are implausible"),
    Rule(_failures, "the filter failed, or the suite has no sensor of the log"),
    Rule(rules.late, "more than half of a sensor, or all from a time on, is late", "a tenth"),
    Rule(rules.clocks, "clocks of IMU and GNSS run apart by more than 0.15 s"),
    Rule(rules.gaps, "10 s of flight without a correction, over all parts, or none at all"),
    Rule(heading_rules.axes, "axes of magnetometer and IMU differ"),
    Rule(
        heading_rules.contradicted,
        "a heading 10 degrees and 4 standard deviations from the motion's, reset or for 2 s",
        "a magnetometer that was left out",
    ),
    Rule(rules.given_heading, "the motion contradicts the given heading"),
    Rule(
        rules.misfits,
        "innovations twice as large; a tenth rejected, or rejected in one run; GNSS for 10 s; a "
        "mean NIS of 25; correlated innovations of GNSS",
        "1.4 times as large; a run of rejections that chance does not explain",
    ),
    Rule(heading_rules.jumps, "", "the magnetic field jumps by a fifth, as no turn explains"),
    Rule(heading_rules.strength, "", "the strength of the magnetic field changes by 10 % for 2 s"),
    Rule(rules.first_heading, "the motion contradicts the heading at the start"),
    Rule(rules.first_tilt, "", "the motion contradicts roll and pitch at the start"),
    Rule(rules.first_place, "GNSS contradicts a given position or velocity at the start"),
    Rule(rules.lost_samples, "", "the IMU pauses for 0.3 s"),
    Rule(rules.unexplained, "the estimate changes as no sample of the IMU explains"),
    Rule(rules.flagged, "the filter is flagged as diverged at the end"),
    Rule(
        rules.biases,
        "biases of the IMU that no sensor has, or of 15 standard deviations, found by a reset",
    ),
    Rule(rules.unknown_heading, "", "a heading that nothing shows until the end"),
)
"""All rules, causes before consequences, with limits of unusable and uncertain quantities."""


def with_verdict(
    log: Log,
    body: str,
    suite: SensorSuite,
    result: Replay,
    start: Mapping[str, Any],
    known: tuple[Finding, ...] = (),
    reports: Collection[str] = (),
) -> Replay:
    """Return a replay with its findings, the worst first, and the verdict in a line.

    If the log has commands of the motors, it ends for the verdict where they stop for good. Some
    findings may be `known` before. For sensors that `reports` lists, the filter used the accuracy
    that they report.
    """
    flown = _until_landing(log, result)
    sensors = by_sensor(flown.measured)
    probability = suite.estimator.false_alarm_probability
    if "magnetometer" in sensors and probability:
        own = rejected_for_their_size(sensors["magnetometer"], probability)
        sensors = {**sensors, "magnetometer": own}
    fits = {name: fit for name, m in sensors.items() if (fit := fit_of(m))}
    case = Evidence(log, body, suite, flown, sensors, fits, start, reports)
    found = [*known, *(finding for rule in RULES for finding in rule.find(case))]
    found.sort(key=lambda finding: -finding.severity)
    return replace(result, findings=tuple(found), verdict=in_one_line(found, fits, reports))


def _until_landing(log: Log, result: Replay) -> Replay:
    """Return the rows and measurements of a replay until the motors stop."""
    running = running_motors(log)
    if running is None or not running.any():
        return result
    assert log.motors is not None
    landing = float(log.motors.time[np.flatnonzero(running)[-1]])
    if (result.time <= landing).all() or (result.time <= landing).sum() < 2:
        return result
    return during(result, -math.inf, landing)


def during(result: Replay, since: float, until: float) -> Replay:
    """Return the rows and measurements of a replay in some time."""
    rows = (result.time >= since) & (result.time <= until)
    cut: dict[str, Any] = {
        name: value[rows]
        for name, value in vars(result).items()
        if isinstance(value, np.ndarray) and len(value) == len(rows)
    }
    measured = {
        name: InnovationSeries(
            *(value[(m.time >= since) & (m.time <= until)] for value in vars(m).values())
        )
        for name, m in result.measured.items()
    }
    return replace(result, **cut, measured=measured)


def in_one_line(
    findings: Sequence[Finding], fits: Mapping[str, Fit], reports: Collection[str] = ()
) -> str:
    """Return the verdict in a line: usable or not, and NIS per degree of freedom.

    Sensors that report their accuracy, in `reports`, are not called pessimistic.
    """
    if problems := [f for f in findings if f.severity == Severity.LOST]:
        return f"not usable, because {problems[0]}"
    if not fits:
        return "usable as far as known: no innovations"
    values = {name: fit.mean_nis for name, fit in fits.items()}
    low, high = min(values.values()), max(values.values())
    span = f"{low:.2g} to {high:.2g}" if len(values) > 1 else f"{low:.2g}"
    reservations = [
        quantity
        for quantity in ("log", *QUANTITIES)
        if any(f.quantity == quantity and f.severity == Severity.UNCERTAIN for f in findings)
    ]
    text = f"usable: NIS per degree of freedom {span}"
    if reservations:
        listed = ", ".join(reservations)
        text = f"usable with reservations: {listed}; NIS per degree of freedom {span}"
    assumed = {name: value for name, value in values.items() if name not in reports} or {"": 1.0}
    least = min(assumed, key=assumed.__getitem__)
    for word, name, value in (
        ("pessimistic", least, 1.0 / max(assumed[least], 1e-6)),
        ("optimistic", max(values, key=values.__getitem__), high),
    ):
        if value > rules.RATIO:
            text += f", {word} in {NAMES[name]} by a factor of {math.sqrt(value):.1f}"
    return text
