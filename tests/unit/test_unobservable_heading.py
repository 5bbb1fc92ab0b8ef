"""Flow and range show no heading: filters gain no information about it.

A rotation about the vertical, n = (z x r, z x v, R_BI z, 0, 0) in errors of r, v, e, b_a, b_g, and
horizontal translations change no measurement.
"""

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.params.vehicle import vehicle_params
from quad_gym.rotations import euler_to_dcm
from tests.field_flights import attitudes, fly, nees
from tests.reference_aids import cross_matrix

pytestmark = pytest.mark.filterwarnings("ignore:InitialPoseParams.heading_sigma")

SUITE = quad_gym.sensor_suite("crazyflie").simplified()
SIGMA, GRAVITY = 0.2, 9.80665
GROUND = quad_gym.WorldParams().ground_height


def min_heading_sigmas(r, v, R_BI, dt):
    """Standard deviations of the heading by a Kalman filter that is linearized at the truth.

    Its errors (r, v, theta, b_a, b_g) have the attitude in I; it measures in every second tick.
    """
    imu, pose = SUITE.imu, SUITE.initial_pose
    drives = (imu.accel_bias_sigma, imu.gyro_bias_sigma)
    starts = (pose.position_sigma, 0.03, SUITE.estimator.initial_tilt_sigma, *drives)
    P = np.diag(np.repeat(starts, 3)) ** 2
    P[8, 8] = SIGMA**2
    noise = np.repeat([0.0, imu.accel_noise_density, imu.gyro_noise_density, 0.0, 0.0], 3) ** 2
    R_noise = np.diag([SUITE.optical_flow.noise_sigma] * 2 + [SUITE.range_finder.noise_sigma]) ** 2
    sigmas = []
    for k in range(len(r)):
        sigmas.append(np.sqrt(P[8, 8]))
        if k % 2 == 0:
            V_B, h, u = R_BI[k] @ v[k], r[k, 2] - GROUND, R_BI[k][2, 2]
            dV = np.hstack([np.zeros((3, 3)), R_BI[k], R_BI[k] @ cross_matrix(v[k])])
            dh, du = np.eye(9)[2], np.zeros(9)
            du[6:9] = np.cross(R_BI[k][2], (0.0, 0.0, 1.0))
            H = np.zeros((3, 15))
            H[:2, :9] = u / h * dV[:2] + np.outer(V_B[:2], du / h - u / h**2 * dh)
            H[2, :9] = dh / u - h / u**2 * du
            K = np.linalg.solve(H @ P @ H.T + R_noise, H @ P).T
            P = P - K @ H @ P
        if k + 1 < len(r):
            f_I = (v[k + 1] - v[k]) / dt + [0.0, 0.0, GRAVITY]
            F = np.eye(15)
            F[0:3, 3:6] = dt * np.eye(3)
            F[3:6, 6:9], F[3:6, 9:12] = -dt * cross_matrix(f_I), -dt * R_BI[k].T
            F[6:9, 12:15] = -dt * R_BI[k].T
            P = F @ P @ F.T + dt * np.diag(noise)
    return np.array(sigmas)


def heading_sigmas(batch):
    z_B = batch.record("R_hat")[:, :, 2]
    return np.sqrt(np.einsum("ni,nij,nj->n", z_B, batch.covariance()[:, 6:9, 6:9], z_B))


def require_least_heading_sigmas(suite, task, count, ticks):
    batch, rows, ours = fly(suite, count, task=task, start="hover"), [], []
    for _ in range(ticks):
        rows.append([batch.record("r"), batch.record("v"), attitudes(batch.record("q"))])
        ours.append(heading_sigmas(batch))
        batch.step()
    dt = 1.0 / suite.imu.rate
    for k in range(count):
        r, v, R_BI = (np.array([row[i][k] for row in rows]) for i in range(3))
        least = min_heading_sigmas(r, v, R_BI, dt)
        assert least[-1] > 0.9 * SIGMA  # a known velocity of the start shows some heading
        np.testing.assert_array_less(0.99 * least, np.array(ours)[:, k])
        np.testing.assert_array_less(np.array(ours)[:, k], 1.1 * least)


