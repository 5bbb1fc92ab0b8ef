"""With its mends the filter's covariance is honest, for UKF and EKF alike.

The mean over 1,000 flights of random trajectories, on the estimate. Errors of the biases last for
seconds, so that one draw of flights is all high or all low for long: the seeds are fixed.
"""

import numpy as np
import pytest

import quad_gym
from quad_gym.consistency import PARTS, InnovationRecorder, NeesRecorder, start_matched
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.simulation import FlightBatch

LAB = quad_gym.sensor_suite("lab").replace(camera=None)
MENDED = LAB.replace(
    imu=LAB.imu.replace(samples="average"),
    estimator=LAB.estimator.replace(integration="midpoint", covariance_reset="turn"),
)


def record(sensors, seconds=10, flights=1000, matched=False):
    """NEES and innovations of flights on the estimate."""
    task = TASK_DEFAULTS["random_trajectory"].replace(duration=0.0, out_of_bounds=1e9)
    batch = FlightBatch(flights, sensors=sensors, task=task, gains="tuned", innovations=True)
    recorder = NeesRecorder()
    innovations = InnovationRecorder(batch, np.linspace(0.0, seconds, 20 * seconds + 1))
    batch.reset(seeds=range(flights))
    if matched:
        start_matched(batch, seed=0)
    for tick in range(1, 200 * seconds + 1):
        batch.step()
        innovations.add(batch, tick / 200)
        if tick % 10 == 0:
            recorder.add(batch, tick / 200)
    assert (batch.read("filter_status") == 0).all()
    return recorder, innovations


@pytest.mark.slow
@pytest.mark.parametrize("gnss_rate", [200.0, 10.0])
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_mean_nees_lies_in_its_band_at_nine_tenths_of_the_instants(kind, gnss_rate):
    """With errors at the start as the filter claims them; the laboratory's own are smaller."""
    sensors = MENDED.replace(estimator=MENDED.estimator.replace(kind=kind))
    recorder, _ = record(sensors.with_rates(gnss=gnss_rate), matched=True)
    found = recorder.nees()
    for name in PARTS:
        assert found[name].honest, (name, found[name].share_inside)


@pytest.mark.slow
def test_each_mend_has_its_share():
    """The reset is what matters at 200 Hz; the report's form is overconfident throughout."""
    report, turned = (
        record(
            LAB.replace(estimator=LAB.estimator.replace(covariance_reset=reset)), 5, matched=True
        )[0].nees()["state"]
        for reset in ("none", "turn")
    )
    assert report.since(1.0).share_inside < 0.05
    assert 16.0 < report.since(1.0).overall < 21.0
    assert np.abs(turned.since(1.0).overall - 15.0) < 0.4 * (report.since(1.0).overall - 15.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_the_rtk_suite_is_honest_from_its_first_fix_on(kind):
    """NEES of state and blocks and NIS of all sensors in their bands, innovations white."""
    rtk = quad_gym.sensor_suite("rtk")
    rtk = rtk.replace(estimator=rtk.estimator.replace(kind=kind))
    recorder, innovations = record(rtk)
    for name, part in (recorder.nees() | innovations.nis()).items():
        assert part.honest, (name, part.share_inside, part.overall)
    for name, found in innovations.whiteness().items():
        assert found.white, (name, found.largest)
