"""The smoother against least squares over a whole trajectory, and against simulated truth."""

import json

import numpy as np
import pytest
from scipy.stats import chi2

from quad_gym.estimation import read_log, replay, smooth
from quad_gym.params.suites import CONSUMER
from quad_gym.rotations import quaternion_to_dcm
from tests.console_commands import run
from tests.filter_states import at_rest
from tests.logged_flights import PX4, RTK, Recorded, errors_in_replay, flown
from tests.reference_aids import cross_matrix

G = 9.8
E3 = np.array([0.0, 0.0, G])


LINEAR = RTK.replace(
    camera=None,
    gnss=RTK.gnss.replace(primary_antenna_B=(0.0, 0.0, 0.0), secondary_antenna_B=None),
    imu=RTK.imu.replace(
        **dict.fromkeys(("accel_vibration", "gyro_vibration"), 0.0),
        **dict.fromkeys(("accel_scale_sigma", "accel_misalignment_sigma"), 0.0),
        accel_bias_tau=2.0,
        gyro_bias_tau=3.0,
    ),
    estimator=RTK.estimator.replace(false_alarm_probability=0.0, recursive_update_threshold=None),
)
"""Sensors whose model is linear near rest."""
DT, STEPS, EVERY = 0.02, 64, 8
P0 = np.diag(np.repeat([0.1, 0.1, 0.001, 0.02, 0.0005], 3) ** 2)


def log_at_rest():
    rng, n = np.random.default_rng(3), STEPS + 1
    time = DT * np.arange(n)
    table = {
        "time": time,
        "gyro": 1e-4 * rng.normal(size=(n, 3)),
        "accel": E3 + 0.02 * rng.normal(size=(n, 3)),
        "gnss_enu": 0.02 * rng.normal(size=(n, 3)),
    }
    table["gnss_enu"][np.arange(n) % EVERY > 0] = np.nan
    table["gnss_enu"][0] = np.nan
    return table


def least_squares(table):
    """Solve the normal equations of all states at once; return means and covariances."""
    imu = LINEAR.imu
    F = np.eye(15)
    F[6:9, 12:15] = -DT * np.eye(3)
    of_states = {
        6: -cross_matrix(E3),
        9: -np.eye(3),
        12: 0.5 * DT * cross_matrix(E3),
    }  # d(accel)/d(state)
    for column, block in of_states.items():
        F[0:3, column : column + 3] = 0.5 * DT**2 * block
        F[3:6, column : column + 3] = DT * block
    F[0:3, 3:6] = DT * np.eye(3)
    noise = np.zeros((15, 12))
    acceleration = imu.accel_noise_density / np.sqrt(DT) * np.eye(3)
    rate = imu.gyro_noise_density / np.sqrt(DT) * np.eye(3)
    noise[0:3, 0:3], noise[3:6, 0:3] = 0.5 * DT**2 * acceleration, DT * acceleration
    noise[3:6, 3:6], noise[6:9, 3:6] = 0.5 * DT**2 * cross_matrix(E3) @ rate, -DT * rate
    noise[0:3, 3:6] = 0.5 * DT * noise[3:6, 3:6]
    for k, (tau, sigma) in enumerate(
        ((imu.accel_bias_tau, imu.accel_bias_sigma), (imu.gyro_bias_tau, imu.gyro_bias_sigma))
    ):
        at = slice(9 + 3 * k, 12 + 3 * k)
        decay = np.exp(-DT / tau)
        F[at] *= decay
        noise[at, 6 + 3 * k : 9 + 3 * k] = sigma * np.sqrt(1.0 - decay**2) * np.eye(3)
    # white noise of 1e-8 m on the position is small compared with the bound below
    W = np.linalg.inv(np.linalg.cholesky(noise @ noise.T + np.diag([1e-16] * 3 + [0.0] * 12)))
    size = 15 * (STEPS + 1)
    A, b = [], []
    prior = np.zeros((15, size))
    prior[:, :15] = np.diag(1.0 / np.sqrt(np.diag(P0)))
    A.append(prior)
    b.append(np.zeros(15))
    for k in range(1, STEPS + 1):
        row = np.zeros((15, size))
        row[:, 15 * (k - 1) : 15 * k], row[:, 15 * k : 15 * (k + 1)] = -W @ F, W
        u = np.zeros(15)
        force = table["accel"][k] - E3
        u[0:3], u[3:6], u[6:9] = 0.5 * DT**2 * force, DT * force, DT * table["gyro"][k]
        A.append(row)
        b.append(W @ u)
        if np.isfinite(table["gnss_enu"][k]).all():
            weight = np.diag(1.0 / np.array(LINEAR.gnss.position_sigma_I))
            row = np.zeros((3, size))
            row[:, 15 * k : 15 * k + 3] = weight
            A.append(row)
            b.append(weight @ table["gnss_enu"][k])
    A, b = np.vstack(A), np.concatenate(b)
    units = np.linalg.norm(A, axis=0)
    Q, R = np.linalg.qr(A / units)
    inverse = np.linalg.inv(R)
    x = (inverse @ (Q.T @ b) / units).reshape(-1, 15)
    P = inverse @ inverse.T / units / units[:, np.newaxis]
    blocks = [P[15 * k : 15 * k + 15, 15 * k : 15 * k + 15] for k in range(STEPS + 1)]
    return x, np.array(blocks)


