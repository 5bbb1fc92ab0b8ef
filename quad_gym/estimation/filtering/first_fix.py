"""The arguments of `initialize`, checked, and the first estimate that follows from them."""

import math
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.estimation.filtering.engine import Engine, Floats
from quad_gym.estimation.filtering.headings import COUNT, SPACING, write_starts
from quad_gym.estimation.filtering.samples import checked_baseline, gnss_noise, require_gnss
from quad_gym.estimation.filtering.starts import (
    FirstEstimate,
    empty_fix,
    head_by_baseline,
    level,
    level_start,
    rest,
    still_start,
)
from quad_gym.frames import ecef_to_enu
from quad_gym.kernels import entries
from quad_gym.params import checks as check
from quad_gym.params.portable import turned
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import Aid
from quad_gym.records.inputs import FARTHEST_FIX, MIN_COURSE


@dataclass(frozen=True)
class FirstFix:
    """Arguments of `initialize`: a first fix, and measurements of the attitude."""

    gnss_position_G: ArrayLike
    """(3,) primary antenna relative to the reference antenna, in G [m]"""
    gnss_baseline_G: ArrayLike | None = None
    """(3,) primary to secondary antenna, in G [m]; None: not measured"""
    heading: float | None = None
    """heading of the body x axis, from east toward north [rad]; None: unknown. With a steep
    baseline and no heading, the initial heading is arbitrary, and the filter may diverge"""
    _: KW_ONLY
    heading_sigma: float | None = None
    """standard deviation of `heading`, or, with `course`, of the angle between the body x axis and
    the course [rad]; None: `initial_pose.heading_sigma`"""
    magnetometer: ArrayLike | None = None
    """(3,) magnetic field in B [T], for suites with a magnetometer"""
    magnetometer_sigma: float | None = None
    """standard deviation of its white noise, per axis [T]; None: the suite's value"""
    gnss_velocity_G: ArrayLike | None = None
    """(3,) velocity in G [m/s]; None: at rest"""
    course: bool = False
    """True: the vehicle flies nose first"""
    gnss_sigma: ArrayLike | None = None
    """noise of the position, as in `update`; None: the suite's value"""
    velocity_sigma: float | None = None
    """standard deviation of the velocity, per axis [m/s]; None: the suite's value"""
    tilt_sigma: float | None = None
    """standard deviation of roll and pitch of a level start [rad]; None:
    `FilterParams.initial_tilt_sigma`, or else LEVEL_SIGMA"""
    rest_sigma: float | None = None
    """standard deviation of a velocity that is not measured, per axis [m/s]; None: by
    `FilterParams.initial_velocity_variance`"""
    accel: ArrayLike | None = None
    """(3,) specific force at rest in B, preferably the mean of many samples [m/s^2]; None: the
    vehicle is assumed level"""
    accel_sigma: float | None = None
    """standard deviation of the white noise of `accel`, per axis [m/s^2]; None: the noise of one
    sample. The bias is accounted for separately"""
    time: float = 0.0
    """time stamp of the start [s]; all time stamps share its zero"""

    def refuse(self, what: str, *names: str) -> None:
        """Refuse arguments by name that have no effect with others, with the reason `what`."""
        for name in names:
            value = getattr(self, name)
            if not (value is None or (isinstance(value, bool | np.bool_) and not value)):
                raise ValueError(f"{name} must {what}")


@dataclass(frozen=True)
class FilterStart:
    """Start of a filter, from the checked arguments of `initialize`."""

    position_G: Floats
    sigmas: Floats
    """(3,) standard deviations of the position in I [m]"""
    velocity_I: Floats | None
    speeds: Floats
    """(3,) standard deviations of the velocity [m/s]"""
    baseline_G: Floats
    x_I: Floats
    """horizontal direction of the body x axis, for a steep baseline; zero: unknown"""
    estimates: list[FirstEstimate] = field(default_factory=list)
    """estimates with a known tilt, one or one for each heading; empty with Wahba's problem"""
    numbers: dict[str, float] = field(default_factory=dict)
    """parameters that differ from the suite's, for the start alone"""

    def write(self, engine: Engine) -> None:
        """Start the filters in an engine's memory."""
        engine.fill("gnss_position", self.position_G)
        engine.fill("gnss_baseline", self.baseline_G)
        kept = engine.impose({"position_sigma_I": self.sigmas, **self.numbers})
        engine.start(self.x_I)
        engine.restore_noise(kept)
        if self.estimates:
            write_starts(engine, self.estimates)
        elif self.velocity_I is not None:
            engine.fill("v_hat", self.velocity_I)
            L = engine.read("L")
            L[:, range(3, 6), range(3, 6)] = self.speeds
            engine.write("L", L)


