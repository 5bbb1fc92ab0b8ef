"""Gymnasium's wrappers work around the environments wherever they work around Gymnasium's own."""

import importlib

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers

MODES = ("vector_entry_point", "sync")
ARGUMENTS = {
    "ArrayConversion": lambda env: {"env_xp": compat("numpy"), "target_xp": compat("torch")},
    "ClipReward": lambda env: {"max_reward": 0.5},
    "DelayObservation": lambda env: {"delay": 2},
    "DiscretizeAction": lambda env: {"bins": 3},
    "DiscretizeObservation": lambda env: {"bins": 3},
    "DtypeObservation": lambda env: {"dtype": np.float32},
    "FrameStackObservation": lambda env: {"stack_size": 3},
    "RepeatAction": lambda env: {"num_repeats": 2},
    "RescaleAction": lambda env: {"min_action": -2.0, "max_action": 2.0},
    "RescaleObservation": lambda env: {"min_obs": -2.0, "max_obs": 2.0},
    "ReshapeObservation": lambda env: {"shape": (1, *single(env).shape)},
    "StickyAction": lambda env: {"repeat_action_probability": 0.5},
    "TimeLimit": lambda env: {"max_episode_steps": 3},
    "TransformAction": lambda env: {"func": lambda a: a, **same("action_space", env)},
    "TransformObservation": lambda env: {"func": lambda o: o, **same("observation_space", env)},
    "TransformReward": lambda env: {"func": lambda reward: 2.0 * reward},
    "VectorizeTransformAction": lambda env: {"wrapper": wrappers.ClipAction},
    "VectorizeTransformObservation": lambda env: {"wrapper": wrappers.FlattenObservation},
    "VectorizeTransformReward": lambda env: {"wrapper": wrappers.ClipReward, "max_reward": 0.5},
}
"""Arguments of wrappers that have no default."""
PICTURES = {"AddRenderObservation", "HumanRendering", "RenderCollection"}
OTHERS = {
    "AtariPreprocessing",
    "AddWhiteNoise",
    "FilterObservation",
    "GrayscaleObservation",
    "ObstructView",
    "ResizeObservation",
    "RecordVideo",
    "vector",
}
"""Wrappers of pictures and of dictionaries as observations, and the module of the others.
`test_render_modes.py` records videos."""


def compat(library):
    """Return the array interface of a library."""
    pytest.importorskip("array_api_compat")
    pytest.importorskip(library)
    return importlib.import_module(f"array_api_compat.{library}")


def single(env):
    return getattr(env, "single_observation_space", env.observation_space)


def same(name, env):
    """Return an argument with a space of the environment; vector wrappers keep theirs."""
    return {} if isinstance(env, gymnasium.vector.VectorEnv) else {name: getattr(env, name)}


def flown(env, wrapper, name):
    """Wrap and fly an environment through the end of an episode."""
    env = wrapper(env, **ARGUMENTS.get(name, lambda _: {})(env))
    action = env.action_space.sample()
    if "Jax" in name:
        action = pytest.importorskip("jax.numpy").asarray(action)
    if name in ("ArrayConversion", "NumpyToTorch"):
        action = pytest.importorskip("torch").as_tensor(action)
    env.reset(seed=1)
    for _ in range(8):
        *_, terminated, truncated, _ = env.step(action)
        if not isinstance(env, gymnasium.vector.VectorEnv) and (terminated or truncated):
            env.reset()
    env.close()


def works(make, env_id, wrapper, name):
    """Return an error of a wrapper; None: it works."""
    look = {"render_mode": "rgb_array"} if name in PICTURES else {}
    try:
        flown(make(env_id, max_episode_steps=5, **look), wrapper, name)
    except Exception as error:  # of whatever kind
        return error
    return None


def check(make, name, module, monkeypatch):
    """Fly each wrapper around Gymnasium's environments, and, if it works there, around ours."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    try:
        wrapper = getattr(module, name)
    except (ImportError, gymnasium.error.DependencyNotInstalled) as error:
        pytest.skip(f"{name} needs {error}")
    theirs = [works(make, env_id, wrapper, name) for env_id in ("CartPole-v1", "Pendulum-v1")]
    missing = [e for e in theirs if isinstance(e, gymnasium.error.DependencyNotInstalled)]
    if missing:
        pytest.skip(f"{name} needs {missing[0]}")
    assert None in theirs, theirs  # its arguments are right
    error = works(make, "QuadGym/Circle-v0", wrapper, name)
    if error is not None:
        raise error


@pytest.mark.parametrize("name", sorted(set(wrappers.__all__) - OTHERS))
def test_wrapper_that_works_for_gymnasium_works_for_one_environment(name, monkeypatch):
    check(gymnasium.make, name, wrappers, monkeypatch)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", sorted(set(wrappers.vector.__all__) - OTHERS))
def test_wrapper_that_works_for_gymnasium_works_for_many(name, mode, monkeypatch):
    def make(env_id, **keywords):
        ours = "QuadGym" in env_id
        return gymnasium.make_vec(
            env_id, 2, vectorization_mode=mode if ours else "sync", **keywords
        )

    check(make, name, wrappers.vector, monkeypatch)
