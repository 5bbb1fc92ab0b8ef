"""Level starts with one antenna, and a heading from another source or an unknown heading."""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.estimation.starts import level_start, still_start
from quad_gym.kernels.filter.starts import _set_magnetic_heading
from quad_gym.records import Outcome, joint_covariance
from quad_gym.rotations import euler_to_dcm
from tests.field_flights import fly
from tests.filter_states import set_at_rest
from tests.level_flights import GRAVITY, MAGNETIC, R_IG, LevelFlight
from tests.unit.compiled import Compiled

KINDS = (UnscentedKalmanFilter, ExtendedKalmanFilter)
DRAWS = 300
STEADY = MAGNETIC.replace(  # biases stay constant, as in the flights
    imu=MAGNETIC.imu.replace(accel_bias_tau=1e7, gyro_bias_tau=1e7)
)
ONE_ANTENNA = MAGNETIC.replace(gnss=MAGNETIC.gnss.replace(secondary_antenna_B=None))


def start(flight, kf, how):
    position, velocity = flight.gnss(0.0)
    if how == "heading":
        kf.initialize(position, heading=flight.yaw + flight.rng.normal(0.0, 0.05))
    elif how == "magnetometer":
        kf.initialize(position, magnetometer=flight.field())
    elif how == "course":  # the nose is within 0.2 rad of the course
        kf.initialize(position, gnss_velocity_G=velocity, course=True, heading_sigma=0.2)
    else:
        kf.initialize(position)
    return kf


def flight_for(how, seed):
    rng = np.random.default_rng(seed)
    flight = LevelFlight(MAGNETIC, rng)
    if how == "course":
        course = flight.yaw + rng.normal(0.0, 0.2)
        flight.drift = np.array([6.0 * math.cos(course), 6.0 * math.sin(course), 0.0])
        flight.speed = np.zeros(3)
    return flight


def share(dimension, count):
    """Return the 99.9 % interval of the mean NEES of a consistent filter."""
    return chi2.ppf((0.0005, 0.9995), dimension * count) / count


def test_first_estimate_does_not_depend_on_earlier_content_of_its_memory():
    """An exported filter has one record for all its starts."""
    found = []
    for held in (0.0, np.nan):
        first = level_start(MAGNETIC)
        first["root"], first["e"], first["P"] = held, held, held
        found.append(still_start(first, np.zeros(3)).covariance)
    np.testing.assert_array_equal(*found)
    assert np.isfinite(found[0]).all()


@pytest.mark.parametrize("how", ["heading", "magnetometer", "course", "nothing"])
def test_initial_errors_match_the_initial_covariance(how):
    """An unknown heading has errors as large as the covariance, but they are not Gaussian."""
    squares, kf = [], UnscentedKalmanFilter(MAGNETIC)
    count = DRAWS if how != "nothing" else 100
    for seed in range(count):
        flight = flight_for(how, seed)
        start(flight, kf, how)
        error, P = flight.error(kf, 0.0), kf.covariance
        parts = [error[i : i + 3] @ np.linalg.solve(P[i : i + 3, i : i + 3], error[i : i + 3])
                 for i in (0, 3, 6)]  # fmt: skip
        squares.append([error @ np.linalg.solve(P, error), *parts])
    whole, *parts = np.mean(squares, axis=0)
    low, high = share(15, count)
    known = how != "nothing"  # otherwise errors of the lever arm are bounded, not Gaussian
    assert low * known < whole < high
    low, high = share(3, count)
    for part in parts:
        assert low * known < part < high
    assert kf.heading_known == known


