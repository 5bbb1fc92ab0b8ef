"""The checkers of Gymnasium and Stable-Baselines3 pass, with warnings as errors."""

import warnings

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check

pytest.importorskip("stable_baselines3", reason='this needs "quad-gym[train]"')
from stable_baselines3.common.env_checker import check_env as sb3_check

import quad_gym
from quad_gym import sensor_suite
from quad_gym.commands.options import sensors_of
from tests.contract.comparing import ACTIONS, IDS, LAYOUTS, OBSERVATIONS
from tests.contract.configurations import CONFIGURATIONS

COVERING = [
    (IDS[k % 8], OBSERVATIONS[k % 4], ACTIONS[k % 5], LAYOUTS[k // 4 % 2]) for k in range(20)
]
"""Every observation with every action, and every task."""


@pytest.fixture(autouse=True)
def _no_display(monkeypatch):
    """Use a dummy display: Gymnasium's checker uses all render modes, including a window."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def passes_both_checkers(env_id, **keywords):
    if keywords.get("observation") == "measurements":
        keywords.pop("layout", None)  # raw measurements have a fixed layout
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(env_id, **keywords)
        gymnasium_check(env.unwrapped)
        sb3_check(gymnasium.make(env_id, **keywords).unwrapped)


@pytest.mark.parametrize(("env_id", "observation", "action", "layout"), COVERING)
def test_both_checkers_pass(env_id, observation, action, layout):
    passes_both_checkers(env_id, observation=observation, action=action, layout=layout)


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_both_checkers_pass_in_every_configuration(name):
    base, keywords = CONFIGURATIONS[name]
    # innovations without a measurement are NaN, which Gymnasium's checker finds unequal
    keywords = {key: value for key, value in keywords.items() if key != "innovations"}
    ids = {task: env_id for env_id, task in quad_gym.IDS.items()}
    passes_both_checkers(ids[base], **keywords)


@pytest.mark.parametrize("env_id", IDS)
def test_both_checkers_pass_at_other_rates(env_id):
    suite = sensor_suite(sensors_of(env_id, None))
    gnss = None if suite.gnss is None else 10.0
    camera = None if suite.camera is None else 20.0
    slow = suite.with_rates(gnss=gnss, camera=camera)
    passes_both_checkers(env_id, control_rate=100, sensors=slow)
    passes_both_checkers(env_id, sensors=suite.with_rates(imu=400.0), control_rate=40, substeps=2)


@pytest.mark.parametrize("env_id", IDS)
def test_wrapped_environment_passes_the_passive_checker(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(env_id)
        env.reset(seed=3)
        for _ in range(20):
            env.step(env.action_space.sample())
        env.close()