def filter_start(sensors: SensorSuite, fix: FirstFix) -> FilterStart:
    """Return the start that follows from a first fix."""
    require_gnss(sensors, "initialize: start with set_state() instead")
    assert sensors.gnss is not None
    position = check.array("gnss_position_G", fix.gnss_position_G, (3,))
    _require_relative(position)
    sigmas = np.array(sensors.gnss.position_sigma_I)
    if fix.gnss_sigma is not None:
        sigmas = gnss_noise("gnss_sigma", fix.gnss_sigma)
    velocity, speeds = _first_velocity(sensors, fix)
    baseline = fix.gnss_baseline_G
    if baseline is not None:
        baseline = checked_baseline(sensors, baseline)
    if baseline is not None and fix.accel is None:
        others = ("heading_sigma", "magnetometer", "magnetometer_sigma", "accel_sigma", "course")
        fix.refuse("not be given with gnss_baseline_G", *others)
        if sensors.estimator.initial_tilt_sigma is None:
            reason = "not be given with gnss_baseline_G: the suite has no initial_tilt_sigma"
            fix.refuse(reason, "tilt_sigma")
        x_I = np.zeros(3)
        if fix.heading is not None:
            x_I = level(check.number("heading", fix.heading))[0]
        numbers = {}
        if fix.rest_sigma is not None:
            numbers["initial_velocity_variance"] = speeds[0] * speeds[0]
        if fix.tilt_sigma is not None:
            numbers["initial_tilt_sigma"] = check.positive("tilt_sigma", fix.tilt_sigma, most=1.0)
        return FilterStart(position, sigmas, velocity, speeds, baseline, x_I, numbers=numbers)
    start = _first_tilt(sensors, fix)
    start["antenna_I"] = turned(ecef_to_enu(sensors.gnss.reference_antenna_G), position)
    root = math.sqrt(sensors.estimator.initial_covariance_scale) * np.diag(sigmas)
    start["position_root"], start["velocity_sigma"] = root, speeds
    still = np.zeros(3) if velocity is None else velocity
    starts = _first_headings(sensors, fix, start, velocity, float(speeds[0]), baseline)
    found = [still_start(start, still) for start in starts]
    return FilterStart(position, sigmas, None, speeds, np.array([1.0, 0, 0]), np.zeros(3), found)


def _require_relative(position_G: Floats) -> None:
    """Refuse a first fix that is not near the reference antenna."""
    if np.abs(position_G).max() > FARTHEST_FIX:
        raise ValueError(
            "gnss_position_G must be relative to the reference antenna "
            f"(GnssParams.reference_antenna_G), within {FARTHEST_FIX:g} m of it, got "
            f"{position_G}; subtract the antenna's position from an absolute position in ECEF"
        )


def _first_velocity(sensors: SensorSuite, fix: FirstFix) -> tuple[Floats | None, Floats]:
    """Return the velocity in I at the start, or None, and its standard deviations."""
    gnss = sensors.gnss
    assert gnss is not None
    if fix.gnss_velocity_G is None:
        fix.refuse("come with gnss_velocity_G", "velocity_sigma")
        still = math.sqrt(sensors.estimator.initial_velocity_variance)
        if fix.rest_sigma is not None:
            still = check.positive("rest_sigma", fix.rest_sigma)
        return None, np.full(3, still)
    fix.refuse("not be given with gnss_velocity_G", "rest_sigma")
    noise = gnss.velocity_sigma
    if fix.velocity_sigma is not None:
        noise = check.positive("velocity_sigma", fix.velocity_sigma)
    if noise is None:
        raise ValueError("velocity_sigma must be given: the suite has no GNSS velocity")
    v_G = check.array("gnss_velocity_G", fix.gnss_velocity_G, (3,))
    return turned(ecef_to_enu(gnss.reference_antenna_G), v_G), np.full(3, noise)


