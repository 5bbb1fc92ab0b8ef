"""The filter of the environments' defaults is consistent on every task, cold and warm."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.envs.configuration import TASK_DEFAULTS
from tests.field_flights import fly, nees, steps

FLIGHTS = 256
BAND = 5 * np.sqrt(2 * 15 / FLIGHTS)


@pytest.mark.parametrize("filter_start", ["cold", "warm"])
@pytest.mark.parametrize("task", TASK_DEFAULTS)
def test_the_default_filter_is_consistent(task, filter_start):
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=1)
    suite = env.unwrapped.flights.batch.sensors
    batch = fly(suite, FLIGHTS, task=task, filter_start=filter_start)
    steps(batch, 0.5)  # from the ground it is cautious at first
    means = []
    for _ in range(4):
        steps(batch, 0.5)
        means.append(nees(batch).mean())
    assert np.abs(np.array(means) - 15.0).max() < BAND, means


def test_lab_is_the_report_by_name_and_by_object():
    env = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=1, sensors="lab")
    assert env.unwrapped.flights.batch.sensors == quad_gym.sensor_suite("lab")
    assert quad_gym.sensor_suite("lab") == quad_gym.SensorSuite()
