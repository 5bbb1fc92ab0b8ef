"""The error-state EKF equals the textbook filter, and its Jacobians match the models."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.records import FEATURE_SLICE
from quad_gym.rotations import dcm_to_euler, euler_to_dcm
from tests.reference_ukf import PlainEKF
from tests.unit.test_ukf import LAB, assert_equal, compare, estimator

MIDPOINT = {"integration": "midpoint", "attitude_reset": True}


@pytest.mark.parametrize(
    "choices",
    [
        {},
        {"bearing_noise_at": "predicted"},
        {"integration": "midpoint"},
        {"attitude_reset": True},
        MIDPOINT,
        {"direction_variance_floor": 1e-6, "gravity": 9.81},
    ],
    ids=str,
)
def test_ekf_equals_plain_filter(choices):
    classes = {"filter_class": ExtendedKalmanFilter, "plain_class": PlainEKF}
    worst, cases = compare(estimator(**choices), 40, seed=4, **classes)
    assert_equal(worst)
    assert len(cases) > 3


def started(sensors, filter_class, seed, covariance=None):
    """Return a filter at a random state."""
    rng = np.random.default_rng(seed)
    ukf = filter_class(sensors)
    sigmas = np.repeat([0.01, 0.02, 0.01, 0.05, 0.001], 3)
    mix = np.linalg.qr(rng.normal(size=(15, 15)))[0]
    P = (mix * np.linspace(0.3, 1.7, 15)) @ mix.T * np.outer(sigmas, sigmas)
    ukf.set_state(
        position=rng.normal(size=3),
        velocity=rng.normal(size=3),
        R_BI=Rotation.random(rng=rng).as_matrix(),
        accel_bias=rng.normal(0.0, 0.3, 3),
        gyro_bias=rng.normal(0.0, 0.01, 3),
        covariance=P if covariance is None else covariance,
    )
    return ukf


def exact_motion(state, error, noise, gyro, accel, imu):
    """Return the state after a tick of constant rates and constant force in the halfway frame.

    Args:
        state: position, velocity, R_BI, accel_bias, gyro_bias.
        error: (15,) errors of r, v, e, b_a, b_g.
        noise: (6,) noise of gyro and accelerometer.
    """
    dt = imu.dt
    r, v = state[0] + error[:3], state[1] + error[3:6]
    R_BI = euler_to_dcm(error[6:9]) @ state[2]
    b_a, b_g = state[3] + error[9:12], state[4] + error[12:]
    turn = dt * (gyro - b_g - noise[:3])
    halfway = Rotation.from_rotvec(-turn / 2.0).as_matrix() @ R_BI
    a_I = halfway.T @ (accel - b_a - noise[3:]) - [0.0, 0.0, 9.8]
    after = Rotation.from_rotvec(-turn).as_matrix() @ R_BI
    decays = np.exp(-dt / imu.accel_bias_tau), np.exp(-dt / imu.gyro_bias_tau)
    return r + dt * v + dt**2 / 2 * a_I, v + dt * a_I, after, decays[0] * b_a, decays[1] * b_g


def difference(moved, reference):
    """Return error coordinates (15,) of one state about another."""
    e = dcm_to_euler(moved[2] @ reference[2].T)
    parts = [m - r for m, r in zip(moved, reference, strict=True)]
    return np.concatenate([parts[0], parts[1], e, parts[3], parts[4]])


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, UnscentedKalmanFilter])
@pytest.mark.parametrize("seed", range(5))
def test_midpoint_prediction_is_the_linearized_exact_motion(seed, kind):
    """The covariance is F P F^T + G Q G^T, with F and G by finite differences on the manifold."""
    sensors = LAB.replace(estimator=LAB.estimator.replace(**MIDPOINT))
    ukf, imu = started(sensors, kind, seed), sensors.imu
    rng = np.random.default_rng(seed)
    gyro, accel = rng.normal(0.0, 3.0, 3), rng.normal((0.0, 0.0, 9.8), 2.0)
    P = 1e-4 * ukf.covariance  # small, so that second-order terms of the UKF vanish
    state = (ukf.position, ukf.velocity, ukf.R_BI, ukf.accel_bias, ukf.gyro_bias)
    names = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias")
    ukf.set_state(**dict(zip(names, state, strict=True)), covariance=P)

    def move(x):
        return exact_motion(state, x[:15], x[15:], gyro, accel, imu)

    center, h = move(np.zeros(21)), 1e-6
    J = np.stack(
        [
            (difference(move(step), center) - difference(move(-step), center)) / (2 * h)
            for step in h * np.eye(21)
        ],
        axis=1,
    )
    sigmas = np.repeat([imu.gyro_noise_density, imu.accel_noise_density], 3) / np.sqrt(imu.dt)
    drives = [
        sigma * np.sqrt(1.0 - np.exp(-2.0 * imu.dt / tau))
        for sigma, tau in (
            (imu.accel_bias_sigma, imu.accel_bias_tau),
            (imu.gyro_bias_sigma, imu.gyro_bias_tau),
        )
    ]
    drive = np.diag(np.repeat([0.0, 0.0, 0.0, *drives], 3)) ** 2
    expected = J @ block_diag(P, np.diag(sigmas**2)) @ J.T + drive
    ukf.predict(gyro, accel)
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        ukf.covariance / np.outer(sd, sd), expected / np.outer(sd, sd), rtol=0.0, atol=3e-4
    )
    got = (ukf.position, ukf.velocity, ukf.R_BI, ukf.accel_bias, ukf.gyro_bias)
    for one, other in zip(got, center, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("turn", [False, True])
def test_attitude_reset_rotates_covariance_with_the_error_angles(turn):
    """The reference is a finite difference of the new error angles after a large correction."""
    sensors = LAB.replace(camera=None).replace(
        estimator=LAB.estimator.replace(attitude_reset=turn, initial_velocity_variance=1.0)
    )
    for seed in range(5):
        plain = started(sensors.replace(estimator=LAB.estimator), ExtendedKalmanFilter, seed)
        P = plain.covariance
        P[6:9, :] *= 30.0
        P[:, 6:9] *= 30.0
        plain = started(sensors.replace(estimator=LAB.estimator), ExtendedKalmanFilter, seed, P)
        other = started(sensors, ExtendedKalmanFilter, seed, P)
        before = plain.R_BI
        R_IG = quad_gym.frames.ecef_to_enu(sensors.gnss.reference_antenna_G)
        seen = euler_to_dcm([0.3, -0.2, 0.4]) @ before
        baseline_G = R_IG.T @ seen.T @ sensors.gnss.baseline_B
        for ekf in (plain, other):
            ekf.update(gnss_baseline_G=baseline_G)
        m = dcm_to_euler(plain.R_BI @ before.T)
        assert np.linalg.norm(m) > 0.1

        def renewed(e, m=m):
            return dcm_to_euler(euler_to_dcm(m + e) @ euler_to_dcm(m).T)

        h, T = 1e-6, np.eye(15)
        T[6:9, 6:9] = np.stack(
            [(renewed(step) - renewed(-step)) / (2 * h) for step in h * np.eye(3)], axis=1
        )
        expected = T @ plain.covariance @ T.T if turn else plain.covariance
        sd = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            other.covariance / np.outer(sd, sd), expected / np.outer(sd, sd), rtol=0.0, atol=1e-8
        )
        np.testing.assert_array_equal(other.R_BI, plain.R_BI)


def test_batch_estimates_equal_extended_kalman_filter_class():
    sensors = LAB.replace(estimator=LAB.estimator.replace(kind="ekf", **MIDPOINT))
    batch = quad_gym.FlightBatch(1, sensors=sensors)
    batch.reset(seeds=[5])
    read = lambda name: batch.record(name)[0]  # noqa: E731
    ekf = ExtendedKalmanFilter(sensors)
    ekf.initialize(read("gnss_position"), read("gnss_baseline"))
    for _ in range(50):
        seen = read("block_valid")[FEATURE_SLICE][:2, np.newaxis] > 0.0
        pixels = np.where(seen, read("pixels")[:2], np.nan)
        ekf.update(read("gnss_position"), read("gnss_baseline"), pixels)
        np.testing.assert_allclose(ekf.position, read("r_hat"), rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(ekf.R_BI, read("R_hat"), rtol=0.0, atol=1e-11)
        gyro, accel = read("gyro"), read("accel")
        batch.step()
        ekf.predict(gyro, accel)
