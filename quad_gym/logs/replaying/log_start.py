"""Start of a filter on a log: from its first fix or a given state, at rest or in motion."""

import math
from typing import Any

import numpy as np

from quad_gym.estimation.filters import LONGEST_STEP, KalmanFilter
from quad_gym.estimation.starts import state_at_rest
from quad_gym.logs.formats import Log
from quad_gym.logs.replaying.measurements import LogMeasurements
from quad_gym.params import checks as check
from quad_gym.params.suites import SensorSuite

# --------------------------------------------------------------------------------------------------
# Logs that begin in motion: level and at rest is then a rough guess, as its spread must show.
#
# The spread is the start's alone: a later reset has the suite's own numbers.
# --------------------------------------------------------------------------------------------------

SPAN = 1.0  #: time after the first fix whose positions show the speed at the first one [s]
TURNING, FAST = 0.3, 1.0
"""Angular rate [rad/s] and speed [m/s] at the first fix of a vehicle that moves."""
CERTAIN = 4.0  #: standard deviations of a speed from positions beyond which it is no noise
TILT = 0.3  #: standard deviation of roll and pitch of a vehicle that maneuvers [rad]


def wide_start(suite: SensorSuite, log: Log) -> dict[str, float]:
    """Return keywords of `initialize` for a large uncertainty, if a log begins in motion.

    A filter that solves Wahba's problem for its start keeps it: there are none.
    """
    speed = _first_speed(log, suite)
    own = suite.estimator
    if speed is None or own.initial_tilt_sigma is None:
        return {}
    at_rest = math.sqrt(own.initial_velocity_variance)
    return {
        "tilt_sigma": max(own.initial_tilt_sigma, TILT),
        "rest_sigma": max(at_rest, 1.0 + round(speed)),
    }


def _first_speed(log: Log, suite: SensorSuite) -> float | None:
    """Return the speed of a vehicle that moves at the first fix [m/s]; None: it hardly does."""
    gnss = log.gnss
    if gnss is None or suite.gnss is None:
        return None
    known = (gnss.values[n] for n in ("gnss_position_G", "gnss_position_I") if n in gnss.values)
    positions = next(known, np.empty((len(gnss), 0)))
    rows = np.isfinite(positions).all(axis=1) & (positions.shape[1] > 0)
    if not rows.any():
        return None
    time, positions = gnss.time[rows], positions[rows]
    rows = time < time[0] + SPAN
    nearest = int(np.argmin(np.abs(log.imu.time - time[0])))
    turning = float(np.linalg.norm(log.imu.values["gyro"][nearest]))
    speed, spread = 0.0, np.inf
    if rows.sum() > 3:  # a parabola, whose slope at the first fix is the velocity there
        powers = np.vander(time[rows] - time[0], 3)
        slope = np.linalg.pinv(powers)[1]
        speed = float(np.linalg.norm(slope @ positions[rows]))
        spread = max(suite.gnss.position_sigma_I) * float(np.linalg.norm(slope))
    moving = speed > max(FAST, CERTAIN * spread)
    return speed if moving or turning > TURNING else None


# --------------------------------------------------------------------------------------------------
# Start of a filter on a log: from its first fix, or from a state that the caller gives.
# --------------------------------------------------------------------------------------------------

PATIENCE = 2.0  #: time for which a start waits for the first magnetic field [s]


