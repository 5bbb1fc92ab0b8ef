"""Filters accept samples of any length, and measurements of any time and with given noise."""

import math

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import LONGEST_STEP, ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.packing import params_record
from quad_gym.params.vehicle import VehicleParams
from tests.level_flights import R_IG

KINDS = (UnscentedKalmanFilter, ExtendedKalmanFilter)
SUITE = quad_gym.sensor_suite("consumer")
SUITE = SUITE.replace(  # with every available measurement
    gnss=SUITE.gnss.replace(secondary_antenna_B=(0.1, 0.0, 0.0472), baseline_sigma=np.radians(2.0)),
    magnetometer=quad_gym.MagnetometerParams(),
    barometer=quad_gym.BarometerParams(),
)
STATE = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias", "covariance", "gnss_drift")
TICK = SUITE.imu.dt
FIX = [0.2, 0.1, 0.3]


def started(kind=UnscentedKalmanFilter, suite=SUITE, **options):
    kf = kind(suite, **options)
    kf.initialize(np.zeros(3), [1.0, 0.0, 0.0])
    return kf


def samples(count, seed=0):
    rng = np.random.default_rng(seed)
    return [(rng.normal(0.0, 0.3, 3), rng.normal((0.0, 0.0, 9.81), 1.0, 3)) for _ in range(count)]


def measurement(rng):
    return {
        "gnss_position_G": rng.normal(0.0, 0.3, 3),
        "gnss_velocity_G": rng.normal(0.0, 0.1, 3),
        "barometer": rng.normal(0.0, 0.3),
        "gnss_sigma": rng.uniform(0.2, 0.6, 3),
        "barometer_sigma": rng.uniform(0.1, 0.3),
    }


def estimate(kf):
    return {name: getattr(kf, name) for name in STATE} | kf.aid_errors


def assert_same(one, other):
    for name, value in estimate(one).items():
        np.testing.assert_array_equal(value, estimate(other)[name], err_msg=name)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("factor", [0.4, 2.0, 3.7])
def test_sample_of_another_length_equals_tick_of_imu_with_that_rate(kind, factor):
    """The reference is a suite with this IMU rate and without vibration."""
    imu = SUITE.imu.replace(accel_vibration=0.0, gyro_vibration=0.0)
    ours = started(kind, SUITE.replace(imu=imu))
    rate = imu.rate / factor
    gnss, barometer, magnetometer = (
        sensor.replace(rate=rate, latency=0.0)
        for sensor in (SUITE.gnss, SUITE.barometer, SUITE.magnetometer)
    )
    aids = {"gnss": gnss, "barometer": barometer, "magnetometer": magnetometer}
    theirs = started(kind, SUITE.replace(imu=imu.replace(rate=rate), **aids))
    for gyro, accel in samples(10):
        ours.predict(gyro, accel, dt=1.0 / rate)
        theirs.predict(gyro, accel)
        for filter_ in (ours, theirs):
            filter_.update(gnss_position_G=np.zeros(3), gnss_velocity_G=np.zeros(3), barometer=0.1)
    for name, value in estimate(ours).items():
        np.testing.assert_allclose(value, estimate(theirs)[name], rtol=1e-9, atol=1e-13)


def test_covariance_at_rest_does_not_depend_on_sample_length():
    """At rest, ten short samples give the same covariance as one long sample."""
    whole, parts = started(), started()
    at_rest = ([0.0] * 3, [0.0, 0.0, SUITE.estimator.gravity])
    for _ in range(20):
        whole.predict(*at_rest, dt=0.01)
        for _ in range(10):
            parts.predict(*at_rest, dt=0.001)
    np.testing.assert_allclose(
        np.sqrt(np.diag(parts.covariance)), np.sqrt(np.diag(whole.covariance)), rtol=2e-3
    )
    assert parts.time == pytest.approx(whole.time)


@pytest.mark.parametrize("dt", [0.0, -0.01, math.nan, math.inf, "x", 1.001 * LONGEST_STEP, [0.01]])
def test_bad_lengths_raise_and_change_nothing(dt):
    kf, same = started(), started()
    with pytest.raises(ValueError, match="dt"):
        kf.predict(np.zeros(3), [0.0, 0.0, 9.8], dt=dt)
    assert_same(kf, same)
    assert kf.time == 0.0
    kf.predict(np.zeros(3), [0.0, 0.0, 9.8], dt=LONGEST_STEP)
    assert np.isfinite(kf.covariance).all()


