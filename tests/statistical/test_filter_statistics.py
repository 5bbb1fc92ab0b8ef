"""Errors and covariances of the filter over thousands of flights.
The seeds are fixed, so the tests are repeatable. With random seeds, a false alarm would have a
probability below 1e-6."""

import numpy as np
import pytest

import quad_gym
from quad_gym.params.task import TaskParams
from quad_gym.records import Source
from tests.builders import batch as flights_of
from tests.field_flights import nees

LAB = quad_gym.sensor_suite("lab")
PREDICTED = LAB.replace(estimator=LAB.estimator.replace(bearing_noise_at="predicted"))
FLIGHTS = 300


def circle_batch(sensors=LAB, source=Source.ESTIMATE, **options):
    """Return the report's experiment, with one flight per seed."""
    task = TaskParams(duration=0, pad=False)
    return flights_of(FLIGHTS, sensors=sensors, source=source, task=task, **options)


def nees_after_five_seconds(sensors):
    batch = circle_batch(sensors)
    for _ in range(1000):
        batch.step()
    assert (batch.record("filter_status") == 0).all()
    return nees(batch)


@pytest.mark.parametrize("sensors", [LAB.replace(camera=None), PREDICTED], ids=["blind", "camera"])
def test_mean_nees_after_five_seconds_is_about_15(sensors):
    """NEES is 15 for a perfect filter; holding IMU samples over a tick increases it slightly."""
    assert 13.0 < nees_after_five_seconds(sensors).mean() < 18.0


def test_sensor_noise_changes_only_flights_on_the_estimate():
    paths = {}
    for source in (Source.TRUTH, Source.ESTIMATE):
        for factor in (1.0, 10.0):
            batch = circle_batch(LAB.scaled_noise(factor), source=source, run_filter=True)
            for _ in range(200):
                batch.step()
            paths[source, factor] = batch
    for name in ("r", "v", "q", "w", "rotor_speeds", "voltages"):
        calm, noisy = (paths[Source.TRUTH, factor].record(name) for factor in (1.0, 10.0))
        np.testing.assert_array_equal(calm, noisy, err_msg=name)
        calm, noisy = (paths[Source.ESTIMATE, factor].record(name) for factor in (1.0, 10.0))
        assert (calm != noisy).any(axis=1).all(), name
    estimates = [paths[Source.TRUTH, factor].record("r_hat") for factor in (1.0, 10.0)]
    assert (estimates[0] != estimates[1]).any(axis=1).all()
