"""The filters of the field suites are consistent, both UKF and EKF.
Means over 1,500 flights of random trajectories, on the estimate, are compared with the band of
1,000 flights. Bias errors last for seconds, so the means of fewer flights may all be high or all
low for long, by chance."""

import numpy as np
import pytest

import quad_gym
from quad_gym.analysis.consistency import endless, flight_errors, measure_consistency
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.records import Source
from tests.builders import batch as flights_of
from tests.consistent import assert_consistent, start_matched


def flown(sensors, *, flights=1500, seconds=10.0, **keywords):
    """Return the consistency of flights on the estimate; check that no filter failed."""
    task = endless(TASK_DEFAULTS["random_trajectory"])
    batch = FlightBatch(
        flights, sensors=sensors, task=task, gains="tuned", innovations=True, **keywords
    )
    findings = measure_consistency(batch, seeds=range(flights), duration=seconds)
    assert findings.failed == 0
    return findings


@pytest.mark.slow
@pytest.mark.parametrize("start", ["cold", "warm"])
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("suite", ["rtk", "consumer", "indoor"])
def test_filter_of_suite_is_consistent_from_first_instant(suite, kind, start):
    """Baselines with a constant heading error are an exception: the filter models it as noise."""
    sensors = quad_gym.sensor_suite(suite)
    sensors = sensors.replace(estimator=sensors.estimator.replace(kind=kind))
    findings = flown(sensors, filter_start=start)
    apart = {"baseline"} if sensors.gnss is not None and sensors.gnss.heading_errs else set()
    assert findings.counted_as_noise == apart
    assert_consistent(findings.nees, findings.nis, findings.whiteness, apart)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_prediction_errors_match_covariance(kind):
    """The covariance of 10,000 runs on the IMU alone agrees within 5 % of its diagonal."""
    runs = 10_000
    sensors = quad_gym.sensor_suite("rtk").simplified()
    sensors = sensors.replace(estimator=sensors.estimator.replace(kind=kind))
    on_truth = {"source": Source.TRUTH, "run_filter": True}  # equal flights and covariances
    task = endless(TASK_DEFAULTS["circle"])
    made = {"sensors": sensors, "gains": "tuned", "task": task, "filter_start": "warm"}
    batch = flights_of(runs, **made, **on_truth)
    start_matched(batch, seed=7)
    batch.switch_sensors(gnss=False, camera=False)
    first = np.sqrt(np.diagonal(batch.covariance()[0]))
    for second in (1, 3, 10):
        while batch.record("tick")[0] < 200 * second:
            batch.step()
        errors, P = flight_errors(batch), batch.covariance().mean(axis=0)
        sample, sigma = errors.T @ errors / runs, np.sqrt(np.diagonal(P))
        np.testing.assert_allclose(np.sqrt(np.diagonal(sample)), sigma, rtol=0.03)
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(sample / scale, P / scale, atol=0.05, rtol=0.0)
    assert (sigma[:3] > 50.0 * first[:3]).all()
    assert not np.isnan(errors).any()
