"""Replay: a filter processes a log in the same way as in flight."""

import inspect
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from quad_gym.estimation.earth_field import at_place
from quad_gym.estimation.filters import UnscentedKalmanFilter
from quad_gym.estimation.logs import Log, read_log
from quad_gym.estimation.own import Estimator
from quad_gym.estimation.own_player import OwnPlayer
from quad_gym.estimation.plausibility import problems_of
from quad_gym.estimation.player import ESTIMATORS, Player
from quad_gym.estimation.results import Replay
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.suites import sensor_suite


def replay(
    log: Any,
    *,
    sensors: SensorSuite | str,
    estimator: Any = "ukf",
    start: Mapping[str, Any] | None = None,
    reported_noise: bool = True,
    window: float = 0.5,
    body: str = "flu",
) -> Replay:
    """Filter a log.

    The filter starts from the first fix. The initial heading comes from the first available of: its
    baseline, `start`, the magnetometer; without any of these it is unknown.

    Check `problems` of the result before you use its estimates: it has a sentence for each sensor
    that the suite does not describe, and for implausible units and axes.

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
        body: Axes of a table, see `read_log`.

    Raises:
        ValueError: If the log or an argument is invalid, the log has no fix to start from, images
            have other features than the suite, or the IMU samples have a gap longer than
            LONGEST_STEP.
    """
    own = None
    if not isinstance(estimator, str) or ":" in estimator:
        own, estimator = check.own("estimator", estimator, Estimator), "ukf"
    check.choice("estimator", estimator, tuple(ESTIMATORS))
    check.flag("reported_noise", reported_noise)
    whole, suite = prepared(log, sensors, body)
    reach = window + max(0.0, *vars(suite.log_delays).values())
    player = Player(whole, suite, estimator, named_start(start), reported_noise, reach)
    result = player.play() if own is None else OwnPlayer(player, own).play()
    return replace(result, problems=problems_of(whole, body, suite, result))


def prepared(log: Any, sensors: SensorSuite | str, body: str) -> tuple[Log, SensorSuite]:
    """Return a log without its delays, in the axes of B, and a suite with the origin of I.

    Raises:
        ValueError: As `replay`.
    """
    suite = sensor_suite(sensors) if isinstance(sensors, str) else sensors
    check.instance("sensors", suite, SensorSuite)
    whole = read_log(log, body=body).corrected(suite)
    return whole, origin_of(whole, suite)


def origin_of(log: Log, suite: SensorSuite) -> SensorSuite:
    """Return a suite whose reference antenna is the origin of I of a log, with the field there."""
    if suite.gnss is None:
        return suite
    origin = log.origin(np.array(suite.gnss.reference_antenna_G))
    if origin is None:
        return suite
    return at_place(suite, origin)


def named_start(start: Mapping[str, Any] | None) -> dict[str, Any]:
    """A start as keywords of `initialize`, or with a position as those that the player checks.

    Raises:
        ValueError: If it is none.
    """
    if start is not None and not isinstance(start, Mapping):
        raise ValueError(f"start must be values by name, or None, got {start!r}")
    given = dict(start or {})
    if "position" not in given:
        known = inspect.signature(UnscentedKalmanFilter.initialize).parameters
        check.keywords(given, [name for name in known if name != "self"], "start")
    return given
