"""Random actions for a long time, over all tasks and actions: every number stays finite.
QUAD_GYM_SOAK_STEPS sets the total number of steps of single flights, by default 10^6; the full soak
makes 10^8."""

import os

import numpy as np
import pytest

import quad_gym
from quad_gym.envs.config import BENCHMARKS
from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.comparing import ACTIONS, OBSERVATIONS
from tests.soak.validity import assert_records_are_finite

STEPS = int(float(os.environ.get("QUAD_GYM_SOAK_STEPS", "1e6")))
COUNT = 1000
COMBINATIONS = [(task, action) for task in quad_gym.IDS.values() for action in ACTIONS]


@pytest.fixture(scope="module")
def total():
    """Yield a list of the steps of all cases, and print the total at the end."""
    steps = []
    yield steps
    print(f"\n{sum(steps):,} steps in all")


@pytest.mark.slow
@pytest.mark.parametrize(("task", "action"), COMBINATIONS)
def test_records_stay_finite_under_random_actions(task, action, total):
    number = COMBINATIONS.index((task, action))
    suite = quad_gym.sensor_suite("standard").with_rates(gnss=(200.0, 10.0)[number % 2])
    rate = {} if task in BENCHMARKS else {"sensors": suite}  # benchmarks have their own
    needs_camera = task in ("look_around", "outage_dash")  # or have none to switch off
    camera = {} if needs_camera else {"camera": number % 3 != 0}
    observation = OBSERVATIONS[number % 4]
    own = observation == "measurements"  # these have their own layout
    layout = {} if own else {"layout": ("relative", "absolute")[number // 4 % 2]}
    env = QuadVectorEnv(
        COUNT,
        task,
        action=action,
        observation=observation,
        include_std=True,
        privileged=True,
        **rate,
        **camera,
        **layout,
        autoreset_mode=("NextStep", "SameStep")[number % 2],
    )
    rng = np.random.default_rng(number)
    observation, _ = env.reset(seed=number)
    failures, flown = 0, 0
    steps = -(-STEPS // (len(COMBINATIONS) * COUNT))
    styles = rng.integers(0, 4, COUNT)
    held = rng.uniform(-1.0, 1.0, (COUNT, 4))
    for k in range(steps):
        noise = rng.uniform(-1.0, 1.0, (COUNT, 4))
        if k % 50 == 0:
            held = noise
        # white, held, extreme, and gentle actions
        actions = np.choose(styles[:, np.newaxis], [noise, held, np.sign(noise), 0.1 * noise])
        observation, reward, *_, info = env.step(actions)
        flown += COUNT
        failures += int((info["filter_status"] > 0).sum())
        assert all(np.isfinite(values).all() for values in (*observation.values(), reward))
        if k % 20 == 0 or k == steps - 1:
            assert_records_are_finite(env.flights.batch)
    total.append(flown)
    print(f"{task}, {action}: {flown:,} steps, {failures:,} of them with a failed filter")
