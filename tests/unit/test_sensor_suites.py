"""Sensor suites: rates and phases, GNSS drift, velocity, flights without GNSS."""

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.params.suites import SUITES, InitialPoseParams
from quad_gym.records import BASELINE_BLOCK, FEATURE_SLICE, POSITION_BLOCK, VELOCITY_BLOCK
from quad_gym.sensors import GnssReceiver
from tests.field_flights import attitudes, fly, state_errors, steps
from tests.reference_ukf import east_north_up
from tests.unit.alarms import ALARM, assert_normal

FIELD = [name for name in SUITES if name != "lab"]
RTK, CONSUMER = (quad_gym.sensor_suite(name).simplified() for name in ("rtk", "consumer"))


@pytest.mark.parametrize("suite", FIELD)
def test_errors_at_level_start_match_covariance(suite):
    """The 15 errors are tested jointly: GNSS measures the antenna, which couples them."""
    batch = fly(suite, 4000)
    errors, L = state_errors(batch), batch.record("L")
    assert_normal(np.linalg.solve(L, errors[..., np.newaxis])[..., 0], np.zeros(15), np.eye(15))


def test_gnss_velocity_update_uses_current_body_rate_for_lever_arm():
    """Flights turn fast toward their reference at first, so a rate half a tick old would fail."""
    batch = fly(RTK, 2000)
    batch.reset(seeds=range(2000), position=(1.0, -1.0, 2.0))
    squares = []
    for _ in range(40):
        batch.step()
        measured = batch.record("block_valid")[:, VELOCITY_BLOCK] > 0.0
        squares.append(batch.record("block_nis")[measured, VELOCITY_BLOCK])
    nis = np.concatenate(squares)
    assert len(nis) > 3000
    assert ALARM < stats.chi2.cdf(nis.sum(), 3 * len(nis)) < 1.0 - ALARM


def ticks_of_fixes(suite, count, ticks):
    batch = fly(suite, count, task="hover")
    rows = [batch.record("block_valid")[:, POSITION_BLOCK]]
    for _ in range(ticks):
        batch.step()
        rows.append(batch.record("block_valid")[:, POSITION_BLOCK])
    return np.array(rows) > 0.0


def test_sensors_measure_at_their_phase_and_rate():
    gnss, camera = RTK.gnss.replace(phase=0.25), RTK.camera.replace(rate=50.0, phase=0.5)
    suite = RTK.replace(gnss=gnss, camera=camera)
    batch = fly(suite, 3, task="hover")
    fixes, images = [], []
    for tick in range(1, 101):
        batch.step()
        if batch.record("block_valid")[:, POSITION_BLOCK].all():
            fixes.append(tick)
        if batch.record("block_valid")[:, FEATURE_SLICE].any():
            images.append(tick)
    assert fixes == list(range(5, 101, 20))
    assert images == list(range(2, 101, 4))


def test_random_phases_are_uniform_and_new_in_each_episode():
    flags = ticks_of_fixes(RTK, 2000, 40)
    assert not flags[0].any()  # the fix that starts the filter does not count
    first = flags[1:].argmax(axis=0) + 1
    assert set(first) <= set(range(1, 21))
    np.testing.assert_array_equal(flags[1:21].sum(axis=0), 1)  # one in every period
    counts = np.bincount(first % 20, minlength=20)
    assert stats.chisquare(counts).pvalue > ALARM


def test_gnss_drift_grows_as_gauss_markov_process():
    gnss = CONSUMER.gnss.replace(drift_sigma_I=(0.6, 0.3, 1.0), drift_tau=0.8, phase=0.0)
    batch = fly(CONSUMER.replace(gnss=gnss), 4000, task="hover")
    np.testing.assert_array_equal(batch.record("drift"), 0.0)
    steps(batch, 0.4)
    early = batch.record("drift")
    steps(batch, 0.6)
    late = batch.record("drift")
    variance = np.square([0.6, 0.3, 1.0])
    v_1, v_2 = (variance * -np.expm1(-2.0 * t / 0.8) for t in (0.4, 1.0))
    between = v_1 * np.exp(-0.6 / 0.8)
    covariance = np.block([[np.diag(v_1), np.diag(between)], [np.diag(between), np.diag(v_2)]])
    assert_normal(np.hstack([early, late]), np.zeros(6), covariance)


def test_gnss_error_is_white_noise_plus_drift():
    gnss = CONSUMER.gnss.replace(drift_tau=1.0)
    receiver = GnssReceiver(gnss, np.random.default_rng(5))
    R_IG = east_north_up(gnss.reference_antenna_G)
    fixes = np.array([receiver.measure(np.zeros(3), np.eye(3))[0] for _ in range(20_000)])
    errors = fixes @ R_IG.T - gnss.primary_antenna_B
    expected = np.hypot(gnss.position_sigma_I, gnss.drift_sigma_I)
    np.testing.assert_allclose(errors[100:].std(axis=0), expected, rtol=0.1)
    lag = (errors[100:-10] * errors[110:]).mean(axis=0)  # after 1 s the white part is gone
    np.testing.assert_allclose(lag, np.square(gnss.drift_sigma_I) * np.exp(-1.0), rtol=0.3)


