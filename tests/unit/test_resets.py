"""Protection of the filter: resets, adaptation of noise, and that neither does harm."""

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quad_gym
import quad_gym.frames
from quad_gym.estimation import replay
from quad_gym.records import (
    AID_GROUPS,
    BASELINE_BLOCK,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    Aid,
    GateDecision,
)
from quad_gym.rotations import euler_to_dcm
from tests.field_flights import fly, state_errors, steps
from tests.filter_states import set_at_rest
from tests.level_flights import MAGNETIC

R_BI = Rotation.from_rotvec([-0.2, 0.4, -0.1]).as_matrix()
SUITE = quad_gym.sensor_suite("rtk").simplified().replace(camera=None)
R_IG = quad_gym.frames.ecef_to_enu(SUITE.gnss.reference_antenna_G)
FLIGHTS = Path(__file__).parents[1] / "data" / "flights"
CIRCLE, HOBBY = FLIGHTS / "crazyflie_circle.csv.gz", FLIGHTS / "ardupilot.csv.gz"


def started(deviations, seed=0):
    """A filter whose states are correlated, with given standard deviations."""
    ukf = quad_gym.UnscentedKalmanFilter(SUITE)
    rng = np.random.default_rng(seed)
    mixed = np.eye(15) + 0.3 * rng.standard_normal((15, 15))
    P = mixed @ mixed.T
    scaled = np.array(deviations) / np.sqrt(np.diag(P))
    set_at_rest(ukf, P * np.outer(scaled, scaled), R_BI=R_BI)
    return ukf


def refused_for_long(ukf, block, *, stepped):
    """Let a filter have refused the measurements of a block for too long."""
    blocks = ukf._engine.blocks
    blocks["tick"] += 2.0 * SUITE.estimator.glitch_timeout * SUITE.imu.rate
    blocks["accepted_tick"][:] = 0.0
    blocks["rejected_in_row"][:, block] = 20.0
    blocks["stepped"][:, block] = stepped


def refuse(ukf, off, *, stepped, corrected=0.0):
    """Update with a velocity that is `off` [m/s], after velocities were refused for too long.

    The biases have been `corrected` by this much [m/s^2], [rad/s] before.
    """
    refused_for_long(ukf, VELOCITY_BLOCK, stepped=stepped)
    blocks = ukf._engine.blocks
    blocks["corrected"][:], blocks["corrected_tick"][:] = corrected, blocks["tick"]
    lever = np.cross(ukf._engine.read("w_meas")[0] - ukf.gyro_bias, SUITE.gnss.primary_antenna_B)
    expected = ukf.velocity + ukf.R_BI.T @ lever
    ukf.update(gnss_velocity_G=R_IG.T @ (expected + off))


def cut(P, rows):
    """P without the covariances of some states."""
    kept = P.copy()
    kept[rows], kept[:, rows] = 0.0, 0.0
    kept[rows, rows] = P[rows, rows]
    return kept


def assert_close(covariance, expected):
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )


DEVIATIONS = np.repeat([0.1, 0.05, 0.01, 0.002, 1e-4], 3)


@pytest.mark.parametrize("compass_out", [0.0, 1.0])
def test_reset_after_a_step_sets_variances_of_the_measured_states_alone(compass_out):
    """A compass that is left out does not matter."""
    ukf, off = started(DEVIATIONS), np.array([5.0, -3.0, 2.0])
    ukf._engine.blocks["compass_out"] = compass_out
    before = ukf.covariance
    refuse(ukf, off, stepped=True)
    rows = np.arange(3, 6)
    expected = cut(before, rows)
    expected[rows, rows] = off**2
    assert_close(ukf.covariance, expected)
    assert ukf._engine.read("resets")[0, VELOCITY_BLOCK] == 1.0
    np.testing.assert_array_equal(ukf._engine.read("alarm_tick"), ukf._engine.read("tick"))


