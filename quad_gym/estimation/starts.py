"""Starts of a filter from one fix: the arguments of `initialize`, and unknown headings."""

import math
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.estimation.engine import Engine
from quad_gym.estimation.inputs import (
    Measurement,
    checked_measurement,
    measured_blocks,
    require_gnss,
    sigmas_of,
    values_of,
)
from quad_gym.frames import ecef_to_enu
from quad_gym.kernels import entries
from quad_gym.packing import slow_states
from quad_gym.params import checks as check
from quad_gym.params.gnss import STEEP
from quad_gym.params.portable import turned
from quad_gym.params.suites import SensorSuite
from quad_gym.records import BASELINE_BLOCK, POSITION_BLOCK, START, Aid, lower_factors, shown_rows
from quad_gym.records.inputs import FARTHEST_FIX, FIX, MIN_COURSE
from quad_gym.records.states import V
from quad_gym.rotations import dcm_to_euler, euler_to_dcm

# --------------------------------------------------------------------------------------------------
# Starts from one fix: level, or tilted as measured at rest; and Wahba's problem, for others.
#
# All that is uncertain at the start is a linear function of independent errors s,
#
#     x = (r, v, e, b_a, b_g, d) = G s,
#
# so that `L L^T = G diag(s^2) G^T` follows from a QR factorization, also where it is singular. The
# position depends on the attitude, as the antenna was measured and not the center of mass: with r =
# antenna - R^T l its error is the error of the fix plus J e, J = R_hat^T [l x]. The heading depends
# on its source (`kernels/filter/starts.py`, `head_by_baseline`).
#
# R_hat is T level(heading): T turns the level frame, whose x axis is the body's without its
# vertical part, into B. Errors are taken in the level frame and turned, e = T e_L. A resting
# accelerometer measures `f = g k + g k x e + b_a + v` with the vertical k = T e3, so that
#
#     e_L = e3 x T^T (b_a + v) / g + (0, 0, error of the heading).
#
# An accelerometer is so good that an error theta of the heading matters to higher orders: the error
# angles of a turn by theta about k are `theta k + theta^2 q / 2 + ...`, q = (k_y k_z, -k_x k_z,
# -k_x k_y), while for a level vehicle they are theta alone. `still_start` models the term with q as
# a separate error with the same mean square, and bounds the third order by theta^3 / 6.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]

LEVEL_SIGMA = 0.03
"""Standard deviation of roll and pitch of a vehicle put down or hovering, if the suite has none
[rad]; as in `quad_gym.params.suites`."""

MAX_MOTION = 0.1
"""Fraction of gravity by which the specific force of a vehicle at rest may differ from it: twice
the effect of the bias of a cheap accelerometer."""

STEEPEST_NOSE = 0.05  #: horizontal fraction of the x axis below which its heading is undefined

_D = 15  #: the first time-correlated error among the states

UNKNOWN = math.pi / math.sqrt(3.0)  #: standard deviation of a heading that is unknown [rad]


class FirstEstimate(NamedTuple):
    """First estimate of a filter."""

    position: Floats  #: (3,) position in I [m]
    velocity: Floats  #: (3,) velocity in I [m/s]
    R_BI: Floats  #: (3, 3) attitude
    covariance: Floats
    """(15 + n, 15 + n) covariance of r, v, e, b_a, b_g and n time-correlated errors"""


def level(angle: float) -> Floats:
    """Return R_BI of a level vehicle whose x axis has a heading."""
    start = np.zeros(1, START)
    start["T"], start["heading"] = np.eye(3), angle
    entries.start_level(start)
    return start["R_BI"][0].copy()


def level_start(sensors: SensorSuite) -> NDArray[Any]:
    """Return the start of a level vehicle, (1,) START, with the numbers of a suite."""
    slow, imu = slow_states(sensors).first_sigmas, sensors.imu
    start = np.zeros(1, START)
    start["T"] = np.eye(3)
    start["tilt_sigma"] = sensors.estimator.initial_tilt_sigma or LEVEL_SIGMA
    start["heading_sigma"] = sensors.initial_pose.heading_sigma
    start["velocity_sigma"] = math.sqrt(sensors.estimator.initial_velocity_variance)
    start["accel_bias_sigma"], start["gyro_bias_sigma"] = imu.accel_bias_sigma, imu.gyro_bias_sigma
    start["slow_sigma"][0, : len(slow)], start["slow_states"] = slow, len(slow)
    if sensors.gnss is not None:
        start["lever_B"] = sensors.gnss.primary_antenna_B
    return start


