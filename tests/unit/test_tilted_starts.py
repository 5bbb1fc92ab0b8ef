"""Starts of a vehicle that rests on a slope: roll and pitch from the accelerometer."""

import math

import numpy as np
import pytest

from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.estimation.starts import level_start, rest, still_start
from quad_gym.rotations import euler_to_dcm
from tests.level_flights import GRAVITY, MAGNETIC, R_IG, LevelFlight
from tests.unit.test_filter_starts import share

SAMPLES = 100
"""Number of accelerometer samples in a mean."""
WHITE = MAGNETIC.imu.accel_noise_density / math.sqrt(MAGNETIC.imu.dt * SAMPLES)
BASELINE = MAGNETIC.gnss.baseline_B
FIX = np.zeros(3)
UPRIGHT = MAGNETIC.gnss.replace(
    primary_antenna_B=(0.0, 0.0, 0.0), secondary_antenna_B=(0.0, 0.0, 0.2)
)


def resting(seed, roll=0.6, pitch=-0.4):
    """Return a vehicle at rest on a steep slope, with a random heading."""
    flight = LevelFlight(MAGNETIC, np.random.default_rng(seed), amplitude=0.0)
    flight.R = euler_to_dcm([roll, pitch, flight.yaw])
    return flight


def force(flight, white=WHITE):
    return flight.R @ [0.0, 0.0, GRAVITY] + flight.b_a + flight.rng.normal(0.0, white, 3)


def nose(R):
    """Return the heading of the body x axis."""
    return math.atan2(R[0, 1], R[0, 0])


def start(kf, flight, how):
    position, _ = flight.gnss(0.0)
    given = {}
    if how == "heading":
        given = {"heading": nose(flight.R) + flight.rng.normal(0.0, 0.05), "heading_sigma": 0.05}
    elif how == "magnetometer":
        given = {"magnetometer": flight.field()}
    elif how == "baseline":
        u = flight.R.T @ BASELINE / np.linalg.norm(BASELINE)
        noise = flight.rng.normal(0.0, MAGNETIC.gnss.first_baseline_sigma, 3)
        given = {"gnss_baseline_G": R_IG.T @ (u + noise - u * (u @ noise))}
    elif how == "course":
        angle = nose(flight.R) + flight.rng.normal(0.0, 0.1)
        flight.drift = 6.0 * np.array([math.cos(angle), math.sin(angle), 0.0])
        flight.speed = np.zeros(3)
        given = {"gnss_velocity_G": flight.gnss(0.0)[1], "course": True, "heading_sigma": 0.1}
    kf.initialize(position, accel=force(flight), accel_sigma=WHITE, **given)
    return kf


@pytest.mark.parametrize("how", ["heading", "magnetometer", "baseline", "course"])
def test_errors_of_a_tilted_start_match_the_covariance(how):
    """The mean NEES over 300 draws, of the state and three parts, is in its 99.9 % interval."""
    squares, kf = [], UnscentedKalmanFilter(MAGNETIC)
    for seed in range(300):
        flight = resting(seed)
        start(kf, flight, how)
        error, P = flight.error(kf, 0.0), kf.covariance
        parts = [slice(0, 15), slice(0, 3), slice(3, 6), slice(6, 9)]
        squares.append([error[i] @ np.linalg.solve(P[i, i], error[i]) for i in parts])
    for mean, dimension in zip(np.mean(squares, axis=0), (15, 3, 3, 3), strict=True):
        low, high = share(dimension, 300)
        assert low < mean < high
    assert kf.heading_known


@pytest.mark.parametrize("how", ["heading", "magnetometer", "baseline"])
def test_without_errors_the_attitude_is_exact(how):
    flight = resting(1)
    flight.b_a, flight.iron, flight.turn = np.zeros(3), np.zeros(3), 0.0
    given = {
        "heading": {"heading": nose(flight.R)},
        "magnetometer": {"magnetometer": flight.R @ MAGNETIC.magnetometer.field_I},
        "baseline": {"gnss_baseline_G": R_IG.T @ flight.R.T @ BASELINE},
    }[how]
    kf = ExtendedKalmanFilter(MAGNETIC)
    kf.initialize(FIX, accel=force(flight, white=0.0), **given)
    np.testing.assert_allclose(kf.R_BI, flight.R, atol=1e-12)
    antenna = kf.position + kf.R_BI.T @ MAGNETIC.gnss.primary_antenna_B
    np.testing.assert_allclose(antenna, 0.0, atol=1e-12)