def test_reset_to_a_baseline_cuts_the_covariances_of_the_heading_alone():
    """The heading is the angle about the vertical. All other states keep their covariances."""
    ukf = started(DEVIATIONS)
    before = ukf.covariance
    refused_for_long(ukf, BASELINE_BLOCK, stepped=True)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix()
    ukf.update(gnss_baseline_G=R_IG.T @ turn @ R_BI.T @ SUITE.gnss.baseline_B)
    assert ukf._engine.read("resets")[0, BASELINE_BLOCK] == 1.0
    k, S = R_BI[:, 2], np.eye(15)  # axes of the attitude's errors: two level ones, and k
    S[6:9, 6:9] = np.column_stack([*np.linalg.svd(k[np.newaxis])[2][1:], k])
    found, expected = S.T @ ukf.covariance @ S, cut(S.T @ before @ S, [8])
    assert found[8, 8] > 0.05
    expected[8, 8] = found[8, 8]
    assert_close(found, expected)


def with_a_refused_compass():
    """A filter at rest with one antenna, whose compass has been refused for long."""
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    kf = quad_gym.UnscentedKalmanFilter(MAGNETIC.replace(gnss=gnss))
    set_at_rest(kf, 1e-6 * np.eye(15))
    refused_for_long(kf, AID_GROUPS + Aid.MAGNETOMETER, stepped=False)
    return kf


@pytest.mark.parametrize("against", [0.0, 1.0])
def test_compass_refused_for_long_resets_the_heading_unless_the_motion_contradicts_it(against):
    """The variance is the square of the innovation and of hard iron, over the level field's."""
    compass, turn, group = MAGNETIC.magnetometer, 0.5, AID_GROUPS + Aid.MAGNETOMETER
    kf = with_a_refused_compass()
    kf._engine.blocks["level_against"] = against
    kf.update(magnetometer=euler_to_dcm([0.0, 0.0, turn]) @ compass.field_I)
    assert kf._engine.read("resets")[0, group] == 1.0 - against
    iron = compass.hard_iron_sigma / math.hypot(*compass.field_I[:2])
    expected = 2.0 - 2.0 * math.cos(turn) + iron**2 if against == 0.0 else 1e-6
    assert kf.covariance[8, 8] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("off", [(0.0, 0.0, -2e-5), (0.0, 3e-5, 0.0), (0.0, 0.0, 0.0)])
def test_reset_to_a_compass_gives_hard_iron_the_variance_that_no_heading_explains(off):
    """No heading explains another vertical part or another length of the level part."""
    compass, turn, group = MAGNETIC.magnetometer, 0.5, AID_GROUPS + Aid.MAGNETOMETER
    kf = with_a_refused_compass()
    field = np.array(compass.field_I)
    found = euler_to_dcm([0.0, 0.0, turn]) @ (field + off)
    kf.update(magnetometer=found)
    assert kf._engine.read("resets")[0, group] == 1.0
    longer = math.hypot(*found[:2]) - math.hypot(*field[:2])
    expected = max(compass.hard_iron_sigma, math.hypot(longer, off[2]))
    iron = int(kf._engine.settings["aid_vector"][0, Aid.MAGNETOMETER])
    rows = kf._engine.read("P_slow")[0]
    assert math.sqrt(rows[iron, 15 + iron]) == pytest.approx(expected, rel=1e-3)


def test_measurement_after_a_reset_determines_the_state():
    ukf, off = started(DEVIATIONS), np.array([5.0, -3.0, 2.0])
    refuse(ukf, off, stepped=True)
    ukf.update(gnss_velocity_G=R_IG.T @ off)
    np.testing.assert_allclose(ukf.velocity, off, atol=0.01)
    sigma = np.sqrt(np.diag(ukf.covariance)[3:6])
    np.testing.assert_allclose(sigma, SUITE.gnss.velocity_sigma, rtol=0.01)


def test_reset_of_a_drifted_estimate_restores_the_variances_of_the_start():
    ukf, off = started(DEVIATIONS), np.array([5.0, -3.0, 2.0])
    refuse(ukf, off, stepped=False)
    P, k = ukf.covariance, ukf.R_BI[:, 2]  # the velocity has had a bounded weight before
    sigma = np.sqrt(np.diag(P))
    np.testing.assert_allclose(sigma[9:12], SUITE.imu.accel_bias_sigma)
    np.testing.assert_allclose(sigma[12:], SUITE.imu.gyro_bias_sigma)
    start, mark = SUITE.estimator.initial_tilt_sigma, SUITE.initial_pose.heading_sigma
    expected = start**2 * np.eye(3) + (mark**2 - start**2) * np.outer(k, k)
    np.testing.assert_allclose(P[6:9, 6:9], expected, atol=1e-9)
    others = cut(P, np.arange(6, 15))
    np.testing.assert_array_equal(P[6:9, :6], others[6:9, :6])
    assert (np.linalg.eigvalsh(P / np.outer(sigma, sigma)) > 0.0).all()


