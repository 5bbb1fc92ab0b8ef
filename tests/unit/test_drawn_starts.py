"""Moving and drawn starts: their distribution, and the consistency of the filter."""

import itertools

import gymnasium
import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym import LogUniform, Normal, Uniform
from quad_gym.envs.config import TASK_DEFAULTS
from tests.field_flights import fly, nees, steps

FLIGHTS = 20_000


def begun(count=FLIGHTS, start="moving", options=None, env_id="QuadGym/Hover-v0", **keywords):
    """Return flights at the start of their first episodes."""
    env = gymnasium.make_vec(env_id, num_envs=count, start=start, **keywords)
    env.reset(seed=0, options=options)
    return env.unwrapped.flights.batch


@pytest.fixture(scope="module")
def moving():
    return begun()


@pytest.fixture(scope="module")
def hovering():
    return begun(start="hover")


def test_moving_start_has_position_and_attitude_of_hovering_start(moving, hovering):
    np.testing.assert_array_equal(moving.record("r"), hovering.record("r"))
    np.testing.assert_array_equal(moving.record("rotor_speeds"), hovering.record("rotor_speeds"))
    np.testing.assert_array_equal(moving.record("q"), hovering.record("q"))


def test_motion_is_uniform_within_its_bounds(moving, hovering):
    """The motion added to a hovering start passes a Kolmogorov-Smirnov test at 1e-4 per axis."""
    on_top = {
        "velocity": (moving.record("v") - hovering.record("v"), 1.5),
        "body rates": (moving.record("w") - hovering.record("w"), 2.0),
    }
    for name, (found, most) in on_top.items():
        assert np.abs(found).max() <= most + 1e-12, name
        for column in found.T:
            assert stats.kstest(column, stats.uniform(-most, 2.0 * most).cdf).pvalue > 1e-4, name


@pytest.mark.parametrize(
    ("drawn", "added"),
    [
        (None, 0.0),
        (Uniform(-3.0, 3.0), 3.0),  # (b^3 - a^3) / (3 (b - a))
        (Normal(0.5, 0.2), 0.29),  # mean^2 + sigma^2
        (LogUniform(0.5, 2.0), (4.0 - 0.25) / (2.0 * np.log(4.0))),
    ],
)
def test_cold_filter_covariance_includes_variance_of_start_velocity(drawn, added):
    suite = quad_gym.SensorSuite()  # the report's suite has no GNSS velocity
    draws = {} if drawn is None else {"start_velocity_I": drawn}
    variances = [
        [(L @ L.T).diagonal() for L in begun(4, start, sensors=suite, **given).record("L")]
        for start, given in (("moving", {"randomization": draws}), ("hover", {}))
    ]
    found = np.subtract(*variances)
    np.testing.assert_allclose(found[:, 3:6], 1.5**2 / 3.0 + added, rtol=2e-3)
    np.testing.assert_allclose(found[:, [0, 1, 2, *range(6, 15)]], 0.0, atol=1e-12)


def test_drawn_body_rates_add_to_the_moving_start(moving):
    drawn = begun(randomization={"start_body_rates": Uniform(2.0, 3.0)})
    on_top = drawn.record("w") - moving.record("w")
    assert (on_top.min() >= 2.0 - 1e-12) & (on_top.max() <= 3.0 + 1e-12)


@pytest.mark.parametrize("env_id", sorted(quad_gym.IDS))
def test_every_task_can_start_moving(env_id):
    still, moving = (begun(64, start, env_id=env_id) for start in ("hover", "moving"))
    np.testing.assert_array_equal(still.record("r"), moving.record("r"))
    speed = np.linalg.norm(moving.record("v") - still.record("v"), axis=1)
    assert 0.5 < np.median(speed) < np.sqrt(3.0) * 1.5
    assert not moving.record("on_pad").any()


@pytest.mark.parametrize("pad", [True, False])
@pytest.mark.parametrize("start", ["hover", "moving"])
def test_a_pad_for_a_start_in_the_air_is_refused(start, pad):
    with pytest.raises(ValueError, match=f'pad has no effect with start="{start}"'):
        gymnasium.make("QuadGym/Circle-v0", pad=pad, start=start)


CONSISTENT = 256
BAND = 5 * np.sqrt(2 * 15 / CONSISTENT)
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
    """Return the largest mean NEES in the first second; small values are accepted."""
    found = [nees(batch).mean()]
    for _ in range(4):
        steps(batch, 0.25)
        found.append(nees(batch).mean())
    return max(found)


ONE_EACH = list(zip(SUITES, [*DRAWS, "moving"], strict=True))
OTHERS = [pair for pair in itertools.product(SUITES, [*DRAWS, "moving"]) if pair not in ONE_EACH]


@pytest.mark.parametrize(
    ("name", "drawn"), [*ONE_EACH, *(pytest.param(*p, marks=pytest.mark.slow) for p in OTHERS)]
)
def test_filter_is_consistent_after_drawn_or_moving_start(name, drawn):
    suite = quad_gym.sensor_suite(name)
    how = {"start": "moving"} if drawn == "moving" else {"randomization": DRAWS[drawn]}
    batch = fly(suite, CONSISTENT, **{"task": "circle", "start": "hover", **how})
    assert worst(batch) < 15.0 + BAND
    # the heading by motion begins with the filter's tilt, of which few errors leave their model
    assert (batch.record("diverged") > 0.0).mean() <= (0.02 if drawn == "tilt and yaw" else 0.0)


@pytest.mark.parametrize("filter_start", ["cold", "warm"])
@pytest.mark.parametrize("task", TASK_DEFAULTS)
def test_filter_of_the_default_suite_is_consistent_on_every_task(task, filter_start):
    suite = quad_gym.QuadEnv("hover").flights.batch.sensors
    batch = fly(suite, CONSISTENT, task=task, filter_start=filter_start)
    steps(batch, 0.5)  # after a ground start it is conservative at first
    for _ in range(4):
        steps(batch, 0.5)
        assert abs(nees(batch).mean() - 15.0) < BAND


@pytest.mark.parametrize("name", SUITES)
def test_filter_starts_with_the_velocity_given_to_reset(name):
    batch = fly(quad_gym.sensor_suite(name), CONSISTENT, task="circle", start="hover")
    batch.reset(seeds=range(CONSISTENT), velocity=(1.0, 0.5, 0.2))
    np.testing.assert_array_equal(batch.record("v_hat"), np.tile((1.0, 0.5, 0.2), (CONSISTENT, 1)))
    assert worst(batch) < 15.0 + BAND