@pytest.mark.parametrize("kind", KINDS)
def test_late_measurements_in_any_order_equal_measurements_in_time(kind):
    in_time, late = started(kind), started(kind)
    rng, waiting = np.random.default_rng(1), []
    for k, sample in enumerate(samples(200)):
        for kf in (in_time, late):
            kf.predict(*sample)
        if k % 7 == 3:
            waiting.append((k + int(rng.integers(1, 80)), late.time, measurement(rng)))
            in_time.update(**waiting[-1][2])
        for _, stamp, given in [w for w in waiting if w[0] == k]:
            late.update(**given, time=stamp)
    for due, stamp, given in sorted(waiting, key=lambda w: -w[1]):
        if due >= 200:
            late.update(**given, time=stamp)
    assert_same(in_time, late)
    assert late.nis == in_time.nis


@pytest.mark.parametrize("samples_of", ["average", "instant"])
def test_time_stamp_within_an_imu_sample_splits_the_sample(samples_of):
    """The split keeps the gyro's rate of change, which the accelerometer's lever arm needs."""
    lab = quad_gym.sensor_suite("lab")
    imu = lab.imu.replace(samples=samples_of, lever_arm_B=(0.1, 0.05, 0.0))
    integration = "midpoint" if samples_of == "average" else "euler"
    suite = lab.replace(imu=imu, estimator=lab.estimator.replace(integration=integration))
    late, whole = started(suite=suite), started(suite=suite)
    for gyro, accel in samples(30):
        late.predict(gyro, accel, dt=0.01)
        whole.predict(gyro, accel, dt=0.01)
    wide = 1e6  # an uninformative measurement shows only the effect of the split
    late.update(np.zeros(3), gnss_sigma=wide, time=0.153)
    np.testing.assert_allclose(late.velocity, whole.velocity, atol=0.02)
    np.testing.assert_allclose(late.position, whole.position, atol=0.005)
    in_parts, late = started(suite=SUITE), started(suite=SUITE)
    given = samples(30)
    for k, (gyro, accel) in enumerate(given):
        late.predict(gyro, accel, dt=0.01)
        if k == 15:
            in_parts.predict(gyro, accel, dt=0.003)
            in_parts.update([0.1, 0.2, 0.3])
            in_parts.predict(gyro, accel, dt=0.007)
        else:
            in_parts.predict(gyro, accel, dt=0.01)
    late.update([0.1, 0.2, 0.3], time=0.153)
    for name, value in estimate(in_parts).items():
        np.testing.assert_allclose(estimate(late)[name], value, rtol=1e-9, atol=1e-12)


def test_stamps_outside_the_window_are_refused():
    kf = started(window=0.2)
    for sample in samples(100):
        kf.predict(*sample)
    before = estimate(kf)
    oldest = kf.oldest_time
    assert 0.5 - 0.2 - 1e-9 <= oldest <= 0.5
    for time, words in ((0.501, "predict up to it"), (oldest - 0.01, "keeps 0.2 s")):
        with pytest.raises(ValueError, match=rf"time must .*{words}"):
            kf.update(np.zeros(3), time=time)
    for bad in (math.nan, "now", [0.3]):
        with pytest.raises(ValueError, match="time"):
            kf.update(np.zeros(3), time=bad)
    for name, value in before.items():
        np.testing.assert_array_equal(estimate(kf)[name], value)
    kf.update(np.zeros(3), time=oldest)
    kf.update(np.zeros(3), time=kf.time)
    with pytest.raises(ValueError, match="window"):
        UnscentedKalmanFilter(SUITE, window=-1.0)


def test_filter_without_window_accepts_only_measurements_in_time():
    kept, plain = started(), started(window=0.0)
    for sample in samples(20):
        for kf in (kept, plain):
            kf.predict(*sample)
            kf.update(np.zeros(3), time=kf.time)
    assert_same(kept, plain)
    with pytest.raises(ValueError, match="time must be at least"):
        plain.update(np.zeros(3), time=plain.time - TICK)