def test_reset_after_large_corrections_leaves_biases_that_sensors_can_have():
    ukf = started(DEVIATIONS)
    refuse(ukf, np.array([5.0, -3.0, 2.0]), stepped=False, corrected=1.0)
    sigma = np.sqrt(np.diag(ukf.covariance))
    np.testing.assert_allclose(sigma[9:], np.repeat([0.5, 0.09], 3))


def test_reset_without_rejections_is_as_large_as_the_corrections_explain():
    """Of 0.01 m/s^2: three times as much, and the tilt, velocity and position that it causes."""
    ukf = started(np.repeat([0.01, 0.01, 1e-3, 1e-3, 1e-4], 3))
    blocks = ukf._engine.blocks
    blocks["corrected"][:, 0], blocks["corrected_tick"][:] = 0.01, blocks["tick"]
    lever = np.cross(ukf._engine.read("w_meas")[0] - ukf.gyro_bias, SUITE.gnss.primary_antenna_B)
    ukf.update(gnss_velocity_G=R_IG.T @ (ukf.velocity + ukf.R_BI.T @ lever))
    bias, time = 0.03, 3.0
    speed = np.sqrt(2.0) * bias * time  # by the bias, and by the tilt that hides it
    expected = [0.5 * time * speed, speed, bias / SUITE.estimator.gravity, bias]
    sigma = np.sqrt(np.diag(ukf.covariance))
    np.testing.assert_allclose(sigma[:12], np.repeat(expected, 3), rtol=1e-3)
    assert (sigma[12:] < 1.01e-4).all()


def at_rest(offsets, sigma=1.0, seed=0):
    """Update a filter at rest with fixes at 10 Hz, `offsets` (n, 3) [m] off, with scaled noise."""
    ukf, rng, found = quad_gym.UnscentedKalmanFilter(SUITE), np.random.default_rng(seed), []
    antenna, noise = (
        np.array(SUITE.gnss.primary_antenna_B),
        sigma * np.array(SUITE.gnss.position_sigma_I),
    )
    ukf.initialize(R_IG.T @ antenna, R_IG.T @ np.array(SUITE.gnss.baseline_B))
    for offset in offsets:
        for _ in range(round(0.1 * SUITE.imu.rate)):
            ukf.predict(np.zeros(3), np.array([0.0, 0.0, 9.8]))
        ukf.update(gnss_position_G=R_IG.T @ (antenna + offset + noise * rng.normal(size=3)))
        factor = ukf._engine.read("noise_factor")[0, POSITION_BLOCK]
        found.append((*ukf.position, factor, ukf.gate_decisions[POSITION_BLOCK], ukf.diverged))
    return np.array(found)


@pytest.mark.parametrize(("sigma", "least", "most"), [(1.0, 1.0, 1.4), (3.0, 5.0, 14.0)])
def test_noise_factor_is_the_square_of_the_true_ratio(sigma, least, most):
    found = at_rest(np.zeros((300, 3)), sigma)
    assert least <= found[100:, 3].mean() <= most
    assert (found[:, 4] == GateDecision.REJECTED).mean() < 0.05
    assert np.abs(found[100:, :3]).max() < 0.05


def test_huge_outliers_are_rejected_and_do_not_change_the_noise():
    offsets = np.zeros((100, 3))
    offsets[20::20] = 50.0
    found, calm = at_rest(offsets), at_rest(0.0 * offsets)
    assert (found[20::20, 4] == GateDecision.REJECTED).all()
    assert found[:, 3].max() <= calm[:, 3].max() * 1.2
    assert np.abs(found[:, :3]).max() < 0.1