def test_gnss_velocity_is_antenna_velocity_plus_noise():
    gnss = RTK.gnss.replace(rate=200.0, phase=0.0, primary_antenna_B=(0.3, 0.0, 0.1))
    batch = fly(RTK.replace(gnss=gnss), 500, task="hover")
    steps(batch, 0.2)
    R_BI = attitudes(batch.record("q"))
    lever = np.cross(batch.record("w"), gnss.primary_antenna_B)
    truth = batch.record("v") + np.einsum("nji,nj->ni", R_BI, lever)
    assert np.abs(lever).max() > 0.05
    measured = batch.record("gnss_velocity") @ east_north_up(gnss.reference_antenna_G).T
    assert_normal(measured - truth, np.zeros(3), np.eye(3) * gnss.velocity_sigma**2)


def test_velocity_is_measured_only_by_suites_with_gnss_velocity():
    assert fly("rtk", 2, task="hover").record("block_valid")[:, VELOCITY_BLOCK].shape == (2,)
    lab = fly("lab", 2, task="hover")
    steps(lab, 0.1)
    assert not lab.record("block_valid")[:, VELOCITY_BLOCK].any()
    ukf = quad_gym.UnscentedKalmanFilter(quad_gym.sensor_suite("lab"))
    ukf.initialize((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="velocity"):
        ukf.update(gnss_velocity_G=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="gnss_rate must not be given without GNSS"):
        quad_gym.sensor_suite("indoor").with_rates(gnss=10.0)
    with pytest.raises(ValueError, match="camera_rate must not be given without a camera"):
        CONSUMER.with_rates(camera=25.0)


def test_indoor_filter_starts_from_initial_pose_without_fixes():
    batch = fly("indoor", 2000, task="hover")
    off = batch.record("r_hat") - batch.record("r")
    assert_normal(off, np.zeros(3), np.eye(3) * 0.05**2)
    for _ in range(50):
        batch.step()
        assert not batch.record("block_valid")[:, POSITION_BLOCK].any()
        assert not batch.record("block_valid")[:, BASELINE_BLOCK].any()


def test_velocity_is_observed_together_with_the_position():
    env = quad_gym.QuadEnv("hover", observation="measurements", sensors=RTK, control_rate=100.0)
    env.reset(seed=3)
    table = {field.name: field.slice for field in env.flights.table}
    assert table["gnss_velocity_valid"].start == table["gnss_velocity"].stop
    R_IG = east_north_up(RTK.gnss.reference_antenna_G)
    fixes = 0
    for _ in range(50):
        observation = env.step(np.zeros(4, np.float32))[0]
        seen, fresh = observation[table["gnss_velocity"]], observation[table["gnss_velocity_valid"]]
        assert fresh == observation[table["gnss_position_valid"]]
        measured = R_IG @ env.flights.batch.record("gnss_velocity")[0]
        np.testing.assert_allclose(seen, fresh * measured, atol=1e-6)
        fixes += int(fresh[0])
    assert fixes == 5
    without = quad_gym.QuadEnv("hover", observation="measurements", sensors="lab")
    assert "gnss_velocity" not in {field.name for field in without.flights.table}


def test_start_errors_come_from_true_sensors_covariance_from_assumed_ones():
    assumed = quad_gym.sensor_suite("indoor").simplified()
    assumed = assumed.replace(camera=assumed.camera.replace(phase=0.5))
    true = assumed.replace(initial_pose=InitialPoseParams(position_sigma=0.2, heading_sigma=0.15))
    batch = fly(assumed, 4000, task="hover", true_sensors=true, start="ground")
    errors = state_errors(batch)
    assert_normal(errors[:, :3], np.zeros(3), np.eye(3) * 0.2**2)
    claimed = np.sqrt(np.diagonal(batch.covariance(), axis1=1, axis2=2))
    np.testing.assert_allclose(claimed[:, :3], 0.05, rtol=1e-9)
    np.testing.assert_allclose(claimed[:, 8], 0.05, rtol=1e-9)
    # two components of a direction have errors of 0.15: its heading agrees within some percent
    np.testing.assert_allclose(errors[:, 8].std(), 0.15, rtol=0.06)


@pytest.mark.parametrize("name", ["lab", "rtk"])
def test_heading_comes_from_initial_pose_if_baseline_is_vertical(name):
    suite = quad_gym.sensor_suite(name)
    up = {"primary_antenna_B": (0.0, 0.0, 0.05), "secondary_antenna_B": (0.0, 0.0, 0.24)}
    suite = suite.replace(gnss=suite.gnss.replace(**up, phase=0.5, rate=10.0), camera=None)
    true = {"true_sensors": suite.replace(initial_pose=InitialPoseParams(heading_sigma=0.2))}
    true["randomization"] = {"start_yaw": quad_gym.Uniform(-np.pi, np.pi)}
    batch = fly(suite, 4000, task="hover", start="ground", **true)
    assert_normal(state_errors(batch)[:, 8:9], np.zeros(1), np.eye(1) * 0.2**2)
    claimed = np.sqrt(suite.estimator.initial_covariance_scale) * 0.05
    np.testing.assert_allclose(np.sqrt(batch.covariance()[:, 8, 8]), claimed, rtol=1e-9)


def test_gnss_measurements_use_true_antennas_and_true_noise():
    antennas = {"primary_antenna_B": (0.3, -0.2, 0.1), "secondary_antenna_B": (-0.2, 0.1, 0.1)}
    noise = {"position_sigma_I": (0.1, 0.2, 0.3), "velocity_sigma": 0.4}
    true = RTK.replace(gnss=RTK.gnss.replace(**antennas, **noise))
    batch = fly(RTK, 4000, task="hover", true_sensors=true)
    R_IG = east_north_up(RTK.gnss.reference_antenna_G)
    R_BI = attitudes(batch.record("q"))
    antenna = batch.record("r") + np.array(true.gnss.primary_antenna_B) @ R_BI
    fixes = batch.record("gnss_position") @ R_IG.T - antenna
    assert_normal(fixes, np.zeros(3), np.diag(np.square([0.1, 0.2, 0.3])))
    lever = np.cross(batch.record("w"), true.gnss.primary_antenna_B)
    truth = batch.record("v") + np.einsum("nji,nj->ni", R_BI, lever)
    assert_normal(batch.record("gnss_velocity") @ R_IG.T - truth, np.zeros(3), np.eye(3) * 0.4**2)
    baseline = np.array(true.gnss.baseline_B) @ R_BI
    measured = batch.record("gnss_baseline") @ R_IG.T
    size = np.linalg.norm(true.gnss.baseline_B)
    np.testing.assert_allclose(np.linalg.norm(measured, axis=1), size, rtol=1e-9)
    angles = np.linalg.norm(np.cross(measured, baseline), axis=1) / size**2
    rayleigh = np.sqrt(np.pi / 2) * RTK.gnss.baseline_sigma
    np.testing.assert_allclose(angles.mean(), rayleigh, rtol=0.05)


@pytest.mark.parametrize("name", ["rtk", "consumer", "indoor"])
def test_field_suites_have_latency_and_sensor_errors_by_default(name):
    suite, plain = quad_gym.sensor_suite(name), quad_gym.sensor_suite(name).simplified()
    for one, real in ((suite, True), (plain, False)):
        assert one.imu.errs is one.imu.vibrates is real
        if one.gnss is not None:
            assert one.gnss.latency == 0.1 * real
            assert (one.gnss.heading_error_sigma > 0.0) == (real and one.gnss.has_baseline)
            assert one.gnss.drift_sigma_I == suite.gnss.drift_sigma_I
        if one.camera is not None:
            assert one.camera.latency == 0.04 * real
            assert one.camera.limited is real
    assert plain.estimator == suite.estimator
    assert 0.0 < suite.estimator.false_alarm_probability < 0.01
    lab = quad_gym.sensor_suite("lab")
    assert lab.simplified() == lab == quad_gym.SensorSuite()
    env = quad_gym.QuadEnv("hover", sensors="lab")
    assert env.flights.batch.sensors == lab  # by name and by object


def test_anchors_are_corners_of_a_hall_and_markers_spread_over_its_walls():
    """Both are low and high in turn, and no marker is in a corner."""
    anchors = np.array(quad_gym.UwbRangeParams().anchors_I)
    markers = np.array(quad_gym.sensor_suite("indoor").camera.features_I)
    np.testing.assert_array_equal(np.abs(anchors[:, :2]), 5.0)
    for places in (anchors, markers):
        around = np.unwrap(np.arctan2(places[:, 1], places[:, 0]))
        np.testing.assert_allclose(np.diff(around), 2.0 * np.pi / len(places))
        low, high = places[:2, 2]
        assert low < high
        np.testing.assert_array_equal(places[:, 2], [low, high] * (len(places) // 2))
    walls = np.sort(np.abs(markers[:, :2]))
    np.testing.assert_allclose(walls[:, 1], walls[0, 1])
    assert (walls[:, 0] < 0.9 * walls[:, 1]).all()


def test_logs_are_read_as_they_are_unless_a_suite_says_otherwise():
    suite = quad_gym.SensorSuite()
    for name in ("rotation", "compass_rotation", "accel_bias", "gyro_bias"):
        assert getattr(suite, f"log_{name}") == (0.0, 0.0, 0.0)
    assert set(vars(suite.log_delays).values()) == {0.0}


def test_heading_is_unobservable_where_nothing_but_optical_flow_measures_motion():
    crazyflie = quad_gym.sensor_suite("crazyflie")
    report = crazyflie.estimator.replace(attitude_reset=False)
    assert crazyflie.flow_alone
    for other in (
        crazyflie.replace(optical_flow=None),
        crazyflie.replace(gnss=quad_gym.sensor_suite("consumer").gnss),
        crazyflie.replace(camera=quad_gym.sensor_suite("indoor").camera),
        crazyflie.replace(uwb_range=quad_gym.UwbRangeParams()),
        crazyflie.replace(estimator=report),
        quad_gym.sensor_suite("rtk"),
    ):
        assert not other.flow_alone
