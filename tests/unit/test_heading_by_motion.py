"""Heading by motion, from IMU and GNSS velocities, against a compass or a start that is wrong."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.faults import MagnetometerDisturbance
from quad_gym.logs.replaying.heading_rules import contradicted
from quad_gym.logs.replaying.results import Severity
from quad_gym.records import Source
from quad_gym.rotations import euler_to_dcm
from tests.field_flights import fly, state_errors, steps
from tests.level_flights import GRAVITY, MAGNETIC, LevelFlight

FLIGHTS = 48


def flown(suite, task, seconds=0.0, **options):
    options = {"source": Source.TRUTH, "run_filter": True} | options
    batch = fly(suite, FLIGHTS, task=task, **options)
    steps(batch, seconds)
    return batch


def tilts(batch):
    """Angles (n,) between the estimated and the true vertical in B [rad]."""
    apart = batch.record("R_hat")[:, :, 2] - batch.read("R_BI")[:, :, 2]
    return 2.0 * np.arcsin(0.5 * np.linalg.norm(apart, axis=1))


def nees(batch):
    """NEES (n,) per state."""
    errors, P = state_errors(batch), batch.covariance()
    return np.einsum("ni,ni->n", errors, np.linalg.solve(P, errors[..., None])[..., 0]) / 15.0


def heading_of_motion(batch):
    """Errors and standard deviations (n,) of the heading by motion [rad]."""
    M = np.einsum("nji,njk->nik", batch.read("R_BI"), batch.record("level_turn"))
    psi = np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1])
    state = batch.record("level_state")
    u = state[:, 2] + 1j * state[:, 3]
    sigma = np.sqrt(0.5 * batch.record("level_P")[:, 1]) / np.abs(u)
    return np.angle(u * np.exp(-1j * psi)), sigma


@pytest.mark.parametrize("suite", ["consumer", "field"])
def test_heading_by_motion_has_errors_of_its_standard_deviation(suite):
    """No bound fails by chance in a million runs, even if errors of a flight are all equal."""
    batch, squares = flown(suite, "circle", 1.0), []
    for _ in range(8):
        steps(batch, 1.0)
        errors, sigma = heading_of_motion(batch)
        assert (sigma < 0.2).all()
        squares.append((errors / sigma) ** 2)
    assert 0.15 < np.mean(squares) < 2.2
    assert not batch.record("compass_out").any()


def test_rest_shows_no_heading_and_no_other_one_replaces_the_compass():
    """The compass is turned by a right angle after 2 s, and is the only witness."""
    flight, dt = LevelFlight(MAGNETIC, np.random.default_rng(1), amplitude=0.0), 0.02
    kf = UnscentedKalmanFilter(MAGNETIC)
    kf.initialize(flight.gnss(0.0)[0], magnetometer=flight.field())
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for k in range(1, 401):
        kf.predict(*flight.sample((k - 1) * dt, dt), dt=dt)
        if k % 5 == 0:
            position, velocity = flight.gnss(k * dt)
            field = flight.field() if k < 100 else turn @ flight.field()
            kf.update(position, gnss_velocity_G=velocity, magnetometer=field)
            assert k < 10 or kf._engine.read("level_sigma")[0] > 0.35
    assert kf._engine.read("level_tick")[0] < 0.0
    assert kf._engine.read("compass_out")[0] == 0.0


def test_wrong_compass_is_used_again_after_a_minute_in_which_it_agreed():
    """The field is turned by 90 degrees from 3 to 70 s. The heading of the vehicle is constant."""
    flight, dt = LevelFlight(MAGNETIC, np.random.default_rng(1), amplitude=1.0), 0.04
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    kf = UnscentedKalmanFilter(MAGNETIC.replace(gnss=gnss))
    kf.initialize(flight.gnss(0.0)[0], magnetometer=flight.field())
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    times, out = np.arange(1, 3301) * dt, []
    for k, t in enumerate(times):
        kf.predict(*flight.sample(t - dt, dt), dt=dt)
        if k % 5 == 4:
            position, velocity = flight.gnss(t)
            field = turn @ flight.field() if 3.0 < t < 69.9 else flight.field()
            kf.update(position, gnss_velocity_G=velocity, magnetometer=field)
        out.append(kf._engine.read("compass_out")[0] > 0.0)
    first, last = times[out][[0, -1]]
    assert first < 6.0
    assert last == pytest.approx(70.0 + 60.0, abs=0.5)
    assert np.count_nonzero(out) == round((last - first) / dt) + 1


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("how", ["turned", "iron"])
def test_wrong_compass_is_left_out_and_the_heading_replaced(kind, how):
    suite = quad_gym.sensor_suite("consumer")
    suite = suite.replace(estimator=suite.estimator.replace(kind=kind))
    size = {"turned": {"angle": (1.0, math.pi)}, "iron": {"iron": 30e-6, "direction": (1, 1, 0)}}
    fault = MagnetometerDisturbance(how=how, start=3.0, **size[how])
    batch, worst = flown(suite, "circle", 3.0, faults=fault), 0.0
    for _ in range(16):
        steps(batch, 0.25)
        worst = max(worst, tilts(batch).max())
    assert math.degrees(worst) < 10.0
    steps(batch, 3.0)
    assert np.mean(nees(batch)) < 1.3
    assert np.abs(state_errors(batch)[:, 8]).max() < math.radians(15.0)


@pytest.mark.parametrize(
    ("suite", "task", "angle"),
    [
        ("consumer", "circle", math.pi),
        ("consumer", "random_trajectory", math.pi),
        ("field", "circle", 1.05),
    ],
)
def test_wrong_compass_from_the_start_is_found(suite, task, angle):
    batch, worst = flown(suite, task, faults=MagnetometerDisturbance(angle=angle)), 0.0
    for k in range(58):
        steps(batch, 0.05 if k < 20 else 0.25)
        worst = max(worst, tilts(batch).max())
    assert math.degrees(worst) < 10.0
    assert np.mean(nees(batch)) < 1.3


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
@pytest.mark.parametrize("off", [1.0, -1.6, 3.1])
def test_wrong_given_heading_is_replaced_by_that_of_the_motion(kind, off):
    flight, dt = LevelFlight(MAGNETIC, np.random.default_rng(3), amplitude=0.5), 0.02
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    kf = kind(MAGNETIC.replace(magnetometer=None, gnss=gnss))
    kf.initialize(flight.gnss(0.0)[0], heading=flight.yaw + off)
    for k in range(1, 301):
        kf.predict(*flight.sample((k - 1) * dt, dt), dt=dt)
        if k % 5 == 0:
            position, velocity = flight.gnss(k * dt)
            kf.update(position, gnss_velocity_G=velocity)
    sigma = math.sqrt(kf.covariance[8, 8])
    assert sigma < 0.1
    assert abs(flight.error(kf, 300 * dt)[8]) < 4.0 * sigma


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_unknown_heading_keeps_its_standard_deviation_without_motion(kind):
    flight, dt = LevelFlight(MAGNETIC, np.random.default_rng(0), amplitude=0.0), 0.02
    kf = kind(MAGNETIC)
    kf.initialize(flight.gnss(0.0)[0])
    first = math.sqrt(kf.covariance[8, 8])
    for k in range(1, 501):
        kf.predict(*flight.sample((k - 1) * dt, dt), dt=dt)
        if k % 5 == 0:
            position, velocity = flight.gnss(k * dt)
            kf.update(position, gnss_velocity_G=velocity)
            assert math.sqrt(kf.covariance[8, 8]) > 0.98 * first
    assert not kf.heading_known


@pytest.mark.parametrize("tilt_sigma", [0.03, 0.1])
@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_unknown_heading_is_turned_to_the_field_and_has_20_degrees(kind, tilt_sigma):
    """The noise of the field is so large that the update itself contributes nothing.

    A tilt beyond the usual 0.06 rad turns the level part of a steep field.
    """
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    compass = MAGNETIC.magnetometer.replace(noise_sigma=1e-3, declination=0.5)
    kf, R_BI = kind(MAGNETIC.replace(gnss=gnss, magnetometer=compass)), euler_to_dcm([0, 0, 0.8])
    kf.initialize(np.zeros(3), tilt_sigma=tilt_sigma)
    assert math.sqrt(kf.covariance[8, 8]) > 1.5
    kf.predict(np.zeros(3), [0.0, 0.0, GRAVITY])
    kf.update(magnetometer=R_BI @ compass.field_I)
    np.testing.assert_allclose(kf.R_BI, R_BI, atol=1e-5)
    leaning = math.tan(compass.inclination) ** 2 * max(tilt_sigma**2 - 0.06**2, 0.0)
    assert kf.covariance[8, 8] == pytest.approx(0.35**2 + leaning, rel=3e-3)


@pytest.mark.parametrize("off", [0.8, -2.0])
def test_heading_that_is_suddenly_wrong_is_replaced_by_the_third_fix(off):
    """The error is more than 4 standard deviations from then on, and only the motion shows it."""
    flight, dt = LevelFlight(MAGNETIC, np.random.default_rng(3), amplitude=0.5), 0.02
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    kf = UnscentedKalmanFilter(MAGNETIC.replace(magnetometer=None, gnss=gnss))
    kf.initialize(flight.gnss(0.0)[0], heading=flight.yaw)

    def fly_to(*times):
        for t in times:
            for k in range(5):
                kf.predict(*flight.sample(t - (5 - k) * dt, dt), dt=dt)
            position, velocity = flight.gnss(t)
            kf.update(position, gnss_velocity_G=velocity)
        return kf._engine.read("compass_out")[0]

    assert fly_to(*np.linspace(0.1, 4.0, 40)) == 0.0
    kf._engine.fill("R_hat", kf.R_BI @ euler_to_dcm([0.0, 0.0, off]))
    for t in (4.1, 4.2, 4.3):
        assert fly_to(t) == (t == 4.3)
    assert abs(flight.error(kf, 4.3)[8]) < 0.1
    np.testing.assert_allclose(kf.velocity[:2], kf._engine.read("level_state")[0, :2], atol=1e-3)


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_heading_is_less_certain_after_a_long_loss_of_gnss_and_none_is_reset(kind):
    flight, dt = LevelFlight(MAGNETIC, np.random.default_rng(3), amplitude=0.5), 0.02
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    kf = kind(MAGNETIC.replace(magnetometer=None, gnss=gnss))
    kf.initialize(flight.gnss(0.0)[0], heading=flight.yaw)
    sigmas = []
    for k in range(1, 2501):
        kf.predict(*flight.sample((k - 1) * dt, dt), dt=dt)
        if k % 5 == 0 and not 500 < k <= 2000:  # 30 s without GNSS
            position, velocity = flight.gnss(k * dt)
            kf.update(position, gnss_velocity_G=velocity)
        sigmas.append(math.sqrt(kf.covariance[8, 8]))
        assert abs(flight.error(kf, k * dt)[8]) < 4.0 * sigmas[-1]
        assert kf.heading_known
    assert (np.diff(sigmas[500:2000]) >= 0.0).all()
    assert sigmas[1999] > 1.2 * sigmas[499]
    assert kf._engine.read("compass_out")[0] == 0.0


@pytest.mark.parametrize("off", [0.0, 1.6])
def test_loss_of_gnss_adds_the_drift_of_the_gyro_to_the_heading_by_motion(off):
    """A loss of T adds T^2 times the variances of the biases, and a random walk, for any heading.

    N begins with the filter's heading, which is `off`.
    """
    flight, dt, loss = LevelFlight(MAGNETIC, np.random.default_rng(3), amplitude=0.5), 0.02, 5.0
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    kf = UnscentedKalmanFilter(MAGNETIC.replace(magnetometer=None, gnss=gnss))
    kf.initialize(flight.gnss(0.0)[0], heading=flight.yaw + off)
    fixes = {200, 200 + round(loss / dt)}  # the last one before, and the first one after the loss
    variances = []
    for k in range(1, max(fixes) + 1):
        kf.predict(*flight.sample((k - 1) * dt, dt), dt=dt)
        if (k % 5 == 0 and k < 200) or k in fixes:
            drift, (position, velocity) = np.trace(kf.covariance[12:, 12:]), flight.gnss(k * dt)
            kf.update(position, gnss_velocity_G=velocity)
        if k in fixes:
            u = kf._engine.read("level_state")[0, 2:4]
            variances.append(kf._engine.read("level_P")[0, 1] / (2.0 * u @ u))
    added = loss**2 * drift + 0.01**2 * loss / (u @ u)
    assert variances[1] - variances[0] == pytest.approx(added, rel=1e-6)
    assert loss**2 * drift > 0.01 * added


@pytest.mark.parametrize("step", [0.1, -0.3])
def test_gyro_whose_bias_changes_at_rest_is_corrected_by_the_compass(step):
    """N turns with the gyro, so that agreement without motion is no witness for both."""
    flight, dt = LevelFlight(MAGNETIC, np.random.default_rng(0), amplitude=1.0), 0.02
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    kf, rest = UnscentedKalmanFilter(MAGNETIC.replace(gnss=gnss)), 5.0
    kf.initialize(flight.gnss(0.0)[0], magnetometer=flight.field())
    at_rest = flight.truth(rest)
    swing = flight.truth
    flight.truth = lambda t: swing(t) if t < rest else at_rest
    flight.speed = flight.speed - at_rest["velocity"]  # so that it stands after the swing
    at_rest = swing(rest)
    errors = []
    for k in range(1, 1251):
        gyro, accel = flight.sample((k - 1) * dt, dt)
        changed = k * dt > 12.0
        kf.predict(gyro + np.array([0.0, 0.0, step * changed]), accel, dt=dt)
        if k % 5 == 0:
            position, velocity = flight.gnss(k * dt)
            kf.update(position, gnss_velocity_G=velocity, magnetometer=flight.field())
            assert kf._engine.read("compass_out")[0] == 0.0
            assert kf.heading_known
            errors.append(abs(flight.error(kf, k * dt)[8]))
    assert max(errors) < math.radians(40.0)
    assert max(errors[-50:]) < math.radians(8.0)


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_start_with_a_large_tilt_leaves_a_right_compass_in_use(kind):
    """The vehicle leans by 25 degrees, and the filter begins level."""
    flight, dt = LevelFlight(MAGNETIC, np.random.default_rng(2), amplitude=1.0), 0.02
    flight.R = euler_to_dcm([0.35, -0.27, 0.8])
    gnss = MAGNETIC.gnss.replace(secondary_antenna_B=None)
    kf = kind(MAGNETIC.replace(gnss=gnss))
    position, velocity = flight.gnss(0.0)
    kf.initialize(position, gnss_velocity_G=velocity, tilt_sigma=0.3)
    for k in range(1, 501):
        kf.predict(*flight.sample((k - 1) * dt, dt), dt=dt)
        if k % 5 == 0:
            position, velocity = flight.gnss(k * dt)
            kf.update(position, gnss_velocity_G=velocity, magnetometer=flight.field())
            assert kf._engine.read("compass_out")[0] == 0.0
    error = np.abs(flight.error(kf, 500 * dt)[6:9])
    assert np.hypot(*error[:2]) < math.radians(3.0)
    assert error[2] < math.radians(8.0)


@pytest.mark.parametrize("tilt_sigma", [0.02, 0.3])
def test_only_a_first_tilt_beyond_the_usual_one_is_expected_to_lean(tilt_sigma):
    """The usual one is 0.06 rad; the filter's tilt has two axes of this standard deviation."""
    flight = LevelFlight(MAGNETIC, np.random.default_rng(3))
    kf = UnscentedKalmanFilter(MAGNETIC)
    position, velocity = flight.gnss(0.0)
    kf.initialize(position, gnss_velocity_G=velocity, tilt_sigma=tilt_sigma)
    kf.predict(*flight.sample(0.0, 0.02), dt=0.02)
    expected = max(tilt_sigma**2 - 0.06**2, 0.0)
    assert kf._engine.read("level_first")[0] == pytest.approx(expected, rel=0.02, abs=1e-6)


