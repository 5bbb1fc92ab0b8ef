"""A cold start's covariance covers what the start draws, and the filter is told what was given."""

import numpy as np
import pytest

import quad_gym
from quad_gym import LogUniform, Normal, Uniform
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.params.randomization import DrawingTable, Randomization
from tests.field_flights import fly, nees, steps

FLIGHTS = 256
BAND = 5 * np.sqrt(2 * 15 / FLIGHTS)
SUITES = ("standard", "rtk", "consumer", "indoor")
DRAWS = {
    "velocity": {"start_velocity_I": Uniform(-1.0, 1.0)},
    "tilt and yaw": {
        "start_roll": Uniform(-0.1, 0.1),
        "start_pitch": Normal(0.03, 0.05),
        "start_yaw": Uniform(-3.0, 3.0),
    },
    "rates": {"start_body_rates": Uniform(-1.0, 1.0)},
}


def worst(batch):
    """The largest mean NEES at the start and in the second after it, which may be too small."""
    found = [nees(batch).mean()]
    for _ in range(4):
        steps(batch, 0.25)
        found.append(nees(batch).mean())
    return max(found)


@pytest.mark.parametrize("drawn", DRAWS)
@pytest.mark.parametrize("name", SUITES)
def test_a_start_that_is_drawn_leaves_the_filter_consistent(name, drawn):
    suite = quad_gym.sensor_suite(name)
    batch = fly(suite, FLIGHTS, task="circle", start="hover", randomization=DRAWS[drawn])
    assert worst(batch) < 15.0 + BAND
    assert not (batch.record("diverged") > 0.0).any()


@pytest.mark.parametrize("filter_start", ["cold", "warm"])
@pytest.mark.parametrize("task", TASK_DEFAULTS)
def test_filter_of_the_default_suite_is_consistent_on_every_task(task, filter_start):
    suite = quad_gym.QuadEnv("hover").flights.batch.sensors
    batch = fly(suite, FLIGHTS, task=task, filter_start=filter_start)
    steps(batch, 0.5)  # from the ground it is cautious at first
    for _ in range(4):
        steps(batch, 0.5)
        assert abs(nees(batch).mean() - 15.0) < BAND


@pytest.mark.parametrize("name", SUITES)
def test_the_filter_is_told_a_velocity_that_a_reset_gives(name):
    batch = fly(quad_gym.sensor_suite(name), FLIGHTS, task="circle", start="hover")
    batch.reset(seeds=range(FLIGHTS), velocity=(1.0, 0.5, 0.2))
    np.testing.assert_array_equal(batch.record("v_hat"), np.tile((1.0, 0.5, 0.2), (FLIGHTS, 1)))
    assert worst(batch) < 15.0 + BAND


@pytest.mark.parametrize(
    ("distribution", "expected"),
    [
        (Uniform(-1.0, 2.0), 1.0),  # (b^3 - a^3) / (3 (b - a))
        (Normal(0.5, 0.2), 0.29),  # mean^2 + sigma^2
        (LogUniform(0.5, 2.0), (4.0 - 0.25) / (2.0 * np.log(4.0))),
    ],
)
def test_mean_squares_of_distributions(distribution, expected):
    given = Randomization({"start_roll": distribution})
    table = DrawingTable(
        given, quad_gym.VehicleParams(), quad_gym.SensorSuite(), quad_gym.WorldParams()
    )
    assert table.mean_square("start_roll")[0] == pytest.approx(expected, rel=2e-3)
