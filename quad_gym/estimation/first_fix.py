"""The arguments of `initialize`, checked, and the first estimate that follows from them."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quad_gym.estimation.correlated import in_principal_axes
from quad_gym.estimation.engine import Engine, Floats
from quad_gym.estimation.headings import COUNT, SPACING, write_starts
from quad_gym.estimation.samples import checked_baseline, gnss_noise, require_gnss
from quad_gym.estimation.starts import (
    LEVEL,
    LEVEL_SIGMA,
    FirstEstimate,
    Heading,
    Tilt,
    baseline_heading,
    known_heading,
    magnetic_heading,
    resting_tilt,
    still_start,
)
from quad_gym.frames import ecef_to_enu
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import Aid

FARTHEST_FIX = 1e6
"""Largest distance of a fix from the reference antenna [m]; the center of the Earth is farther."""

LEAST_COURSE = 5.0
"""Speed divided by its standard deviation from which a course determines the heading."""


@dataclass(frozen=True)
class FirstFix:
    """Measurements at the start."""

    position_G: Floats
    sigmas: Floats
    """(3,) standard deviations of the position in I [m]"""
    velocity_I: Floats | None
    speeds: Floats
    """(3,) standard deviations of the velocity [m/s]"""
    baseline_G: Floats
    x_I: Floats
    """horizontal direction of the body x axis, for a steep baseline; zero: unknown"""
    starts: list[FirstEstimate] = field(default_factory=list)
    """starts with a known tilt, one or one for each heading; empty with Wahba's problem"""

    def write(self, engine: Engine) -> None:
        """Start the filters in an engine's memory."""
        engine.fill("gnss_position", self.position_G)
        engine.fill("gnss_baseline", self.baseline_G)
        kept = engine.impose({"gnss_sigma": self.sigmas})
        engine.start(self.x_I)
        engine.restore_noise(kept)
        if self.starts:
            write_starts(engine, self.starts)
        elif self.velocity_I is not None:
            engine.fill("v_hat", self.velocity_I)
            L = engine.read("L")
            L[:, range(3, 6), range(3, 6)] = self.speeds
            engine.write("L", L)


def checked_fix(
    sensors: SensorSuite,
    gnss_position_G: ArrayLike,
    gnss_baseline_G: ArrayLike | None,
    heading: float | None,
    heading_sigma: float | None,
    magnetometer: ArrayLike | None,
    magnetometer_sigma: float | None,
    gnss_velocity_G: ArrayLike | None,
    course: bool,
    gnss_sigma: ArrayLike | None,
    velocity_sigma: float | None,
    tilt_sigma: float | None,
    accel: ArrayLike | None,
    accel_sigma: float | None,
) -> FirstFix:
    """Check the arguments of `initialize`.

    Raises:
        ValueError: As in `initialize`.
    """
    require_gnss(sensors, "initialize: start with set_state() instead")
    position = check.array("gnss_position_G", gnss_position_G, (3,))
    _require_relative(position)
    sigmas, covariance = _position_noise(sensors, gnss_sigma)
    velocity, speeds = _first_velocity(sensors, gnss_velocity_G, velocity_sigma)
    baseline = None if gnss_baseline_G is None else checked_baseline(sensors, gnss_baseline_G)
    if baseline is not None and accel is None:
        _refuse_beside_baseline(
            heading_sigma=heading_sigma,
            magnetometer=magnetometer,
            magnetometer_sigma=magnetometer_sigma,
            tilt_sigma=tilt_sigma,
            accel_sigma=accel_sigma,
            course=course or None,
            **{"a covariance as gnss_sigma": covariance},
        )
        x_I = np.zeros(3)
        if heading is not None:
            angle = check.number("heading", heading)
            x_I[:2] = np.cos(angle), np.sin(angle)
        return FirstFix(position, sigmas, velocity, speeds, baseline, x_I)

    tilt = _first_tilt(sensors, tilt_sigma, accel, accel_sigma)
    told = {
        "heading": heading is not None,
        "magnetometer": magnetometer is not None,
        "course": check.flag("course", course),
        "gnss_baseline_G": baseline is not None,
    }
    if sum(told.values()) > 1:
        raise ValueError(
            "only one of heading, magnetometer, course and a baseline must be given, got "
            + " and ".join(name for name, given in told.items() if given)
        )
    if magnetometer is None and magnetometer_sigma is not None:
        raise ValueError("magnetometer_sigma must come with magnetometer")
    own = sensors.initial_pose.heading_sigma
    if heading_sigma is not None:
        if heading is None and not course:
            raise ValueError("heading_sigma must come with heading or course")
        own = check.positive("heading_sigma", heading_sigma, most=math.pi)

    # with half the spacing as standard deviation they overlap to a uniform distribution
    headings = [known_heading(k * SPACING, 0.5 * SPACING, tilt) for k in range(COUNT)]
    if heading is not None:
        headings = [known_heading(check.number("heading", heading), own, tilt)]
    elif magnetometer is not None:
        headings = [_by_magnetometer(sensors, magnetometer, magnetometer_sigma, tilt)]
    elif course:
        headings = [_by_course(velocity, float(speeds[0]), own, tilt)]
    elif baseline is not None:
        headings = [_by_baseline(sensors, baseline, tilt)]
    assert sensors.gnss is not None
    antenna_I = ecef_to_enu(sensors.gnss.reference_antenna_G) @ position
    root = math.sqrt(sensors.estimator.initial_covariance_scale) * _root(sigmas, covariance)
    still = np.zeros(3) if velocity is None else velocity
    starts = [still_start(sensors, antenna_I, root, still, speeds, tilt, h) for h in headings]
    return FirstFix(position, sigmas, None, speeds, np.array([1.0, 0, 0]), np.zeros(3), starts)