def test_last_update_reports_only_the_latest_call_even_if_late():
    kf = started()
    for sample in samples(40):
        kf.predict(*sample)
    kf.update(np.zeros(3), time=0.2)
    on_time = kf.last_update
    kf.update(barometer=0.4, time=0.1)
    report = kf.last_update
    assert np.isfinite(on_time.nis).tolist() == [True, False, False, False, False]
    assert np.isfinite(report.nis).tolist() == [False, False, False, True, False]
    assert report.nis[3] == pytest.approx((report.innovation[3, 0] / report.sigma[3, 0]) ** 2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("given", "sigma", "change"),
    [
        ({"gnss_position_G": FIX}, {"gnss_sigma": 0.05}, ("gnss", "position_sigma_I", (0.05,) * 3)),
        ({"gnss_velocity_G": FIX}, {"velocity_sigma": 0.4}, ("gnss", "velocity_sigma", 0.4)),
        ({"barometer": 0.4}, {"barometer_sigma": 0.02}, ("barometer", "noise_sigma", 0.02)),
        (
            {"magnetometer": [1e-6, 24e-6, -39e-6]},
            {"magnetometer_sigma": 2e-6},
            ("magnetometer", "noise_sigma", 2e-6),
        ),
    ],
)  # fmt: skip
def test_given_measurement_noise_equals_suite_with_that_noise(kind, given, sigma, change):
    sensor, name, value = change
    like = SUITE.replace(**{sensor: getattr(SUITE, sensor).replace(**{name: value})})
    ours, theirs = kind(SUITE), kind(like)
    for kf in (ours, theirs):
        kf.initialize(np.zeros(3), [1.0, 0.0, 0.0], gnss_sigma=0.3)
        for sample in samples(5):
            kf.predict(*sample)
    ours.update(**given, **sigma)
    theirs.update(**given)
    assert_same(ours, theirs)
    ours.update(**given)  # the suite's noise applies again
    plain = params_record(VehicleParams(), SUITE)
    for field in ("position_sigma_I", "velocity_sigma", "aid_sigma"):
        np.testing.assert_array_equal(ours._engine.params[field][0, ..., 0], plain[field][0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("suite", [SUITE, quad_gym.sensor_suite("lab")], ids=["drift", "lab"])
def test_update_with_given_noise_equals_textbook_update(kind, suite):
    """The update equals the textbook, K = P H^T S^-1 with the antenna's lever arm, by NumPy."""
    kf = kind(suite)
    kf.initialize(np.zeros(3), [1.0, 0.0, 0.0])
    for sample in samples(20):
        kf.predict(*sample)
    sigmas, z = [0.3, 0.2, 0.4], np.array([0.3, -0.2, 0.1])
    P, R, x = kf.covariance, kf.R_BI, kf.position
    drift, cross = kf.gnss_drift_covariance, np.zeros((3, 15))
    if suite.drifts:  # the joint covariance of drift and state
        cross = kf._engine.covariances()[0, 15:18, :15]
    l_x, l_y, l_z = suite.gnss.primary_antenna_B
    skew = np.array([[0.0, -l_z, l_y], [l_z, 0.0, -l_x], [-l_y, l_x, 0.0]])
    H = np.hstack([np.eye(3), np.zeros((3, 3)), -R.T @ skew, np.zeros((3, 6))])
    S = H @ P @ H.T + H @ cross.T + cross @ H.T + drift + np.diag(np.square(sigmas))
    K = (P @ H.T + cross.T) @ np.linalg.inv(S)
    nu = z - x - R.T @ np.array(suite.gnss.primary_antenna_B) - kf.gnss_drift
    kf.update(R_IG.T @ z, gnss_sigma=sigmas)
    report = kf.last_update
    tolerance = 1e-6 if kind is ExtendedKalmanFilter else 0.02  # second-order terms of the UKF
    np.testing.assert_allclose(report.nis[0], nu @ np.linalg.solve(S, nu), rtol=tolerance)
    second_order = 1e-9 if kind is ExtendedKalmanFilter else 2e-3
    np.testing.assert_allclose(report.innovation[0], nu, atol=second_order)
    second = 1e-9 if kind is ExtendedKalmanFilter else 1e-5  # and second-order terms
    np.testing.assert_allclose(report.sigma[0], np.sqrt(np.diag(S)), rtol=second)
    np.testing.assert_allclose(kf.position, x + (K @ nu)[:3], atol=tolerance * 0.3)
    sigma = np.sqrt(np.diag(P - K @ S @ K.T))[:6]
    np.testing.assert_allclose(np.sqrt(np.diag(kf.covariance))[:6], sigma, rtol=tolerance)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"gnss_sigma": 0.0}, "gnss_sigma"),
        ({"gnss_sigma": [0.1, -0.1, 0.1]}, "gnss_sigma"),
        ({"gnss_sigma": [0.1, 0.1]}, "gnss_sigma"),
        ({"gnss_sigma": np.eye(3)}, "gnss_sigma"),
        ({"gnss_sigma": math.nan}, "gnss_sigma"),
        ({"velocity_sigma": 0.1}, "velocity_sigma must come with"),
        ({"barometer": 0.1, "barometer_sigma": -1.0}, "barometer_sigma"),
        ({"barometer": math.nan}, "barometer"),
        ({"magnetometer": np.ones(2)}, "magnetometer"),
        ({"sigma": 1.0}, "sigma is not a keyword of update"),
    ],
)
def test_bad_measurements_and_noise_raise_and_change_nothing(given, message):
    kf, same = started(), started()
    with pytest.raises((ValueError, TypeError), match=message):
        kf.update(np.zeros(3), **given)
    assert_same(kf, same)