def empty_fix(sensors: SensorSuite) -> NDArray[Any]:
    """Return a fix without measurements, (1,) FIX, with the numbers of a suite."""
    fix, gnss, compass = np.zeros(1, FIX), sensors.gnss, sensors.magnetometer
    fix["R_IG"], fix["sigma"], fix["baseline"] = np.eye(3), 1.0, (1.0, 0.0, 0.0)
    fix["scale"] = math.sqrt(sensors.estimator.initial_covariance_scale)
    fix["place_sigma"] = sensors.initial_pose.position_sigma
    if gnss is not None:
        fix["R_IG"], fix["sigma"] = ecef_to_enu(gnss.reference_antenna_G), gnss.position_sigma_I
        fix["velocity_sigma"] = gnss.velocity_sigma or 0.0
        fix["takes_baseline"] = gnss.has_baseline
    if compass is not None:
        states = slow_states(sensors)
        fix["field_I"], fix["field_sigma"] = compass.field_I, compass.noise_sigma
        fix["iron"] = states.vectors[Aid["MAGNETOMETER"]]
        fix["declination"] = states.scalars[Aid["MAGNETOMETER"]]
    return fix


def rest(start: NDArray[Any], accel: Floats, sigma: float, gravity: float) -> None:
    """Give a start the tilt of a vehicle at rest from its accelerometer.

    Args:
        start: (1,) START; changed.
        accel: (3,) measured specific force in B [m/s^2].
        sigma: Standard deviation of its white noise, per axis [m/s^2].
        gravity: Gravitational acceleration that the filter assumes [m/s^2].
    """
    size = float(np.linalg.norm(accel))
    if abs(size - gravity) > MAX_MOTION * gravity:
        raise ValueError(
            f"accel must be from a vehicle at rest, within {100 * MAX_MOTION:g} % of gravity, "
            f"{gravity:g} m/s^2, got {size:g} m/s^2"
        )
    k = accel / size
    x = np.array([1.0, 0.0, 0.0]) - k[0] * k
    share = float(np.linalg.norm(x))
    if share < STEEPEST_NOSE:
        raise ValueError(f"accel must be from a vehicle whose x axis is not vertical, got {k}")
    x /= share
    start["T"] = np.column_stack([x, np.cross(k, x), k])
    start["tilt_sigma"], start["tilt_of_bias"] = sigma / gravity, 1.0 / gravity


def head_by_baseline(start: NDArray[Any], sensors: SensorSuite, baseline_I: Floats) -> None:
    """Give a start (1,) START of known tilt the heading by two antennas.

    The baseline, (3,) from the primary antenna, acts as a magnetic field whose direction is
    measured in I.
    """
    assert sensors.gnss is not None
    baseline_B = np.array(sensors.gnss.baseline_B)
    scale = math.sqrt(sensors.estimator.initial_covariance_scale)
    sigma = scale * sensors.gnss.first_baseline_sigma
    f = start["T"][0].T @ (baseline_B / np.linalg.norm(baseline_B))
    f_h = math.hypot(f[0], f[1])
    if f_h < STEEP or math.hypot(baseline_I[0], baseline_I[1]) == 0.0:
        raise ValueError(
            "gnss_baseline_G must not be within 12 degrees of the vertical where accel gives the "
            "tilt: use a heading in its place"
        )
    slope = f[2] / f_h
    start["heading"] = math.atan2(baseline_I[1], baseline_I[0]) - math.atan2(f[1], f[0])
    start["heading_sigma"] = sigma / f_h
    start["heading_of_tilt"] = slope * f[0] / f_h, slope * f[1] / f_h


