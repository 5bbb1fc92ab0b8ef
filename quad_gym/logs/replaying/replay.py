"""Replay: a filter processes a log in the same way as in flight."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, Unpack

import numpy as np

from quad_gym.batch.own_estimator import Estimator
from quad_gym.estimation.filters import UnscentedKalmanFilter
from quad_gym.logs.formats import Floats, Log, Reading, read_log
from quad_gym.logs.formats.clocks import naming, parts_of
from quad_gym.logs.formats.earth_field import at_place
from quad_gym.logs.formats.quantities import compared, disputed, without
from quad_gym.logs.replaying.measurements import FilterCalls
from quad_gym.logs.replaying.player import ESTIMATORS, OwnPlayer, Player
from quad_gym.logs.replaying.results import Estimates, Finding, Replay, joined
from quad_gym.logs.replaying.rules import changes, reported_by, uncertain
from quad_gym.logs.replaying.verdict import during, with_verdict
from quad_gym.params import checks as check
from quad_gym.params.suites import SensorSuite, sensor_suite
from quad_gym.rotations import quaternion_to_dcm

# --------------------------------------------------------------------------------------------------
# The suite with which a log is replayed by default: by the sensors that it has.
# --------------------------------------------------------------------------------------------------


def suite_for(log: Log) -> tuple[str, str]:
    """Return the name of a built-in suite for the sensors of a log, and the reason.

    With a receiver it is "field", of real flights, or "rtk" with two antennas. Without one it is
    the suite that uses most of the log's sensors, as far as they measure position or velocity.
    """
    values = {} if log.gnss is None else log.gnss.values
    if {"gnss_baseline_G", "gnss_baseline_I"} & set(values):
        return "rtk", "the log has a receiver with two antennas"
    if log.gnss is not None and log.attitude is not None:
        return "mocap", "the log has positions and attitudes of motion capture"
    if log.gnss is not None:
        used = [name for name in ("barometer", "magnetometer") if name in log.streams]
        *before, last = [f"a {word}" for word in ("receiver", *used)]
        listed = f"{', '.join(before)} and {last}" if before else last
        return "field", f"the log has {listed}"
    for name, needs in (("uwb", ("uwb_range",)), ("crazyflie", ("optical_flow", "range_finder"))):
        if set(needs) <= set(log.streams):
            return name, f"the log has {' and '.join(n.replace('_', ' ') for n in needs)}"
    if log.camera is not None:
        features = log.camera.values["pixels"].shape[1]
        for name in ("indoor", "standard"):
            camera = sensor_suite(name).camera
            if camera is not None and len(camera.features_I) == features:
                return name, f"the log has images of {features} features"
    return "field", "the log has no receiver"


# --------------------------------------------------------------------------------------------------
# Replay: a filter processes a log in the same way as in flight.
# --------------------------------------------------------------------------------------------------

CLEARLY = 1.5
"""How many times more than the IMU explains an estimate changes with the wrong ones of positions
and velocities, at least."""
AROUND = 2.0  #: time before and after their contradiction that is compared [s]


def replay(
    log: Any,
    *,
    sensors: SensorSuite | str,
    estimator: Any = "ukf",
    start: Mapping[str, Any] | None = None,
    reported_noise: bool = True,
    window: float = 0.5,
    samples: Path | str | None = None,
    **reading: Unpack[Reading],
) -> Replay:
    """Filter a log.

    The filter starts from the first fix. The initial heading comes from the first available of: its
    baseline, `start`, the magnetometer; without any of these it is unknown.

    Check `problems` of the result before you use its estimates: it has a sentence for each quantity
    that the filter lost, each sensor that the suite does not describe, and implausible units.

    A log with pauses is flown in parts, each with a start: by GNSS, or without it where the part
    before has ended.

    The origin of I is the suite's reference antenna if the first fix is within 100 km of it, and
    the first fix otherwise.

    Args:
        log: A table or a file, see `quad_gym.estimation.read_log`, or its result.
        sensors: The suite that the filter assumes, or its name. Its rates and latencies are
            ignored: the log has its own. Time stamps of the log are earlier by its `log_delays`.
        estimator: "ukf" or "ekf"; or an own `quad_gym.Estimator`, its class, or "module:Class",
            which receives the mean of the samples over each tick of the suite's IMU, and the
            measurements that have arrived by its end. Its result has a row for each tick, and no
            innovations.
        start: Keywords of `initialize`, such as `{"heading": 0.5}` or `{"course": True}`. Without
            GNSS: `{"position": (0, 0, 0), "heading": 0.0}` for a level vehicle at rest, with the
            errors of the suite's `initial_pose`, or all keywords of `set_state`; each with `time`,
            by default the first sample's.
        reported_noise: True: use the accuracy that the receiver reports, if the log has it, in
            place of the suite's. An own estimator does not receive it.
        window: Longest delay of measurements beyond the suite's `log_delays` [s].
        samples: File to write the calls of the filter to, which an exported filter repeats; see
            `quad_gym.logs.replaying.measurements`.
        **reading: Keywords of `read_log`: `body`, `instance`, `topic`, `columns`, `from_`, `until`.

    Raises:
        ValueError: If the log or an argument is invalid, the log has no fix to start from, or
            images have other features than the suite.
    """
    own = None
    if not isinstance(estimator, str) or ":" in estimator:
        own, estimator = check.own("estimator", estimator, Estimator, ("update",)), "ukf"
    if own is not None and samples is not None:
        raise ValueError("samples must not be given with an estimator of your own")
    check.choice("estimator", estimator, tuple(ESTIMATORS))
    check.flag("reported_noise", reported_noise)
    length = check.number("window", window, least=0.0)
    whole, suite = prepared(log, sensors, reading)
    reach = length + max(0.0, *vars(suite.log_delays).values())

    def fly(part: Log, begin: dict[str, Any]) -> Replay:
        of_part = part, suite, estimator, begin, reported_noise, reach
        if own is not None:
            return OwnPlayer(own, *of_part).play()
        if samples is None:
            return Player(*of_part, hold=True).play()
        calls = FilterCalls(suite, part)  # the exported filter receives measurements only
        found = Player(*of_part, calls).play()
        rows.extend(calls.rows)
        return found

    rows: list[str] = []
    whole, found = judged(whole, suite, named_start(start), estimator, reported_noise, reach)
    result = in_parts(whole, named_start(start), fly)
    if samples is not None:
        Path(samples).write_text("".join(rows), encoding="utf-8")
    reports = reported_by(whole) if reported_noise else frozenset()
    about = whole, reading.get("body", "flu"), suite, result
    return with_verdict(*about, dict(start or {}), found, reports)


def judged(
    log: Log,
    suite: SensorSuite,
    start: dict[str, Any],
    estimator: str = "ukf",
    reported_noise: bool = True,
    reach: float | None = None,
) -> tuple[Log, tuple[Finding, ...]]:
    """Return a log without wrong positions or velocities of GNSS, and a finding about them.

    Where both contradict each other for some time, the IMU decides: without the wrong ones, an
    estimate changes as its samples explain.

    Args:
        log: The log.
        suite: The suite.
        start: The start, see `named_start`.
        estimator: Filter that is tried without either.
        reported_noise: True: with the accuracy that the receiver reports.
        reach: Longest delay of measurements; None: they are processed in the order of their stamps.
    """
    span = disputed(log, suite)
    if span is None:
        return log, ()

    def attempt(log: Log) -> Replay:
        def of_part(part: Log, begin: dict[str, Any]) -> Replay:
            return Player(part, suite, estimator, begin, reported_noise, reach).play()

        return in_parts(log, start, of_part)

    ratios = {}
    for quantity in ("position", "velocity"):
        tried = without(log, quantity, span)
        try:
            result = during(attempt(tried), span[0] - AROUND, span[1] + AROUND)
        except ValueError:
            return log, ()  # too little is left to replay it
        found, _ = changes(tried, result, float(result.time[0]))
        ratios[quantity] = max((change.ratio for change in found), default=np.inf)
    wrong = min(ratios, key=ratios.__getitem__)
    right = {"position": "velocity", "velocity": "position"}[wrong]
    many = {"position": "positions", "velocity": "velocities"}
    text = (
        f"GNSS positions and velocities contradict each other from {span[0]:.1f} to {span[1]:.1f} s"
    )
    if not ratios[wrong] < ratios[right] / CLEARLY:
        return log, (uncertain("position", f"{text}, and the IMU does not show which are wrong"),)
    text = f"{text}: the IMU agrees with the {many[right]}, so that the {many[wrong]} are left out"
    return without(log, wrong, span), (uncertain("position", f"{text} for this time"),)


_Found = TypeVar("_Found", bound=Estimates)


def in_parts(
    log: Log, start: dict[str, Any], fly: Callable[[Log, dict[str, Any]], _Found]
) -> _Found:
    """Return the results of a function for the parts of a log, one after the other.

    Args:
        log: The log.
        start: Start of the first part; later ones keep its keywords except for the heading, and
            without GNSS begin where the part before has ended.
        fly: Returns the estimates for a part and its start.
    """
    found: list[_Found] = []
    notes = list(log.notes)
    first_error: ValueError | None = None
    parts = parts_of(log)
    with naming(log):
        for part in parts:
            begin, end = part.imu.time[[0, -1]]
            try:
                found.append(fly(part, _start_of(start, found[-1] if found else None)))
            except ValueError as error:
                if len(parts) == 1:
                    raise
                first_error = first_error or error
                notes.append(f"the part from {begin:.2f} s to {end:.2f} s is left out: {error}")
        if not found:
            assert first_error is not None
            raise first_error
    if len(parts) > 1:
        spans = ", ".join(f"{each.time[0]:.2f} to {each.time[-1]:.2f} s" for each in found)
        notes.insert(0, f"the log has pauses, and is flown in {len(found)} parts: {spans}")
    notes += found[0].notes
    whole = joined(found)
    quaternion = _continuous(whole.quaternion)
    return replace(whole, quaternion=quaternion, notes=tuple(notes), sources=log.sources)


def _continuous(quaternion: Floats) -> Floats:
    """Return quaternions (n, 4), each with the sign that is nearer to the one before."""
    steps = (quaternion[1:] * quaternion[:-1]).sum(axis=1)
    signs = np.cumprod(np.append(1.0, np.where(steps < 0.0, -1.0, 1.0)))
    return np.asarray(signs[:, np.newaxis] * quaternion)


def _start_of(start: dict[str, Any], before: Estimates | None) -> dict[str, Any]:
    """Return the start of a part: a heading holds for the first one only."""
    if before is None:
        return start
    if "position" not in start:
        return {name: value for name, value in start.items() if name not in ("heading", "time")}
    R_BI = quaternion_to_dcm(before.quaternion[-1])
    return {"position": before.position[-1], "heading": float(np.arctan2(R_BI[0, 1], R_BI[0, 0]))}


def prepared(log: Any, sensors: SensorSuite | str, reading: Reading) -> tuple[Log, SensorSuite]:
    """Return a log without its delays, in the axes of B, and a suite with the origin of I.

    Quantities that other sensors contradict are left out.
    """
    suite = sensor_suite(sensors) if isinstance(sensors, str) else sensors
    check.instance("sensors", suite, SensorSuite)
    whole = read_log(log, **reading).corrected(suite)
    with naming(whole):
        suite = origin_of(whole, suite)
        return compared(whole, suite), suite


def origin_of(log: Log, suite: SensorSuite) -> SensorSuite:
    """Return a suite whose reference antenna is the origin of I of a log, with the field there."""
    if suite.gnss is None:
        return suite
    origin = log.origin(np.array(suite.gnss.reference_antenna_G))
    if origin is None:
        return suite
    return at_place(suite, origin)


def named_start(start: Mapping[str, Any] | None) -> dict[str, Any]:
    """A start as keywords of `initialize`, or with a position as those that the player checks."""
    if start is not None and not isinstance(start, Mapping):
        raise ValueError(f"start must be values by name, or None, got {start!r}")
    given = dict(start or {})
    if "position" not in given:
        known = inspect.signature(UnscentedKalmanFilter.initialize).parameters
        check.keywords(given, [name for name in known if name != "self"], "start")
    return given