@pytest.mark.parametrize("estimator", ["ukf", "ekf"])
def test_linear_case_equals_least_squares(estimator):
    """Means agree within 0.2 % of the standard deviations, covariances within 0.2 %."""
    table = log_at_rest()
    start = at_rest(covariance=P0, time=0.0)
    result = smooth(table, sensors=LINEAR, estimator=estimator, start=start)
    x, P = least_squares(table)
    assert len(result) == len(x)
    R = quaternion_to_dcm(result.quaternion)
    angles = 0.5 * np.stack([R[:, i, j] - R[:, j, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    found = np.hstack(
        [result.position, result.velocity, angles, result.accel_bias, result.gyro_bias]
    )
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    scales = sigma[:, :, np.newaxis] * sigma[:, np.newaxis]
    assert abs((found - x) / sigma).max() < 0.002
    assert abs((result.covariance - P) / scales).max() < 0.002


SEEDS, APART = range(20, 23), 2.0


def root_mean_squares(errors):
    return np.sqrt((errors**2).mean(axis=0).reshape(3, 3).sum(axis=1))


@pytest.fixture(scope="module")
def flights():
    """Return errors of filter and smoother for late, lost and irregular data, smoothed and logs."""
    found = []
    for seed in SEEDS:
        recorded = Recorded(flown(PX4, 8.0, seed=seed), PX4, seed=seed)
        log = read_log(recorded.table())
        results = [f(log, sensors=PX4) for f in (replay, smooth)]
        errors = [
            errors_in_replay(recorded, r, np.rint(r.time * PX4.imu.rate).astype(int))
            for r in results
        ]
        found.append((*errors, results[1], log))
    return found


def test_smoothed_errors_are_smaller(flights):
    filtered, smoothed = (np.concatenate(errors) for errors in list(zip(*flights, strict=True))[:2])
    ratio = root_mean_squares(smoothed) / root_mean_squares(filtered)
    assert (ratio < [0.6, 0.5, 0.6]).all()


def test_smoothed_errors_are_consistent(flights):
    """The NEES of nine states, sampled every two seconds, is in its 99.8 % interval."""
    nees = []
    for _, errors, result, _ in flights:
        for time in np.arange(result.time[0] + 0.5, result.time[-1], APART):
            k = np.searchsorted(result.time, time)
            nees.append(errors[k] @ np.linalg.solve(result.covariance[k, :9, :9], errors[k]))
    low, high = chi2.ppf([0.001, 0.999], 9 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_covariances_are_positive(flights):
    for _, _, result, _ in flights:
        units = result.sigma[:, :, np.newaxis] * result.sigma[:, np.newaxis]
        assert np.linalg.eigvalsh(result.covariance / units).min() > 0.0
        assert np.isfinite(result.difference).mean() > 0.95


def test_covariances_are_positive_after_large_first_corrections():
    """GNSS drift starts with zero variance, and the first magnetic headings have large errors."""
    suite = CONSUMER.replace(barometer=PX4.barometer, magnetometer=PX4.magnetometer)
    result = smooth(Recorded(flown(suite, 2.0, seed=42), suite, seed=42).table(), sensors=suite)
    units = result.sigma[:, :, np.newaxis] * result.sigma[:, np.newaxis]
    assert np.linalg.eigvalsh(result.covariance / units).min() > 0.0


def test_differences_are_consistent_for_the_right_suite_only(flights):
    shares = np.mean([list(result.consistency().values()) for _, _, result, _ in flights], axis=0)
    assert shares.max() < 0.05
    gnss = PX4.gnss.replace(position_sigma_I=(0.002, 0.002, 0.004), velocity_sigma=0.01)
    quiet = PX4.replace(gnss=gnss, estimator=PX4.estimator.replace(false_alarm_probability=0.0))
    wrong = smooth(flights[0][-1], sensors=quiet).consistency()
    assert min(list(wrong.values())[:6]) > 0.2


def test_command_writes_the_smoothed_trajectory(tmp_path):
    recorded = Recorded(flown(RTK, 3.0), RTK)
    recorded.write_csv(tmp_path / "flight.csv")
    options = ("--sensors", "rtk", "--smooth", "--no-figure", "--output", "out")
    ended = run("replay", "flight.csv", *options, where=tmp_path)
    assert ended.returncode == 0, ended.stderr
    table = np.genfromtxt(tmp_path / "out" / "smoothed.csv", delimiter=",", names=True)
    result = smooth(tmp_path / "flight.csv", sensors=RTK)
    for name, column in result.columns().items():
        assert np.allclose(table[name], column, rtol=0.0, atol=1e-12), name
    written = json.loads((tmp_path / "out" / "replay.json").read_text())
    assert written["smoothed"] == pytest.approx(result.consistency())
