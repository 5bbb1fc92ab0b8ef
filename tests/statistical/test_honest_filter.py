"""With its mends the filter's covariance is honest, for UKF and EKF alike.

The mean over 1,000 flights of random trajectories, on the estimate. Errors of the biases last for
seconds, so that one draw of flights is all high or all low for long: the seeds are fixed.
"""

import numpy as np
import pytest

import quad_gym
from quad_gym.consistency import PARTS, NeesRecorder, start_matched
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.simulation import FlightBatch

LAB = quad_gym.sensor_suite("lab").replace(camera=None)
MENDED = LAB.replace(
    imu=LAB.imu.replace(samples="average"),
    estimator=LAB.estimator.replace(integration="midpoint", covariance_reset="turn"),
)


def nees_of(sensors, seconds=10, flights=1000, matched=True):
    task = TASK_DEFAULTS["random_trajectory"].replace(duration=0.0, out_of_bounds=1e9)
    batch, recorder = (
        FlightBatch(flights, sensors=sensors, task=task, gains="tuned"),
        NeesRecorder(),
    )
    batch.reset(seeds=range(flights))
    if matched:
        start_matched(batch, seed=0)
    for tick in range(1, 200 * seconds + 1):
        batch.step()
        if tick % 10 == 0:
            recorder.add(batch, tick / 200)
    assert (batch.read("filter_status") == 0).all()
    return recorder.nees()


@pytest.mark.slow
@pytest.mark.parametrize("gnss_rate", [200.0, 10.0])
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_mean_nees_lies_in_its_band_at_nine_tenths_of_the_instants(kind, gnss_rate):
    """With errors at the start as the filter claims them; the laboratory's own are smaller."""
    sensors = MENDED.replace(estimator=MENDED.estimator.replace(kind=kind))
    found = nees_of(sensors.with_rates(gnss=gnss_rate))
    for name in PARTS:
        assert found[name].honest, (name, found[name].share_inside)


@pytest.mark.slow
def test_each_mend_has_its_share():
    """The reset is what matters at 200 Hz; the report's form is overconfident throughout."""
    report, turned = (
        nees_of(LAB.replace(estimator=LAB.estimator.replace(covariance_reset=reset)), 5)["state"]
        for reset in ("none", "turn")
    )
    assert report.since(1.0).share_inside < 0.05
    assert 16.0 < report.since(1.0).overall < 21.0
    assert np.abs(turned.since(1.0).overall - 15.0) < 0.4 * (report.since(1.0).overall - 15.0)