def still_start(start: NDArray[Any], velocity: Floats) -> FirstEstimate:
    """Return the first estimate of a vehicle of known tilt, with its covariance."""
    entries.start_level(start)
    found = start[0]
    n = _D + int(found["slow_states"])
    rows = shown_rows(n)
    P = found["P"][rows[:, np.newaxis], rows]
    return FirstEstimate(found["position"].copy(), velocity, found["R_BI"].copy(), P)


def state_at_rest(
    sensors: SensorSuite, position: ArrayLike, heading: float, time: float
) -> dict[str, Any]:
    """Return keywords of `set_state` for a level vehicle at rest at a known place (3,) in I [m].

    `SensorSuite.initial_pose` gives the errors of position and heading.
    """
    pose, form, imu = sensors.initial_pose, sensors.estimator, sensors.imu
    tilt = form.initial_tilt_sigma or LEVEL_SIGMA
    variances = np.concatenate(
        [
            np.full(3, pose.position_sigma**2),
            np.full(3, form.initial_velocity_variance),
            [tilt**2, tilt**2, pose.heading_sigma**2],
            np.full(3, imu.accel_bias_sigma**2),
            np.full(3, imu.gyro_bias_sigma**2),
        ]
    )
    return {
        "position": check.array("position", position, (3,)),
        "velocity": np.zeros(3),
        "R_BI": level(check.angle("heading", heading)),
        "accel_bias": np.zeros(3),
        "gyro_bias": np.zeros(3),
        "covariance": np.diag(variances),
        "time": time,
    }


def solve_wahba(weights: ArrayLike, v_I: ArrayLike, v_B: ArrayLike) -> Floats:
    """Return the rotation that best maps vectors in I to the same vectors measured in B.

    It minimizes `sum_i a_i |v_B,i - R_BI v_I,i|^2`.

    Args:
        weights: (n,) weights a_i, none negative and not all zero.
        v_I: (n, 3) vectors in I.
        v_B: (n, 3) the same vectors in B.

    Returns:
        (3, 3) R_BI, a proper rotation.

    Raises:
        ValueError: If the shapes do not fit, a value is not finite, or the vectors do not determine
            the rotation (all parallel, for example).

    Source: report section 4.1; F. L. Markley, J. Astronautical Sciences 36(3), 1988.
    """
    a = check.array("weights", weights, (None,))
    vectors_I = check.array("v_I", v_I, (len(a), 3))
    vectors_B = check.array("v_B", v_B, (len(a), 3))
    if (a < 0.0).any() or not (a > 0.0).any():
        raise ValueError(f"weights must be at least 0 and not all zero, got {a}")
    R_BI = np.empty((3, 3))
    uniqueness = entries.wahba_of_vectors(a, vectors_I, vectors_B, R_BI)
    if not uniqueness > 1e-10:
        raise ValueError(
            "v_I and v_B must determine a rotation: at least two directions must differ"
        )
    return R_BI


# --------------------------------------------------------------------------------------------------
# Filters with unknown heading: a Gaussian sum, with one Gaussian for each of many headings.
#
# A filter that linearizes about one heading fails if the true heading is far from it. Therefore
# each lane of several blocks starts from another heading, with half the spacing as its standard
# deviation: their sum is nearly uniform. Each measurement weights the lanes by its likelihood,
#
#     log w += -(nu^T S^-1 nu + log det S) / 2,   det S = det R (det L- / det L+)^2,
#
# where R is the same for all. Acceleration reveals the heading; without it the heading stays
# unknown. When the standard deviation of the heading is below `RESOLVED`, a single Gaussian with
# the mean and the covariance of the sum takes over.
#
# Source: D. L. Alspach and H. W. Sorenson, IEEE Trans. Automatic Control 17(4), 1972.
# --------------------------------------------------------------------------------------------------

COUNT = 48  #: number of headings; a multiple of the lanes of any machine
SPACING = 2.0 * math.pi / COUNT  #: angle between two headings [rad]
RESOLVED = 0.07  #: standard deviation of the heading below which a single Gaussian takes over [rad]

_VECTORS = ("r_hat", "v_hat", "b_a_hat", "b_g_hat")