@pytest.mark.parametrize("suite", [ONE_ANTENNA, quad_gym.sensor_suite("consumer")])
def test_batch_and_filter_class_start_with_same_heading_from_magnetometer(suite):
    """Kernels and NumPy start filters with the same attitude, position and covariance."""
    batch, kf = fly(suite, 4, task="hover", seed=3), UnscentedKalmanFilter(suite)
    read = {
        name: batch.record(name)
        for name in ("R_hat", "r_hat", "v_hat", "P", "P_slow", "gnss_position", "magnetometer")
    }
    states = int(kf._engine.settings["slow_states"][0])
    for n in range(4):
        field = read["magnetometer"][n]
        kf.initialize(read["gnss_position"][n], magnetometer=field)
        np.testing.assert_allclose(kf.R_BI, read["R_hat"][n], atol=1e-12)
        np.testing.assert_allclose(kf.position, read["r_hat"][n], atol=1e-12)
        np.testing.assert_allclose(kf.velocity, read["v_hat"][n], atol=1e-12)
        ours = kf._engine.covariances()[0]
        theirs = joint_covariance(read["P"][n], read["P_slow"][n, :states])
        sigma = 1e-30 + np.sqrt(np.diag(theirs))
        units = sigma * sigma[:, np.newaxis]
        np.testing.assert_allclose(ours / units, theirs / units, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_unknown_heading_is_found_from_motion(kind):
    """In 25 flights the NEES stays in its bounds (false alarms: 0.4 %); the heading is found."""
    count, dt, kf = 25, 0.02, kind(STEADY)
    squares = np.zeros((count, 4))
    resolved = []
    for seed in range(count):
        flight = LevelFlight(STEADY, np.random.default_rng(seed), amplitude=0.5)
        start(flight, kf, "nothing")
        t, since, looks = 0.0, None, []
        for k in range(1, 151):
            kf.predict(*flight.sample(t, dt), dt=dt)
            t = k * dt
            if k % 5 == 0:
                position, velocity = flight.gnss(t)
                kf.update(position, gnss_velocity_G=velocity)
            if since is None and kf.heading_known:
                since = t
            if k in (25, 50, 100, 150):
                looks.append(flight.nees(kf, t))
        resolved.append(since)
        squares[seed] = looks
        assert abs(flight.error(kf, t)[8]) < 5.0 * math.sqrt(kf.covariance[8, 8])
    assert all(time is not None and time < 3.0 for time in resolved)
    low, high = share(15, count)
    mean = squares.mean(axis=0)
    assert (mean < high).all(), mean  # an unknown heading has a larger covariance than errors
    assert low < mean[-1]


def test_unknown_heading_without_motion_stays_unknown():
    rng = np.random.default_rng(0)
    flight = LevelFlight(MAGNETIC, rng, amplitude=0.0)
    kf = start(flight, UnscentedKalmanFilter(MAGNETIC), "nothing")
    for k in range(50):
        kf.predict(*flight.sample(0.02 * k, 0.02), dt=0.02)
        kf.update(flight.gnss(0.02 * (k + 1))[0])
    assert not kf.heading_known
    assert math.sqrt(kf.covariance[8, 8]) > 1.0
    np.testing.assert_allclose(kf.R_BI @ kf.R_BI.T, np.eye(3), atol=1e-12)
    kf.initialize(flight.gnss(0.0)[0], heading=0.3)  # a new start
    assert kf.heading_known


def test_drift_of_gnss_grows_while_the_heading_is_unknown():
    """As a Gauss-Markov process that begins with zero: s^2 (1 - exp(-2 t / tau)) on each axis."""
    gnss = MAGNETIC.gnss.replace(
        secondary_antenna_B=None,
        velocity_sigma=None,
        drift_sigma_I=(0.5, 0.6, 0.9),
        drift_tau=20.0,
    )
    kf = UnscentedKalmanFilter(MAGNETIC.replace(gnss=gnss))
    kf.initialize(np.zeros(3))
    for _ in range(50):
        kf.predict(np.zeros(3), [0.0, 0.0, GRAVITY], dt=0.02)
        kf.update()
    assert not kf.is_single
    expected = np.square(gnss.drift_sigma_I) * (1.0 - math.exp(-2.0 / 20.0))
    np.testing.assert_allclose(kf.gnss_drift_covariance, np.diag(expected), rtol=1e-9, atol=1e-9)


def test_weights_of_headings_are_the_likelihoods_of_a_measurement():
    """N(z - r, P + R) of a position z, for lanes with other means r and covariances P."""
    gnss = MAGNETIC.gnss.replace(
        primary_antenna_B=(0.0, 0.0, 0.0),
        secondary_antenna_B=None,
        velocity_sigma=None,
        drift_sigma_I=(0.0, 0.0, 0.0),
    )
    kf = UnscentedKalmanFilter(MAGNETIC.replace(gnss=gnss))
    kf.initialize(np.zeros(3))
    engine, rng = kf._engine, np.random.default_rng(3)
    lanes = len(kf._log_weights)
    places, widths = rng.normal(size=(lanes, 3)), rng.uniform(0.5, 2.0, (lanes, 3))
    others = engine.covariances().shape[-1] - 3
    covariances = np.array([np.diag([*w**2, *[1e-4] * others]) for w in widths])
    engine.write("r_hat", places)
    engine.write_covariances(covariances)
    z, before = np.array([0.4, -0.2, 0.3]), kf._log_weights.copy()
    kf.update(R_IG.T @ z)
    variances = widths**2 + np.square(gnss.position_sigma_I)
    logs = before - 0.5 * ((z - places) ** 2 / variances + np.log(variances)).sum(axis=1)
    logs -= np.log(np.exp(logs).sum())
    np.testing.assert_allclose(kf._log_weights, logs, rtol=0.0, atol=1e-6)


def test_late_measurements_resolve_the_heading_as_those_in_time():
    flight = LevelFlight(MAGNETIC, np.random.default_rng(2), amplitude=0.5)
    first, *_ = flight.gnss(0.0)
    in_time, late = (UnscentedKalmanFilter(MAGNETIC) for _ in range(2))
    waiting, told = [], []
    for kf in (in_time, late):
        kf.initialize(first)
    for k in range(1, 151):
        sample = flight.sample(0.02 * (k - 1), 0.02)
        for kf in (in_time, late):
            kf.predict(*sample, dt=0.02)
        if k % 5 == 0:
            position, velocity = flight.gnss(0.02 * k)
            in_time.update(position, gnss_velocity_G=velocity)
            waiting.append((k + 12, late.time, position, velocity))
        for due, stamp, position, velocity in waiting:
            if due == k:
                late.update(position, gnss_velocity_G=velocity, time=stamp)
        told.append((in_time.heading_known, late.heading_known))
    for due, stamp, position, velocity in waiting:
        if due > 150:
            late.update(position, gnss_velocity_G=velocity, time=stamp)
    assert in_time.heading_known
    assert (True, False) in told  # the late filter resolves it later
    np.testing.assert_array_equal(in_time.covariance, late.covariance)
    np.testing.assert_array_equal(in_time.position, late.position)


def test_start_with_baseline_uses_given_velocity_and_noise():
    kf = UnscentedKalmanFilter(MAGNETIC)
    kf.initialize(
        np.zeros(3), [1.0, 0.0, 0.0], gnss_velocity_G=R_IG.T @ [1.0, 2.0, 0.5],
        velocity_sigma=0.2, gnss_sigma=[0.3, 0.4, 0.5], time=7.0,
    )  # fmt: skip
    np.testing.assert_allclose(kf.velocity, [1.0, 2.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(kf.covariance))[3:6], 0.2)
    np.testing.assert_allclose(np.sqrt(np.diag(kf.covariance))[:3], [0.3, 0.4, 0.5], rtol=1e-3)
    assert kf.time == 7.0


FIX, SPEED = np.zeros(3), np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"heading": 0.1, "magnetometer": [1e-5, 1e-5, 0.0]}, "only one of heading"),
        ({"heading": 0.1, "heading_sigma": 0.0}, "heading_sigma"),
        ({"heading_sigma": 0.1}, "heading_sigma must come with"),
        ({"magnetometer": [0.0, 0.0, 4e-5]}, "level part of the field"),
        ({"magnetometer_sigma": 1e-6}, "magnetometer_sigma must come with"),
        ({"course": True}, "course must come with gnss_velocity_G"),
        ({"course": True, "gnss_velocity_G": [0.01, 0.0, 0.0]}, "course must belong to a moving"),
        ({"velocity_sigma": 0.1}, "velocity_sigma must come with"),
        ({"tilt_sigma": -0.1}, "tilt_sigma"),
        ({"time": math.inf}, "time"),
        ({"gnss_baseline_G": SPEED, "magnetometer": SPEED}, "magnetometer must not be given with"),
        ({"gnss_baseline_G": SPEED, "gnss_sigma": np.eye(3)}, "gnss_sigma"),
        ({"heading": 90.0}, r"heading must be in rad, .*, got 90; did you mean 1\.571\?"),
        ({"heading": -7.0, "gnss_baseline_G": SPEED}, "heading must be in rad"),
        ({"heading": 0.0, "heading_sigma": 10.0}, "heading_sigma must be in rad"),
    ],
)
@pytest.mark.parametrize("running", [False, True])
def test_bad_starts_raise_and_change_nothing(given, message, running):
    kf = UnscentedKalmanFilter(MAGNETIC)
    if running:
        kf.initialize(FIX, heading=0.5)
        before = kf.covariance
    with pytest.raises(ValueError, match=message):
        kf.initialize(FIX, **given)
    if running:
        np.testing.assert_array_equal(kf.covariance, before)
    else:
        with pytest.raises(RuntimeError, match="initialize"):
            _ = kf.position