def _first_tilt(sensors: SensorSuite, fix: FirstFix) -> NDArray[Any]:
    """Return a start (1,) START that is level, or tilted as an accelerometer at rest shows."""
    start = level_start(sensors)
    if fix.accel is None:
        fix.refuse("come with accel", "accel_sigma")
        if fix.tilt_sigma is not None:
            start["tilt_sigma"] = check.positive("tilt_sigma", fix.tilt_sigma, most=1.0)
        return start
    fix.refuse("not be given with accel, which measures the tilt", "tilt_sigma")
    white = sensors.imu.accel_noise_density / math.sqrt(sensors.imu.dt)
    if fix.accel_sigma is not None:
        white = check.positive("accel_sigma", fix.accel_sigma)
    rest(start, check.array("accel", fix.accel, (3,)), white, sensors.estimator.gravity)
    return start


def _first_headings(
    sensors: SensorSuite,
    fix: FirstFix,
    start: NDArray[Any],
    velocity: Floats | None,
    speed_sigma: float,
    baseline_G: Floats | None,
) -> list[NDArray[Any]]:
    """Return the start with its heading, or with all headings if it is unknown."""
    given = {
        "heading": fix.heading is not None,
        "magnetometer": fix.magnetometer is not None,
        "course": check.flag("course", fix.course),
        "gnss_baseline_G": baseline_G is not None,
    }
    if sum(given.values()) > 1:
        raise ValueError(
            "only one of heading, magnetometer, course and a baseline must be given, got "
            + " and ".join(name for name, is_given in given.items() if is_given)
        )
    if fix.magnetometer is None:
        fix.refuse("come with magnetometer", "magnetometer_sigma")
    if fix.heading is None and not fix.course:
        fix.refuse("come with heading or course", "heading_sigma")
    if fix.heading_sigma is not None:
        start["heading_sigma"] = check.positive("heading_sigma", fix.heading_sigma, most=math.pi)
    known, failure = empty_fix(sensors), ""
    if fix.heading is not None:
        known["heading"] = check.number("heading", fix.heading)
    elif fix.magnetometer is not None:
        if Aid["MAGNETOMETER"] not in sensors.aids:
            raise ValueError("the sensor suite has no magnetometer to initialize with")
        if fix.magnetometer_sigma is not None:
            known["field_sigma"] = check.positive("magnetometer_sigma", fix.magnetometer_sigma)
        field_B = check.array("magnetometer", fix.magnetometer, (3,))
        known["has_field"], known["field_B"] = 1, field_B
        failure = f"magnetometer must measure a level part of the field, got {field_B}"
    elif fix.course:
        if velocity is None:
            raise ValueError("course must come with gnss_velocity_G")
        known["course"], known["velocity_I"], known["velocity_sigma"] = 1, velocity, speed_sigma
        failure = (
            f"course must belong to a moving vehicle, at least {MIN_COURSE * speed_sigma:g} m/s "
            f"over the ground, got {math.hypot(velocity[0], velocity[1]):g} m/s"
        )
    elif baseline_G is not None:
        assert sensors.gnss is not None
        R_IG = ecef_to_enu(sensors.gnss.reference_antenna_G)
        head_by_baseline(start, sensors, turned(R_IG, baseline_G))
        return [start]
    else:  # with half the spacing as standard deviation they overlap to a uniform distribution
        start["heading_sigma"] = 0.5 * SPACING
        starts = [start.copy() for _ in range(COUNT)]
        for k, each in enumerate(starts):
            known["heading"] = k * SPACING
            entries.first_heading(each, known)
        return starts
    entries.first_heading(start, known)
    if known["outcome"][0]:
        raise ValueError(failure)
    return [start]