def test_fixes_that_step_away_are_waited_for_and_flagged():
    """They return after 8 s; the estimate, which has dead reckoned, is at them at once."""
    offsets = np.zeros((200, 3))
    offsets[50:130, 0] = 500.0
    found = at_rest(offsets)
    assert found[62:130, 5].all()
    sigma_of_dead_reckoning = 0.5 * 0.05 * 8.0**2  # of a tilt of 5 mrad
    assert np.abs(found[:, :3]).max() < 3.0 * sigma_of_dead_reckoning
    assert np.abs(found[140:, :3]).max() < 0.1
    assert not found[-1, 5]


def test_fixes_that_step_away_for_good_are_followed_after_the_time_limit():
    since = 50 + round(10.0 * SUITE.estimator.glitch_timeout)
    offsets = np.zeros((since + 40, 3))
    offsets[50:, 0] = 500.0
    found = at_rest(offsets)
    assert found[since - 5, 0] < 100.0
    assert found[since + 20, 0] == pytest.approx(500.0, abs=0.1)


def test_protection_does_no_harm_where_noise_is_three_times_as_large():
    """32 flights of 10 s; the same without a gate."""
    suite = quad_gym.sensor_suite("consumer")
    sigma = tuple(3.0 * s for s in suite.gnss.position_sigma_I)
    true = suite.replace(gnss=suite.gnss.replace(position_sigma_I=sigma))
    open_gate = suite.replace(estimator=suite.estimator.replace(false_alarm_probability=0.0))
    rms = []
    for assumed in (suite, open_gate):
        batch = fly(assumed, 32, task="circle", start="hover", true_sensors=true)
        squares = []
        for _ in range(40):
            steps(batch, 0.25)
            squares.append(np.square(state_errors(batch)[:, :3]).sum(axis=1))
        rms.append(np.sqrt(np.mean(squares[8:])))
    assert rms[0] < 2.0 * rms[1], rms


def test_drift_of_fixes_that_a_camera_does_not_confirm_resets_nothing():
    """16 flights of 15 s, with a drift as large as the noise of a fix, 1 cm."""
    suite = quad_gym.sensor_suite("rtk")
    drift = {"drift_sigma_I": suite.gnss.position_sigma_I, "drift_tau": 60.0}
    true = suite.replace(gnss=suite.gnss.replace(**drift))
    batch = fly(suite, 16, filter_start="warm", true_sensors=true)
    for _ in range(30):
        steps(batch, 0.5)
        assert not batch.record("diverged").any()


def circle():
    """Log of the real flight, with positions every 0.1 s and 1 cm of noise; its truth."""
    with gzip.open(CIRCLE, "rt") as file:
        names = file.readline().strip().split(",")
        d = dict(zip(names, np.loadtxt(file, delimiter=",").T, strict=True))
    t, p = d["t"], np.stack([d["px"], d["py"], d["pz"]], axis=1)
    fix, i = np.full(p.shape, np.nan), np.arange(5, len(t), 10)
    fix[i] = p[i] + 0.01 * np.random.default_rng(0).normal(size=(len(i), 3))
    log = {
        "time": t,
        "gyro": np.stack([d[f"imu_gyro_{axis}"] for axis in "xyz"], axis=1),
        "accel": 9.81 * np.stack([d[f"imu_acc_{axis}"] for axis in "xyz"], axis=1),
        "gnss_enu": fix,
    }
    return t, p, log, {"heading": 0.0217, "heading_sigma": 0.1}