class Moments(NamedTuple):
    """Mean and covariance of a sum of Gaussians."""

    vectors: dict[str, Floats]  #: r_hat, v_hat, b_a_hat and b_g_hat (3,), slow_hat (n,)
    R_hat: Floats
    covariance: Floats  #: (15 + n, 15 + n)

    @property
    def heading_sigma(self) -> float:
        """Standard deviation of the heading [rad]."""
        return math.sqrt(self.covariance[8, 8])


def write_starts(engine: Engine, starts: list[FirstEstimate]) -> None:
    """Write first estimates into the lanes of an engine that has just been started."""
    fill = [starts[k % len(starts)] for k in range(engine.lanes)]
    engine.write("r_hat", np.array([s.position for s in fill]))
    engine.write("v_hat", np.array([s.velocity for s in fill]))
    engine.write("R_hat", np.array([s.R_BI for s in fill]))
    engine.write_covariances(np.array([s.covariance for s in fill]))


def _log_determinant(covariances: Floats) -> Floats:
    """Return the log determinant of each lane's covariance, without exactly known errors."""
    diagonal = np.diagonal(lower_factors(covariances), axis1=1, axis2=2)
    return 2.0 * np.log(np.where(diagonal > 0.0, diagonal, 1.0)).sum(axis=1)


def update_and_weigh(engine: Engine, measurement: Measurement, log_weights: Floats) -> Floats:
    """Update all lanes with a measurement; return their new weights, normalized."""
    before, failures = _log_determinant(engine.covariances()), engine.read("update_failures")
    engine.update(measurement)
    after = _log_determinant(engine.covariances())
    nis, dimension = engine.read("nis"), engine.read("nis_dimension")
    if not dimension.any() or not measured_blocks(measurement):
        return log_weights
    in_steps = np.isnan(nis)
    if in_steps.any():  # an image processed in steps: block by block
        blocks = engine.read("block_nis")[:, measured_blocks(measurement)]
        nis = np.where(in_steps, np.nansum(blocks, axis=1), nis)
    weights = log_weights - 0.5 * (nis + before - after)
    weights[engine.read("update_failures") > failures] = -np.inf
    if not np.isfinite(weights).any():
        return log_weights
    weights -= weights.max()
    return weights - math.log(np.exp(weights).sum())


def moments(engine: Engine, log_weights: Floats) -> Moments:
    """Return mean and covariance of all lanes; for the attitude, about a mean on the circle."""
    w, n = np.exp(log_weights), engine.slow_states
    R = engine.read("R_hat")
    R_mean, turns = R[int(np.argmax(w))], np.zeros((len(w), 3))
    for _ in range(10):
        turns = dcm_to_euler(R @ R_mean.T)
        R_mean = euler_to_dcm(w @ turns) @ R_mean
    turns = dcm_to_euler(R @ R_mean.T)  # yaw first, so that tilts add up as they are
    means = {name: w @ engine.read(name) for name in _VECTORS}
    slow = engine.read("slow_hat")[:, :n]
    means["slow_hat"] = w @ slow
    apart = [engine.read(name) - means[name] for name in _VECTORS]
    d = np.hstack([*apart[:2], turns, *apart[2:], slow - means["slow_hat"]])
    covariance = np.einsum("k,kij->ij", w, engine.covariances())
    covariance += np.einsum("k,ki,kj->ij", w, d, d)
    return Moments(means, R_mean, covariance)


def collapse(engine: Engine, log_weights: Floats, m: Moments) -> None:
    """Continue with one Gaussian with these moments; other memory comes from the likeliest lane."""
    engine.restore(engine.record(int(np.argmax(log_weights))))
    n = engine.slow_states
    for name in _VECTORS:
        engine.fill(name, m.vectors[name])
    engine.fill("R_hat", m.R_hat)
    if n:
        slow = engine.read("slow_hat")
        slow[:, :n] = m.vectors["slow_hat"]
        engine.write("slow_hat", slow)
    engine.write_covariances(np.repeat(m.covariance[np.newaxis], engine.lanes, axis=0))


