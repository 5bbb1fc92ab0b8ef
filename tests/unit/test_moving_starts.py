"""Starts that move: how their motion is distributed, and what the filter knows of it."""

import gymnasium
import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym import Uniform
from tests.field_flights import fly, nees, steps

FLIGHTS = 20_000
CONSISTENT = 256
BAND = 5 * np.sqrt(2 * 15 / CONSISTENT)


def begun(count=FLIGHTS, start="moving", options=None, env_id="QuadGym/Hover-v0", **keywords):
    """Flights at the start of their first episodes."""
    env = gymnasium.make_vec(env_id, num_envs=count, start=start, **keywords)
    env.reset(seed=0, options=options)
    return env.unwrapped.flights.batch


@pytest.fixture(scope="module")
def moving():
    return begun()


@pytest.fixture(scope="module")
def hovering():
    return begun(start="hover")


def test_position_and_attitude_are_those_of_a_hovering_start(moving, hovering):
    np.testing.assert_array_equal(moving.record("r"), hovering.record("r"))
    np.testing.assert_array_equal(moving.record("rotor_speeds"), hovering.record("rotor_speeds"))
    np.testing.assert_array_equal(moving.record("q"), hovering.record("q"))


def test_motion_is_uniform_within_its_bounds(moving, hovering):
    """Kolmogorov-Smirnov on each axis, on top of the hovering start; alarm level 1e-4 each."""
    on_top = {
        "velocity": (moving.record("v") - hovering.record("v"), 1.5),
        "body rates": (moving.record("w") - hovering.record("w"), 2.0),
    }
    for name, (found, most) in on_top.items():
        assert np.abs(found).max() <= most + 1e-12, name
        for column in found.T:
            assert stats.kstest(column, stats.uniform(-most, 2.0 * most).cdf).pvalue > 1e-4, name


@pytest.mark.parametrize("name", ["standard", "rtk", "consumer", "indoor"])
def test_the_filter_is_consistent_after_a_moving_start(name):
    """Mean NEES at the start and in the second after it may be too small, but not too large."""
    batch = fly(quad_gym.sensor_suite(name), CONSISTENT, task="hover", start="moving")
    found = [nees(batch).mean()]
    for _ in range(4):
        steps(batch, 0.25)
        found.append(nees(batch).mean())
    assert max(found) < 15.0 + BAND
    assert not (batch.record("diverged") > 0.0).any()


@pytest.mark.parametrize(
    ("drawn", "expected"),
    [({}, 1.5**2 / 3.0), ({"start_velocity_I": Uniform(-3.0, 3.0)}, 1.5**2 / 3.0 + 3.0)],
    ids=["alone", "with draws on top"],
)
def test_a_cold_filter_knows_how_much_velocities_vary(drawn, expected):
    suite = quad_gym.SensorSuite()  # the report's: no GNSS velocity tells how fast a start is
    variances = [
        [(L @ L.T).diagonal() for L in begun(4, start, sensors=suite, **given).record("L")]
        for start, given in (("moving", {"randomization": drawn}), ("hover", {}))
    ]
    added = np.subtract(*variances)
    np.testing.assert_allclose(added[:, 3:6], expected, rtol=1e-6)
    np.testing.assert_allclose(added[:, [0, 1, 2, *range(6, 15)]], 0.0, atol=1e-12)


def test_draws_come_on_top_of_the_motion(moving):
    drawn = begun(randomization={"start_body_rates": Uniform(2.0, 3.0)})
    on_top = drawn.record("w") - moving.record("w")
    assert (on_top.min() >= 2.0 - 1e-12) & (on_top.max() <= 3.0 + 1e-12)


def test_velocity_of_a_reset_replaces_that_of_the_start(moving):
    batch = begun(16, options={"velocity": (0.5, 0.0, 0.0)})
    np.testing.assert_array_equal(batch.record("v"), np.tile((0.5, 0.0, 0.0), (16, 1)))
    np.testing.assert_array_equal(batch.record("v_hat"), batch.record("v"))
    np.testing.assert_array_equal(batch.record("w"), moving.record("w")[:16])


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


def test_warm_filter_is_as_close_to_a_moving_start():
    errors = [
        np.abs(batch.record("v_hat") - batch.record("v")).mean()
        for batch in (begun(2000, start, filter_start="warm") for start in ("moving", "hover"))
    ]
    assert errors[0] == pytest.approx(errors[1], rel=0.1)