def test_protection_does_no_harm_to_a_real_flight():
    """Gyro samples are wrong for a tenth of a second at 22 s: the estimate is off by 0.5 m/s."""
    t, p, log, start = circle()
    rtk = quad_gym.sensor_suite("rtk")
    imu = {"accel_noise_density": 0.029, "gyro_noise_density": 0.0097, "accel_vibration": 0.0}
    imu |= {"accel_bias_sigma": 0.3, "gyro_bias_sigma": 0.015, "gyro_vibration": 0.0}
    gnss = {"primary_antenna_B": (-0.019, 0.016, 0.017), "position_sigma_I": (0.01, 0.01, 0.01)}
    gnss |= {"drift_sigma_I": (0.02, 0.02, 0.025), "drift_tau": 13.0, "secondary_antenna_B": None}
    suite = rtk.replace(
        imu=rtk.imu.replace(**imu),
        gnss=rtk.gnss.replace(**gnss),
        camera=None,
        log_delays=rtk.log_delays.replace(gnss=0.0985),
    )
    open_gate = suite.replace(estimator=suite.estimator.replace(false_alarm_probability=0.0))
    rms = []
    for assumed in (suite, open_gate):
        found = replay(log, sensors=assumed, start=start)
        true = np.stack([np.interp(found.time, t, p[:, i]) for i in range(3)], axis=1)
        errors = np.linalg.norm(found.position - true, axis=1)[found.time > 5.0]
        rms.append(np.sqrt(np.mean(errors**2)))
    assert rms[0] < 0.3
    assert rms[0] < 2.0 * rms[1], rms


def drifting_receiver(rate, start=70.0, end=90.0):
    """Logs of a real flight: as recorded, and with fixes that drift off to the east [m/s]."""
    with gzip.open(HOBBY, "rt") as file:
        d = np.genfromtxt(file, delimiter=",", names=True)
    log = {name: d[name][d["time"] < end + 6.0] for name in d.dtype.names}
    drifting = {name: values.copy() for name, values in log.items()}
    wrong = (log["time"] >= start) & (log["time"] < end)
    meters = rate * (log["time"] - start)[wrong]
    drifting["gnss_lon"][wrong] += np.degrees(meters / (6.378e6 * np.cos(np.radians(37.87))))
    drifting["gnss_velocity_east"][wrong] += rate
    return log, drifting


def test_receiver_that_drifts_off_in_a_real_flight_is_left_out_until_it_is_correct_again():
    """Positions and velocities drift off at 4 m/s for 20 s, in the air; the rest is as recorded."""
    start, end = 70.0, 90.0
    log, drifting = drifting_receiver(4.0, start, end)
    right, result = replay(log, sensors="field"), replay(drifting, sensors="field")
    error = np.linalg.norm(result.position - right.position, axis=1)
    sigma = np.linalg.norm(result.sigma[:, :3], axis=1)
    told = result.time[result.diverged & (result.time >= start)]
    assert told[0] < start + 3.0
    during = (result.time >= start) & (result.time < end)
    assert (error[during] < np.maximum(20.0, 3.0 * sigma[during])).all()
    assert error[result.time > end + 5.0].max() < 5.0


@pytest.mark.parametrize("confirmed", [True, False])
def test_reset_to_a_barometer_changes_its_error_where_others_confirm_the_height(confirmed):
    """A barometer that is refused by 20 m has an error of 20 m, if GNSS confirms the height.

    Where no other sensor does, the height is wrong by so much, and the error is a usual one.
    """
    barometer, off = quad_gym.BarometerParams(), 20.0
    ukf = quad_gym.UnscentedKalmanFilter(SUITE.replace(barometer=barometer))
    set_at_rest(ukf, np.diag(DEVIATIONS**2), R_BI=R_BI)
    blocks, group = ukf._engine.blocks, AID_GROUPS + int(Aid["BAROMETER"])
    blocks["tick"] += 2.0 * SUITE.estimator.glitch_timeout * SUITE.imu.rate
    blocks["corrected_tick"][:] = blocks["tick"]
    blocks["accepted_tick"][:, :] = 0.0
    if confirmed:
        blocks["accepted_tick"][:, POSITION_BLOCK] = blocks["tick"]
    blocks["rejected_in_row"][:, group] = 20.0
    before = np.sqrt(np.diag(ukf.covariance))
    ukf.update(barometer=ukf.position[2] + off)
    assert ukf._engine.read("resets")[0, group] == 1.0
    own = np.sqrt(ukf._engine.covariances()[0, 15, 15])
    sigma = np.sqrt(np.diag(ukf.covariance))
    np.testing.assert_allclose(own, off if confirmed else barometer.bias_sigma, rtol=1e-6)
    np.testing.assert_allclose(
        sigma[2], before[2] if confirmed else np.hypot(off, barometer.bias_sigma), rtol=1e-6
    )
    np.testing.assert_allclose(sigma[:2], before[:2], rtol=1e-6)