def test_suites_without_the_sensor_are_refused():
    with pytest.raises(ValueError, match="no magnetometer"):
        UnscentedKalmanFilter(quad_gym.sensor_suite("rtk")).initialize(FIX, magnetometer=SPEED)
    with pytest.raises(ValueError, match="no GNSS"):
        UnscentedKalmanFilter(quad_gym.sensor_suite("indoor")).initialize(FIX)
    lab = UnscentedKalmanFilter(quad_gym.sensor_suite("lab"))
    with pytest.raises(ValueError, match="velocity_sigma must be given"):
        lab.initialize(FIX, gnss_velocity_G=SPEED)
    lab.initialize(FIX, gnss_velocity_G=SPEED, velocity_sigma=0.1, heading=0.0)
    np.testing.assert_allclose(np.sqrt(np.diag(lab.covariance))[6:9], [0.03, 0.03, 0.05])
    indoor = UnscentedKalmanFilter(quad_gym.sensor_suite("indoor"))
    set_at_rest(indoor, np.eye(15) * 1e-2)
    for kf, sensor, given in (
        (lab, "barometer", {"barometer": 1.0}),
        (lab, "magnetometer", {"magnetometer": SPEED}),
        (indoor, "GNSS", {"gnss_position_G": FIX}),
    ):
        with pytest.raises(ValueError, match=sensor):
            kf.update(**given)