def suite_of(kind):
    return SUITE.replace(
        initial_pose=SUITE.initial_pose.replace(heading_sigma=SIGMA),
        estimator=SUITE.estimator.replace(kind=kind),
    )


@pytest.mark.parametrize("late", [False, True], ids=["prompt", "late"])
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("task", ["circle", "random_trajectory"])
def test_heading_sigma_in_flight_is_at_least_that_of_a_filter_at_the_truth(task, kind, late):
    suite = suite_of(kind)
    if late:
        suite = suite.replace(
            optical_flow=suite.optical_flow.replace(latency=0.02),
            range_finder=suite.range_finder.replace(latency=0.04),
        )
    require_least_heading_sigmas(suite, task, 8, 800)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("task", ["circle", "random_trajectory"])
def test_heading_sigma_in_a_minute_is_at_least_that_of_a_filter_at_the_truth(task, kind):
    require_least_heading_sigmas(suite_of(kind), task, 4, 12000)


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_filter_with_a_vague_heading_is_consistent(kind):
    """The mean of 150 NEES of three states has a standard deviation of 0.2, of 15 states 0.45.

    The errors of position and velocity are on arcs: without these, 15 states have 41 and 53.
    """
    batch = fly(
        suite_of(kind), 150, task="circle", start="hover", vehicle=vehicle_params("crazyflie")
    )
    for _ in range(800):
        batch.step()
    for block in (slice(0, 3), slice(3, 6), slice(6, 9)):
        assert nees(batch, block).mean() == pytest.approx(3.0, abs=0.8)
    assert nees(batch).mean() == pytest.approx(15.0, abs=2.0)


def variance_along_rotation(kf):
    """Variance of the rotation n, from the information about it and horizontal translations.

    The covariance is that of the linear model, without the second order of the heading's error.
    """
    P, N = kf._engine.covariances()[0, :15, :15], np.zeros((15, 3))
    z = np.array([0.0, 0.0, 1.0])
    N[:, 0] = np.concatenate(
        [np.cross(z, kf.position), np.cross(z, kf.velocity), kf.R_BI @ z, z, z]
    )
    N[9:, 0], N[0, 1], N[1, 2] = 0.0, 1.0, 1.0
    return np.linalg.inv(N.T @ np.linalg.solve(P, N))[0, 0]


@pytest.mark.parametrize(
    ("kind", "tolerance"), [(ExtendedKalmanFilter, 1e-7), (UnscentedKalmanFilter, 1e-3)]
)
def test_large_corrections_give_no_information_about_the_rotation(kind, tolerance):
    """The measurements are processed in steps. The UKF shifts the velocity to second order."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        kf = kind(SUITE.replace(estimator=SUITE.estimator.replace(false_alarm_probability=0.0)))
        factor = 0.1 * rng.normal(size=(15, 15)) + 0.1 * np.eye(15)
        covariance = factor @ factor.T * np.outer(*[np.repeat([1.0, 1.0, 0.5, 1.0, 0.1], 3)] * 2)
        kf.set_state(
            position=rng.normal((0.0, 0.0, 2.0)),
            velocity=rng.normal(size=3),
            R_BI=euler_to_dcm(rng.uniform(-0.8, 0.8, 3)),
            accel_bias=np.zeros(3),
            gyro_bias=np.zeros(3),
            covariance=covariance,
        )
        gyro, accel = rng.normal(size=3), rng.normal((0.0, 0.0, 9.8))
        kf.predict(gyro, accel)
        before = variance_along_rotation(kf)
        v = kf.velocity
        kf.update(optical_flow=rng.normal(size=2), range_finder=1.5)
        assert np.linalg.norm(kf.velocity - v) > 0.01
        assert np.isnan(kf.nis[0])  # as several updates have no common NIS
        kf.predict(gyro, accel)
        assert variance_along_rotation(kf) > before * (1.0 - tolerance)