def test_level_and_resting_starts_of_a_level_vehicle_agree():
    level, resting = UnscentedKalmanFilter(MAGNETIC), UnscentedKalmanFilter(MAGNETIC)
    level.initialize(FIX, heading=0.7)
    resting.initialize(FIX, heading=0.7, accel=[0.0, 0.0, GRAVITY])
    np.testing.assert_allclose(resting.R_BI, level.R_BI, atol=1e-15)
    np.testing.assert_allclose(resting.position, level.position, atol=1e-15)
    claimed = math.sqrt(resting.covariance[6, 6]) * GRAVITY
    imu = MAGNETIC.imu
    one_sample = imu.accel_noise_density / math.sqrt(imu.dt)
    assert claimed == pytest.approx(math.hypot(imu.accel_bias_sigma, one_sample), rel=2e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_tilt_has_the_third_order_of_the_heading(axis):
    """An error psi of the heading turns a steep vehicle by psi^3 / 6 sin(inclination), too.

    The sixth moment of a normal number is 15 sigma^6. Body axis `axis` is inclined; the second
    order of psi is about the level axis across it.
    """
    sigma, turn, incline = 0.01, 0.5, 0.6
    k = np.array([0.0, 0.0, math.sqrt(1.0 - incline**2)])
    k[axis] = incline
    first = level_start(MAGNETIC)
    rest(first, GRAVITY * k, sigma * GRAVITY, GRAVITY)
    first["heading_sigma"] = turn
    P, T = still_start(first, np.zeros(3)).covariance[6:9, 6:9], first["T"][0]
    bias = MAGNETIC.imu.accel_bias_sigma / GRAVITY
    expected = sigma**2 + bias**2 * (1.0 + turn**2) + 15.0 * turn**6 / 36.0 * incline**2
    assert (T.T @ P @ T)[axis, axis] == pytest.approx(expected, rel=1e-12)


def test_magnetic_heading_depends_on_both_angles_of_the_tilt():
    """Error angles are e_x, e_y and a e_x + b e_y + e_z, with independent e_x, e_y and e_z."""
    first, tilt, slopes = level_start(MAGNETIC), 0.02, (0.4, -1.5)
    first["tilt_sigma"], first["heading_sigma"], first["heading_of_tilt"] = tilt, 0.05, slopes
    P = still_start(first, np.zeros(3)).covariance[6:9, 6:9]
    J = np.array([(1.0, 0.0), (0.0, 1.0), slopes])
    expected = tilt**2 * J @ J.T + np.diag([0.0, 0.0, 0.05**2])
    np.testing.assert_allclose(P, expected, rtol=1e-12, atol=1e-18)


REST = {"accel": [0.0, 0.0, GRAVITY]}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"accel": [0.0, 0.0, 12.0]}, "accel must be from a vehicle at rest"),
        ({"accel": [0.0, 0.0, 0.0]}, "accel must be from a vehicle at rest"),
        ({"accel": [GRAVITY, 0.0, 0.0]}, "x axis is not vertical"),
        ({"accel": [0.0, GRAVITY]}, "accel must have shape"),
        ({"accel_sigma": 0.1}, "accel_sigma must come with accel"),
        ({**REST, "accel_sigma": 0.0}, "accel_sigma"),
        ({**REST, "tilt_sigma": 0.1}, "tilt_sigma must not be given with"),
        ({**REST, "gnss_baseline_G": [0.1, 0.0, 0.0], "heading": 0.1}, "got heading and gnss_bas"),
        ({**REST, "gnss_baseline_G": R_IG.T @ [0, 0, 0.2]}, "within 12 degrees of the vertical"),
    ],
)
def test_bad_tilted_starts_raise(given, message):
    kf = UnscentedKalmanFilter(MAGNETIC.replace(gnss=UPRIGHT))
    with pytest.raises(ValueError, match=message):
        kf.initialize(FIX, **given)