def found_by_the_verdict(compass, apart, sigma, out, unknown=0.0, fields=None):
    """Findings on a replay of 40 s, whose heading differs from 10 s on until it is reset.

    Every `fields`-th measurement of the compass contradicts the heading.
    """
    time = np.arange(0.0, 40.0, 0.01)
    until = 14.0 if out else 40.0
    wrong = (time >= 10.0) & (time < until)
    result = SimpleNamespace(
        time=time,
        heading_apart=np.where(wrong, math.radians(apart), 0.01),
        motion_sigma=np.where(time < 8.0, np.inf, math.radians(sigma)),
        heading_known=(time < until) | (time >= until + unknown),
        compass_out=(time >= until) & (time < 30.0),
    )
    streams = {"magnetometer": None} if compass else {}
    suite = SimpleNamespace(magnetometer=object())
    log = SimpleNamespace(streams=streams)
    sensors = {}
    if fields is not None:
        stamps = np.arange(0.0, 40.0, 0.1)
        rejected = np.arange(len(stamps)) % fields == 0
        nis = np.where(rejected, 100.0, 1.0)
        sensors = {"magnetometer": SimpleNamespace(time=stamps, nis=nis, rejected=rejected)}
    case = SimpleNamespace(result=result, suite=suite, log=log, sensors=sensors)
    return [*contradicted(case)]


