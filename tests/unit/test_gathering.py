"""Updates of gathered lanes: the flights of a batch are those of batches of one."""

import numpy as np
import pytest

import quad_gym
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.records import WIDTH, Autoreset
from tests.builders import flown_batch
from tests.golden.flights import AIDED

COUNT = 5 * WIDTH + 3
RTK = quad_gym.sensor_suite("rtk")
SUITES = {
    "GNSS and images, late": RTK,
    "GNSS and images, prompt": RTK.replace(
        gnss=RTK.gnss.replace(latency=0.0), camera=RTK.camera.replace(latency=0.0)
    ),
    "GNSS late, aiding sensors": quad_gym.sensor_suite("consumer"),
    "all sensors, late": AIDED,
    "time stamps ignored": RTK.replace(estimator=RTK.estimator.replace(delay_compensation="none")),
    "images": quad_gym.sensor_suite("indoor"),
}


def flown(suite, seeds, **options):
    task = TASK_DEFAULTS["circle"].replace(duration=1.0)
    same_step = {"task": task, "autoreset": Autoreset.SAME_STEP}
    return flown_batch(seeds, 250, sensors=suite, **same_step, **options)


@pytest.mark.parametrize("name", SUITES)
def test_flights_of_a_batch_equal_flights_alone(name):
    together = flown(SUITES[name], range(COUNT))
    assert together._group > COUNT // WIDTH
    for seed in range(0, COUNT, 4):
        alone = flown(SUITES[name], [seed])
        for field in together.snapshot().dtype.names:
            mine, its = together.record(field)[seed], alone.record(field)[0]
            np.testing.assert_array_equal(mine, its, err_msg=f"{field}, flight {seed}")


def test_equal_phases_or_own_parameters_are_not_gathered():
    assert flown("standard", [0])._group == 1
    drawn = {"mass": quad_gym.Uniform(0.9, 1.1, relative=True)}
    assert flown("rtk", [0], randomization=drawn)._group == 1