class LogStart:
    """Start of filters on a log, the same for each.

    Args:
        measured: Measurements of the log.
        given: Keywords of `initialize` or, with a position, of `set_state`.
        in_order: True if measurements are processed in the order of their time stamps.
    """

    def __init__(self, measured: LogMeasurements, given: dict[str, Any], in_order: bool) -> None:
        self.given = given
        self.at_rest = "position" in given  #: True: the caller gives the state
        self.from_fix: dict[str, Any] = {}  #: keywords of `initialize`, once they are known
        self._measured, self._in_order = measured, in_order
        self._field: int | None = None  # the last magnetic field before the start
        self.field_row: int | None = None  #: row of the magnetometer that the start uses
        self._first_fix = math.inf  # arrival of the first fix that waits for a heading
        # roll and pitch of a wide start are too uncertain for a heading by a magnetic field
        self.tilted = bool(wide_start(measured.suite, measured.log)) and not in_order

    def begin(self, kf: KalmanFilter, suite: SensorSuite) -> None:
        """Start a filter with its suite."""
        if self.at_rest:
            try:
                kf.set_state(**self._state(suite))
            except TypeError as error:
                raise ValueError(f"start must be the keywords of set_state: {error}") from None
        else:
            kf.initialize(**self._widened(self.from_fix, suite))
        if self._measured.log.barometer_from_start:  # relative to the height of the vehicle
            kf._engine.steps["level"] = np.nan

    def found_in(self, name: str, k: int) -> bool:
        """Return True if the start is known with measurement k of a stream; `from_fix` has it."""
        if name == "magnetometer":
            self._field = k
        if name != "gnss":
            return False
        stream, log = self._measured.streams["gnss"], self._measured.log
        fix, time = self._measured.keywords("gnss", k), float(stream.time[k])
        averages = self._measured.suite.imu.samples == "average"
        first = float(log.imu.time[0 if averages else 1])  # an instant needs the sample before
        if "gnss_position_G" not in fix or time < first - LONGEST_STEP:
            return False
        if not {"heading", "course"} & set(self.given) and "gnss_baseline_G" not in fix:
            heading = self._measured.heading(time)
            fix |= {} if heading is None else {"heading": heading}
        if not self._knows_heading(fix) and "magnetometer" in self._measured.streams:
            if self._in_order:  # the nearest one, even if it is later
                fields = self._measured.streams["magnetometer"].time
                self._field = int(np.argmin(np.abs(fields - time)))
            self._first_fix = min(self._first_fix, float(stream.received[k]))
            if self._field is None and stream.received[k] < self._first_fix + PATIENCE:
                return False
            if self._field is not None:
                fields = self._measured.streams["magnetometer"].values["magnetometer"]
                fix["magnetometer"], self.field_row = fields[self._field], self._field
        if self.given.get("course") and "gnss_velocity_G" not in {**fix, **self.given}:
            why = "the first fix of the log has none"
            if not self._measured.suite.blocks_of("gnss_velocity"):
                why = "the sensors take none: GnssParams.velocity_sigma is None"
            raise ValueError(f"a start by its course must have a GNSS velocity, but {why}")
        self.from_fix = self._widened({**fix, **self.given, "time": time}, self._measured.suite)
        return True

    def _widened(self, fix: dict[str, Any], suite: SensorSuite) -> dict[str, Any]:
        """Return a first fix with the uncertainty of a start in motion, for a suite."""
        wide = wide_start(suite, self._measured.log)
        if "accel" in fix:  # at rest
            wide.pop("tilt_sigma", None)
        if "gnss_velocity_G" in fix:
            wide.pop("rest_sigma", None)
        return {**fix, **wide, **self.given}

    def _knows_heading(self, fix: dict[str, Any]) -> bool:
        """Return True if no magnetic field is necessary, or admitted, for the heading."""
        by_fix = {"gnss_baseline_G", "heading"} & set(fix)
        return bool(
            self.tilted or by_fix or {"heading", "course", "magnetometer"} & set(self.given)
        )

    def _state(self, suite: SensorSuite) -> dict[str, Any]:
        """Return keywords of `set_state`, completed for a vehicle at rest."""
        state = {"time": float(self._measured.log.imu.time[0]), **self.given}
        if {"R_BI", "covariance"} & set(state):
            return state
        check.keywords(state, ("position", "heading", "time"), "a start at a position")
        heading = state.setdefault("heading", self._measured.heading(state["time"]))
        if heading is None:
            raise ValueError(
                "start must have a heading in addition to the position, or all keywords of "
                "set_state"
            )
        return state_at_rest(suite, **state)