def _require_relative(position_G: Floats) -> None:
    """Refuse a first fix that is not near the reference antenna."""
    if np.abs(position_G).max() > FARTHEST_FIX:
        raise ValueError(
            "gnss_position_G must be relative to the reference antenna "
            f"(GnssParams.reference_antenna_G), within {FARTHEST_FIX:g} m of it, got "
            f"{position_G}; subtract the antenna's position from an absolute position in ECEF"
        )


def _refuse_beside_baseline(**given: Any) -> None:
    """Refuse arguments that a start with a baseline does not use."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"{name} must not be given with gnss_baseline_G")


def _root(sigmas: Floats, covariance: Floats | None) -> Floats:
    """Return a root of the covariance of the position."""
    if covariance is None:
        return np.diag(sigmas)
    T, s = in_principal_axes(covariance)
    return T.T * s  # type: ignore[no-any-return]


def _position_noise(sensors: SensorSuite, given: ArrayLike | None) -> tuple[Floats, Floats | None]:
    assert sensors.gnss is not None
    if given is None:
        return np.array(sensors.gnss.position_sigma_I), None
    return gnss_noise("gnss_sigma", given)


def _first_velocity(
    sensors: SensorSuite, given_G: ArrayLike | None, sigma: float | None
) -> tuple[Floats | None, Floats]:
    """Return the velocity in I at the start, or None, and its standard deviations."""
    gnss = sensors.gnss
    assert gnss is not None
    if given_G is None:
        if sigma is not None:
            raise ValueError("velocity_sigma must come with gnss_velocity_G")
        return None, np.full(3, math.sqrt(sensors.estimator.initial_velocity_variance))
    noise = gnss.velocity_sigma if sigma is None else check.positive("velocity_sigma", sigma)
    if noise is None:
        raise ValueError("velocity_sigma must be given: the suite has no GNSS velocity")
    v_G = check.array("gnss_velocity_G", given_G, (3,))
    return ecef_to_enu(gnss.reference_antenna_G) @ v_G, np.full(3, noise)


def _first_tilt(
    sensors: SensorSuite,
    tilt_sigma: float | None,
    accel: ArrayLike | None,
    accel_sigma: float | None,
) -> Tilt:
    """Return a level tilt, or the tilt from an accelerometer at rest."""
    if accel is None:
        if accel_sigma is not None:
            raise ValueError("accel_sigma must come with accel")
        sigma = sensors.estimator.initial_tilt_sigma or LEVEL_SIGMA
        if tilt_sigma is not None:
            sigma = check.positive("tilt_sigma", tilt_sigma, most=1.0)
        return LEVEL._replace(sigma=sigma)
    if tilt_sigma is not None:
        raise ValueError("tilt_sigma must not be given with accel, which measures the tilt")
    white = sensors.imu.accel_noise_density / math.sqrt(sensors.imu.dt)
    if accel_sigma is not None:
        white = check.positive("accel_sigma", accel_sigma)
    force = check.array("accel", accel, (3,))
    return resting_tilt(force, white, sensors.estimator.gravity)


def _by_magnetometer(
    sensors: SensorSuite, magnetometer: ArrayLike, sigma: float | None, tilt: Tilt
) -> Heading:
    if Aid.MAGNETOMETER not in sensors.aids:
        raise ValueError("the sensor suite has no magnetometer to initialize with")
    field_B = check.array("magnetometer", magnetometer, (3,))
    if sigma is not None:
        sigma = check.positive("magnetometer_sigma", sigma)
    return magnetic_heading(sensors, field_B, sigma, tilt)


def _by_baseline(sensors: SensorSuite, baseline_G: Floats, tilt: Tilt) -> Heading:
    gnss = sensors.gnss
    assert gnss is not None
    sigma = math.sqrt(sensors.estimator.initial_covariance_scale) * gnss.first_baseline_sigma
    baseline_I = ecef_to_enu(gnss.reference_antenna_G) @ baseline_G
    found = baseline_heading(np.array(gnss.baseline_B), baseline_I, sigma, tilt)
    if found is None:
        raise ValueError(
            "gnss_baseline_G must not be within 12 degrees of the vertical where accel gives the "
            "tilt: use a heading in its place"
        )
    return found


def _by_course(velocity: Floats | None, sigma: float, own: float, tilt: Tilt) -> Heading:
    if velocity is None:
        raise ValueError("course must come with gnss_velocity_G")
    speed = math.hypot(velocity[0], velocity[1])
    if speed < LEAST_COURSE * sigma:
        raise ValueError(
            f"course must belong to a moving vehicle, at least {LEAST_COURSE * sigma:g} m/s over "
            f"the ground, got {speed:g} m/s"
        )
    angle = math.atan2(velocity[1], velocity[0])
    return known_heading(angle, math.hypot(own, sigma / speed), tilt)