class Field(NamedTuple):
    """Inputs of a heading from a magnetometer."""

    field_I: Any
    field_B: Any
    field_sigma: Any
    iron: int
    declination: int


def heading_of_field(s, option):
    s.outcome = _set_magnetic_heading(s, Field(s.field_I, s.field_B, s.field_sigma, 0, 3))


vectors = dict.fromkeys(("field_I", "field_B"), (3,))
found = {"heading": (), "heading_sigma": (), "heading_of_tilt": (2,), "heading_of_slow": (4,)}
headings = Compiled(heading_of_field, T=(3, 3), field_sigma=(), outcome=(), **vectors, **found)


def heading_from(field_I, e, field_B=None):
    """Return the heading, and other results, of a vehicle with known tilt at Euler angles e."""
    field_B = euler_to_dcm(e) @ field_I if field_B is None else field_B
    given = {"T": euler_to_dcm([e[0], e[1], 0.0]), "field_I": field_I, "field_B": field_B}
    got = headings.on_floats(**{k: [v] for k, v in given.items()}, field_sigma=[0.02])
    return {name: value[0] for name, value in got.items()}


@pytest.mark.parametrize("field_I", [(0.2, 0.5, -0.8), (-0.6, 0.1, 0.5), (0.3, -0.4, 0.0)])
def test_heading_of_a_field_and_its_derivatives_have_the_closed_form(field_I):
    field_I, e = np.array(field_I), np.array([0.3, -0.4, 2.0])
    got = heading_from(field_I, e)
    assert got["outcome"] == Outcome.OK
    assert math.remainder(got["heading"] - e[2], math.tau) == pytest.approx(0.0, abs=1e-14)
    assert got["heading_sigma"] == pytest.approx(0.02 / np.hypot(*field_I[:2]), rel=1e-14)
    field_B, h = euler_to_dcm(e) @ field_I, 1e-5
    for i, d in enumerate(h * np.eye(3)):  # the error of the heading is truth minus estimate
        ends = [heading_from(field_I, e, field_B + sign * d)["heading"] for sign in (1, -1)]
        slope = math.remainder(ends[0] - ends[1], math.tau) / (2.0 * h)
        assert got["heading_of_slow"][i] == pytest.approx(-slope, abs=1e-8)
    assert abs(got["heading_of_slow"][3]) == pytest.approx(1.0, abs=1e-14)  # declination


@pytest.mark.parametrize("azimuth", [0.3, 1.5])
@pytest.mark.parametrize("share", [0.9e-3, 1.1e-3])
def test_almost_vertical_field_gives_no_heading(azimuth, share):
    """The limit is a level part of a thousandth of the strength."""
    level = 0.4 * share * np.array([np.cos(azimuth), np.sin(azimuth)])
    outcome = heading_from(np.append(level, -0.4), np.array([0.1, 0.2, 0.3]))["outcome"]
    assert outcome == (Outcome.OK if share > 1e-3 else Outcome.OUT_OF_RANGE)
