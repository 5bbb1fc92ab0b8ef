"""Filters with a barometer and a magnetometer are consistent, with latency and after any start."""

import numpy as np
import pytest

import quad_gym
from quad_gym import BarometerParams, MagnetometerParams
from quad_gym.packing import slow_states
from quad_gym.records import AID_BLOCKS, Aid
from tests.field_flights import fly, nees, state_errors, steps


def aided(suite, kind="ukf", late=False, gate=True, **sensors):
    """Return a simplified suite with a barometer and a magnetometer, or with the given sensors."""
    plain = quad_gym.sensor_suite(suite).simplified()
    choices = {} if gate else {"false_alarm_probability": 0.0}
    both = {
        "barometer": BarometerParams(latency=0.03 * late),
        "magnetometer": MagnetometerParams(latency=0.02 * late),
    }
    if late and plain.gnss is not None:
        sensors["gnss"] = plain.gnss.replace(latency=0.1)
    estimator = plain.estimator.replace(kind=kind, **choices)
    return plain.replace(estimator=estimator, **both | sensors)


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_filter_with_late_gated_measurements_is_consistent(kind):
    """Standard deviations of means over 300 flights are 0.32 for NEES, 0.08 and 0.14 for NIS."""
    batch = fly(aided("consumer", kind, late=True), 300, filter_start="warm")
    steps(batch, 2.0)
    assert not batch.record("filter_status").any()
    assert nees(batch).mean() == pytest.approx(15.0, abs=1.4)
    nis = batch.record("block_nis")[:, AID_BLOCKS:].mean(axis=0)
    assert nis[Aid.BAROMETER] == pytest.approx(1.0, abs=0.35)
    assert nis[Aid.MAGNETOMETER] == pytest.approx(3.0, abs=0.6)
    assert (batch.record("rejections")[:, AID_BLOCKS:] <= 1).all()


def test_heading_error_during_maneuvers_matches_covariance():
    """The mean square of 1,200 errors has a standard deviation of 0.04. It would be 1.3 if velocity
    did not observe the heading and hard iron did not follow it; unit tests detect either alone."""
    batch = fly(quad_gym.sensor_suite("consumer"), 1200, task="hover", filter_start="cold")
    steps(batch, 1.5)
    vertical = batch.record("R_hat")[:, :, 2]
    error = np.einsum("ni,ni->n", vertical, state_errors(batch)[:, 6:9])
    P = batch.covariance()[:, 6:9, 6:9]
    variance = np.einsum("ni,nij,nj->n", vertical, P, vertical)
    assert (error**2 / variance).mean() == pytest.approx(1.03, abs=0.13)


def test_joint_error_of_state_and_slow_errors_matches_warm_start_covariance():
    """The joint error has the joint covariance, and is uncorrelated with the estimate."""
    sensors = aided("consumer")
    batch, flights = fly(sensors, 4000, task="hover", filter_start="warm"), 4000
    places = slow_states(sensors)
    vector, errors = places.vectors[Aid.MAGNETOMETER], np.zeros((flights, 9))
    hat = batch.record("slow_hat")
    errors[:, :3] = batch.record("drift") - hat[:, :3]
    iron = batch.record("aid_vector")[:, Aid.MAGNETOMETER]
    errors[:, vector : vector + 3] = iron - hat[:, vector : vector + 3]
    for aid in Aid:
        k = places.scalars[aid]
        errors[:, k] = batch.record("aid_scalar")[:, aid] - hat[:, k]
    L = np.zeros((flights, 24, 24))
    L[:, :15, :15], L[:, 15:] = batch.record("L"), batch.record("L_slow")
    joint = np.concatenate([state_errors(batch), errors], axis=1)
    white = np.linalg.solve(L, joint[..., np.newaxis])[..., 0][:, :23]  # the last state is unused
    np.testing.assert_allclose(np.cov(white.T), np.eye(23), atol=0.1)
    estimate = hat[:, vector : vector + 3]
    correlation = (estimate * errors[:, vector : vector + 3]).mean(axis=0)
    correlation /= estimate.std(axis=0) * errors[:, vector : vector + 3].std(axis=0)
    assert (abs(correlation) < 0.08).all()