# --------------------------------------------------------------------------------------------------
# The arguments of `initialize`, checked, and the first estimate that follows from them.
# --------------------------------------------------------------------------------------------------


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
    lost: bool = False
    """True: no heading is known, and the motion is to show it"""
    numbers: dict[str, float] = field(default_factory=dict)
    """parameters that differ from the suite's, for the start alone"""

    def write(self, engine: Engine) -> None:
        """Start the filters in an engine's memory."""
        engine.fill_block(POSITION_BLOCK, self.position_G)
        engine.fill_block(BASELINE_BLOCK, self.baseline_G)
        kept = engine.impose({"position_sigma_I": self.sigmas, **self.numbers})
        engine.start(self.x_I)
        engine.restore_noise(kept)
        if self.estimates:
            write_starts(engine, self.estimates)
            engine.fill("heading_lost", np.array(float(self.lost)))
        elif self.velocity_I is not None:
            engine.fill("v_hat", self.velocity_I)
            P, rows = engine.read("P"), range(V, V + 3)
            P[:, rows, rows] = np.square(self.speeds)
            engine.write("P", P)


def filter_start(sensors: SensorSuite, fix: FirstFix) -> FilterStart:
    """Return the start that follows from a first fix."""
    require_gnss(sensors, "initialize: start with set_state() instead")
    assert sensors.gnss is not None
    if fix.gnss_position_G is None:
        raise ValueError("gnss_position_G must be given, got None")
    names = ("gnss_position_G", "gnss_baseline_G", "gnss_sigma")
    measured = checked_measurement(sensors, {name: getattr(fix, name) for name in names})
    position = values_of(measured, "gnss_position", 1)[0]
    _require_relative(position)
    sigmas = np.array(sensors.gnss.position_sigma_I)
    if fix.gnss_sigma is not None:
        sigmas = sigmas_of(measured, "gnss_position").astype(np.float64)
    velocity, speeds = _first_velocity(sensors, fix)
    baseline = fix.gnss_baseline_G
    if baseline is not None:
        baseline = values_of(measured, "gnss_baseline", 1)[0]
    if baseline is not None and fix.accel is None:
        others = ("heading_sigma", "magnetometer", "magnetometer_sigma", "accel_sigma", "course")
        fix.refuse("not be given with gnss_baseline_G", *others)
        if sensors.estimator.initial_tilt_sigma is None:
            reason = "not be given with gnss_baseline_G: the suite has no initial_tilt_sigma"
            fix.refuse(reason, "tilt_sigma")
        x_I = np.zeros(3)
        if fix.heading is not None:
            x_I = level(check.angle("heading", fix.heading))[0]
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
    headed = fix.heading is not None or fix.magnetometer is not None or fix.course
    lost = not (headed or baseline is not None) and _waits_for_motion(sensors)
    if lost:
        found = [_without_heading(found[0], np.array(sensors.gnss.primary_antenna_B))]
    ahead = np.array([1.0, 0, 0])
    return FilterStart(position, sigmas, None, speeds, ahead, np.zeros(3), found, lost)


def _without_heading(first: FirstEstimate, arm_B: Floats) -> FirstEstimate:
    """Return a start whose position is uncertain by its antenna's lever arm, with no correlation.

    The heading is uniform on the circle, so the correlation with its error is not linear.
    """
    P = first.covariance.copy()
    apart, e = np.ones(len(P), bool), slice(6, 9)
    apart[e] = False
    P[apart, e] = P[e, apart] = 0.0
    P[range(2), range(2)] += arm_B @ arm_B
    return first._replace(covariance=P)


def _waits_for_motion(sensors: SensorSuite) -> bool:
    """Return True if one filter waits for its heading: no camera needs to weigh headings."""
    return sensors.heading_by_motion > 0 and sensors.camera is None


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
        start["heading_sigma"] = check.angle_size("heading_sigma", fix.heading_sigma)
    known, failure = empty_fix(sensors), ""
    if fix.heading is not None:
        known["heading"] = check.angle("heading", fix.heading)
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
    elif _waits_for_motion(sensors):
        start["heading_sigma"] = UNKNOWN
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
