"""Consistency monitoring: it runs wherever faults are simulated, and few errors go undetected."""

import math

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.estimation import UnscentedKalmanFilter
from quad_gym.faults import GnssJump, GyroBiasStep, PositionJump
from quad_gym.frames import ecef_to_enu
from quad_gym.records import AID_GROUPS, POSITION_BLOCK, Aid, Source
from tests.builders import batch as flights_of
from tests.field_flights import fly, nees, steps

STEP = GyroBiasStep(start=0.5, size=math.radians(3.0))
NEVER = STEP.replace(start=1e6)
RIGHT = stats.chi2.ppf(0.9973, 9)
"""Bound on the NEES of position, velocity and attitude, as in `quad-gym consistency --recovery`."""


def hovering(**keywords):
    if keywords.get("source") is not Source.TRUTH:
        keywords["filter_start"] = "warm"
    return flights_of(16, **{"task": TASK_DEFAULTS["hover"], "gains": "tuned", **keywords})


def silent(batch):
    """Return (n,) flags of filters that are wrong and not flagged as diverged."""
    return (nees(batch, slice(0, 9)) > RIGHT) & ~(batch.record("diverged") > 0.0)


def share_silent(batch, times, every):
    """Return the mean share of undetected errors at `times` instants, `every` seconds apart."""
    found = []
    for _ in range(times):
        steps(batch, every)
        found.append(silent(batch).mean())
    return np.mean(found)


def test_gyro_bias_step_sets_filter_diverged_in_default_suite():
    env = QuadVectorEnv(16, "hover", faults=STEP, start="hover", filter_start="warm")
    _, info = env.reset(seed=0)
    assert not info["filter_diverged"].any()
    lost = np.zeros(16, bool)
    for _ in range(150):
        *_, info = env.step(np.zeros((16, 4)))
        lost |= info["filter_diverged"]
    assert lost.mean() > 0.9
    assert "innovations" not in info


@pytest.mark.parametrize("suite", ["standard", "lab"])
def test_consistency_monitoring_does_not_change_flight(suite):
    plain, watching = hovering(sensors=suite), hovering(sensors=suite, faults=NEVER)
    for batch in (plain, watching):
        steps(batch, 1.0)
    for name in ("r", "q", "r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat", "L"):
        np.testing.assert_array_equal(plain.record(name), watching.record(name))
    assert np.isnan(plain.record("block_nis")).all()
    assert np.isfinite(watching.record("block_nis")[:, 0]).all()
    ends = hovering(task=TASK_DEFAULTS["hover"].replace(truncate_when_diverged=True))
    on_truth = hovering(source=Source.TRUTH, faults="rotor_loss")
    for batch, watches in ((ends, True), (on_truth, False)):
        steps(batch, 0.1)
        assert (np.isfinite(batch.record("block_nis")[:, 0]) == watches).all()


@pytest.mark.parametrize("tau", [100.0, 1e6])
def test_diverged_flag_lasts_about_as_long_as_error(tau):
    """If biases hardly change, their standard deviations keep falling, and errors last."""
    suite = quad_gym.sensor_suite("standard")
    imu = suite.imu.replace(accel_bias_tau=tau, gyro_bias_tau=tau)
    jump = GnssJump(start=1.0, duration=0.3, size=0.5)
    batch = hovering(sensors=suite.replace(imu=imu), faults=jump)
    lost, wrong = [], []
    for _ in range(90):
        steps(batch, 1.0)
        lost.append(batch.record("diverged") > 0.0)
        wrong.append(nees(batch, slice(0, 9)) > RIGHT)
        held = (batch.record("alarm_tick") - batch.record("tick")) * imu.dt
        assert held.max() < 60.0  # not P/Q of nearly constant biases, 1e5 s
    assert np.mean(lost[1:4]) == 1.0
    assert np.mean(np.array(wrong) & ~np.array(lost)) <= 0.02
    assert np.mean(lost[65:]) <= 0.02 + 2.0 * np.mean(wrong[30:])


def test_gnss_jump_is_detected_without_gate():
    fault = GnssJump(start=1.0, duration=2.0, size=0.5)
    batch = fly(quad_gym.sensor_suite("standard"), 128, filter_start="warm", faults=fault)
    steps(batch, 5.0)
    assert share_silent(batch, times=8, every=0.5) <= 0.01