def test_verdict_says_which_heading_the_motion_contradicts():
    (turned,) = found_by_the_verdict(True, 92.0, 5.0, True)
    assert turned.severity == Severity.LOST
    for part in ("by 92 degrees (18 standard deviations) from 10.0 to 14.0 s", "about 90 degrees",
                 "reset to that of the motion", "rejected for 16 s"):  # fmt: skip
        assert part in turned.text
    (given,) = found_by_the_verdict(False, -30.0, 5.0, False)
    assert given.severity == Severity.LOST
    assert "the given heading (--heading) contradicts the GNSS velocities by 30" in given.text
    (small,) = found_by_the_verdict(True, 8.0, 1.0, True)  # the filter left the compass out in time
    assert small.severity == Severity.UNCERTAIN
    assert not found_by_the_verdict(True, 12.0, 5.0, False)  # 2.4 standard deviations
    (thrown,) = found_by_the_verdict(False, 5.0, 1.0, True, unknown=3.0)
    assert thrown.severity == Severity.LOST
    assert "wrong until 14.0 s, and unknown until 17.0 s" in thrown.text
    (vague,) = found_by_the_verdict(True, 0.0, 30.0, False)
    assert "no motion shows the heading" in vague.text


def test_verdict_blames_the_heading_before_where_the_compass_agrees_with_the_later_one():
    (start,) = found_by_the_verdict(True, 5.0, 1.0, True, unknown=3.0, fields=20)
    assert start.severity == Severity.UNCERTAIN
    assert "wrong until 14.0 s, and unknown until 17.0 s. The magnetometer agrees" in start.text
    (left_out,) = found_by_the_verdict(True, 5.0, 1.0, True, fields=20)
    assert "rejected for 16 s: the heading was wrong until 14.0 s" in left_out.text
    (compass,) = found_by_the_verdict(True, 5.0, 1.0, True, unknown=3.0, fields=2)
    assert compass.severity == Severity.LOST
    assert "the heading of the magnetometer contradicts" in compass.text
