"""GNSS with one antenna: no baseline; the magnetometer gives the filter's initial heading."""

import numpy as np
import pytest

import quad_gym
from quad_gym import FlightBatch, UnscentedKalmanFilter
from quad_gym.packing import slow_states
from quad_gym.records import AID_BLOCKS, BASELINE_BLOCK, Aid
from quad_gym.sensors import GnssReceiver
from tests.field_flights import fly, state_errors, steps

CONSUMER = quad_gym.sensor_suite("consumer")
GNSS, MAGNETOMETER = CONSUMER.gnss, CONSUMER.magnetometer
PLACES = slow_states(CONSUMER)
IRON = PLACES.vectors[Aid.MAGNETOMETER]
DELTA = PLACES.scalars[Aid.MAGNETOMETER]
JOINT = [*range(15), *(15 + IRON + np.arange(3)), 15 + DELTA]


def nees_of(errors, factors):
    """NEES of states, hard iron and declination, by factors (n, 24, 24) of the joint covariance."""
    P = (factors @ factors.transpose(0, 2, 1))[:, JOINT][:, :, JOINT]
    return (errors * np.linalg.solve(P, errors[..., np.newaxis])[..., 0]).sum(axis=1)


@pytest.mark.parametrize("start", ["ground", "hover"])
def test_initial_errors_agree_with_the_initial_covariance(start):
    """The mean of 2,000 NEES has a standard deviation of 0.14 if errors are Gaussian."""
    batch = fly(CONSUMER, 2000, task="hover", start=start)
    errors = np.zeros((2000, 19))
    errors[:, :15] = state_errors(batch)
    errors[:, 15:18] = batch.record("aid_vector")[:, Aid.MAGNETOMETER]
    errors[:, 18] = batch.record("aid_scalar")[:, Aid.MAGNETOMETER]
    factors = np.zeros((2000, 24, 24))
    factors[:, :15, :15], factors[:, 15:] = batch.record("L"), batch.record("L_slow")
    heading = abs(errors[:, 8])
    assert 0.03 < heading.mean() < 0.08
    mean = nees_of(errors, factors).mean()
    assert mean < 19.7
    # standing vehicles are more level and move less than the filter assumes
    assert mean > (18.3 if start == "hover" else 12.0)


def test_sample_that_initializes_the_filter_is_used_once():
    suite = CONSUMER.replace(
        barometer=CONSUMER.barometer.replace(phase=0.0),
        magnetometer=MAGNETOMETER.replace(phase=0.0),
    )
    for start, valid in (("cold", 0.0), ("warm", 1.0)):
        batch = fly(suite, 16, filter_start=start)
        assert (batch.record("block_valid")[:, AID_BLOCKS:][:, Aid.MAGNETOMETER] == valid).all()
        assert (batch.record("block_valid")[:, AID_BLOCKS:][:, Aid.BAROMETER] == 1.0).all()
        nis = batch.record("block_nis")[:, AID_BLOCKS + Aid.MAGNETOMETER]
        assert np.isfinite(nis).all() == (start == "warm")


def test_one_antenna_measures_no_baseline():
    batch = fly(CONSUMER, 16)
    for _ in range(30):
        steps(batch, 0.05)
        assert not batch.record("block_valid")[:, BASELINE_BLOCK].any()
        assert not batch.record("block_fresh")[:, BASELINE_BLOCK].any()
        assert not batch.record("gnss_baseline").any()
    receiver = GnssReceiver(GNSS, np.random.default_rng(1))
    position, baseline = receiver.measure(np.zeros(3), np.eye(3))
    assert np.isfinite(position).all()
    assert np.isnan(baseline).all()
    assert np.isnan(batch.record("block_nis")[:, BASELINE_BLOCK]).all()
    assert np.isfinite(batch.record("block_nis")[:, 0]).all()


def test_initial_pose_gives_the_heading_without_a_magnetometer():
    alone = CONSUMER.replace(magnetometer=None)
    batch = fly(alone, 1000, task="hover")
    heading = state_errors(batch)[:, 8]
    sigma = alone.initial_pose.heading_sigma
    assert np.sqrt((heading**2).mean()) == pytest.approx(sigma, rel=0.15)
    np.testing.assert_allclose(np.linalg.norm(batch.record("L")[:, 8], axis=1), sigma, rtol=1e-3)


def test_inputs_for_the_wrong_number_of_antennas_are_refused():
    ukf, fix, field = UnscentedKalmanFilter(CONSUMER), np.zeros(3), MAGNETOMETER.field_I
    with pytest.raises(ValueError, match="gnss_baseline_G must be None"):
        ukf.initialize(fix, (1.0, 0.0, 0.0), magnetometer=field)
    with pytest.raises(RuntimeError):
        _ = ukf.position
    ukf.initialize(fix, magnetometer=field)
    with pytest.raises(ValueError, match="gnss_baseline_G must be None"):
        ukf.update(gnss_baseline_G=(1.0, 0.0, 0.0))
    two = UnscentedKalmanFilter(quad_gym.sensor_suite("rtk"))
    with pytest.raises(ValueError, match="magnetometer must not be given"):
        two.initialize(fix, (1.0, 0.0, 0.0), magnetometer=field)
    with pytest.raises(ValueError, match="secondary_antenna_B must be given"):
        _ = GNSS.baseline_B
    with pytest.raises(ValueError, match="GNSS with two antennas"):
        FlightBatch(1, sensors=CONSUMER, randomization={"baseline_sigma": quad_gym.Uniform(0, 1)})
    true = CONSUMER.replace(gnss=GNSS.replace(secondary_antenna_B=(0.1, 0.0, 0.05)))
    with pytest.raises(ValueError, match="number of gnss_baseline measurements"):
        FlightBatch(1, sensors=CONSUMER, true_sensors=true)