def test_few_jumps_of_the_vehicle_go_undetected():
    """The rate is 0.75 %, so more than 8 of 320 flights have a probability of 1e-3. With inflations
    smaller than the jump, the rate was some 6 %."""
    fault = PositionJump(start=1.0, size=(1.0, 2.0))
    batch = fly(quad_gym.sensor_suite("consumer"), 320, filter_start="warm", faults=fault)
    steps(batch, 8.0)
    assert silent(batch).mean() <= 0.025


class AtRest:
    """The filter of `consumer` at rest, with given errors of measurements."""

    def __init__(self):
        suite = quad_gym.sensor_suite("consumer").simplified()
        self.suite = suite.replace(gnss=suite.gnss.replace(latency=0.0))
        self.ukf = UnscentedKalmanFilter(self.suite)
        self.ukf.initialize(np.zeros(3), heading=0.0, heading_sigma=0.05)
        self.R_IG = ecef_to_enu(self.suite.gnss.reference_antenna_G)
        self.rng = np.random.default_rng(0)

    def measure(self, off=0.0, altitude=0.0, field=0.0):
        """Update once with all sensors, the fix `off` in x [m], and predict 0.1 s of rest."""
        gnss, rng = self.suite.gnss, self.rng
        fix = np.array(gnss.primary_antenna_B) + rng.normal(size=3) * gnss.position_sigma_I
        noise = rng.normal(size=3) * self.suite.magnetometer.noise_sigma
        self.ukf.update(
            gnss_position_G=self.R_IG.T @ (fix + np.array([off, 0.0, 0.0])),
            gnss_velocity_G=self.R_IG.T @ (rng.normal(size=3) * gnss.velocity_sigma),
            barometer=altitude + rng.normal() * self.suite.barometer.noise_sigma,
            magnetometer=self.suite.magnetometer.field_I + noise + np.array([field, 0.0, 0.0]),
        )
        for _ in range(round(0.1 * self.suite.imu.rate)):
            self.ukf.predict(np.zeros(3), np.array([0.0, 0.0, self.suite.estimator.gravity]))

    def set_rejected(self, group, times):
        self.ukf._engine.blocks["rejected_in_row"][:, group] = times

    def assert_position_is_known(self):
        assert abs(self.ukf.position[0]) < 0.3
        assert np.sqrt(self.ukf.covariance[0, 0]) < 0.2


def test_filter_recovers_from_position_error_of_2000_m():
    flight = AtRest()
    for _ in range(10):
        flight.measure()
    for _ in range(270):  # the time limit of a step is 25 s
        flight.measure(off=2000.0)
    assert flight.ukf.position[0] == pytest.approx(2000.0, abs=20.0)
    assert np.sqrt(flight.ukf.covariance[0, 0]) < 20.0


def test_fix_outlier_is_rejected_after_rejected_magnetometer_readings():
    flight = AtRest()
    for _ in range(20):
        flight.measure()
    flight.set_rejected(AID_GROUPS + Aid.MAGNETOMETER, 9.0)
    flight.measure(off=30.0, field=1e-5)
    assert flight.ukf._engine.read("resets")[0, AID_GROUPS + Aid.MAGNETOMETER] == 1.0
    flight.assert_position_is_known()
    for _ in range(10):
        flight.measure()
    flight.assert_position_is_known()


def test_fixes_and_heights_rejected_together_reset_the_position():
    flight = AtRest()
    for _ in range(20):
        flight.measure()
    engine = flight.ukf._engine
    for group in (POSITION_BLOCK, AID_GROUPS + Aid.BAROMETER):
        flight.set_rejected(group, 9.0)
        engine.blocks["stepped"][:, group] = 1.0
    flight.measure(off=30.0, altitude=5.0)
    assert engine.read("resets")[0, AID_GROUPS + Aid.BAROMETER] == 1.0
    assert engine.read("resets")[0, POSITION_BLOCK] == 1.0
    assert np.sqrt(flight.ukf.covariance[0, 0]) == pytest.approx(30.0, abs=1.0)
    flight.measure(off=30.0, altitude=5.0)
    assert flight.ukf.position[0] == pytest.approx(30.0, abs=2.0)
