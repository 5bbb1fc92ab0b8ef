"""An episode depends only on its seed, not on earlier episodes of the environment."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import Uniform, WorldParams
from quad_gym.faults.presets import PRESETS
from quad_gym.params.suites import SUITES
from quad_gym.records import FLIGHT
from tests.contract.comparing import assert_same
from tests.golden.flights import AIDED

IDS = [spec.id for spec in gymnasium.registry.values() if spec.id.startswith("QuadGym/")]
FLIGHTS, STEPS = 2, 5
DRAWN = {
    "mass": Uniform(0.8, 1.2, relative=True),
    "center_of_mass_B": Uniform(-0.01, 0.01),
    "rotor_efficiency": Uniform(0.8, 1.0),
    "wind_speed": Uniform(0.0, 4.0),
    "gyro_bias_sigma": Uniform(1e-4, 2e-3),
    "pixel_sigma": Uniform(0.8, 1.5, relative=True),
    "features_yaw": Uniform(-3.0, 3.0),
    "start_velocity_I": Uniform(-1.0, 1.0),
    "action_delay": Uniform(0.0, 1.5),
}
STALE = frozenset(
    (
        *("pixels", "aid_measurement", "stamps", "waiting", "waiting_valid"),
        *("fault_size", "fault_vector", "fault_pick", "feature_hidden", "delayed_action"),
        *("gyro_sum", "accel_sum", "fault_news"),
    )
)
"""Fields that are always written before they are read; earlier values have no effect."""


def world_parts(rng):
    """Return parts of a world, with random numbers."""
    wall = quad_gym.Wall(center_I=(6.0, 0.0, 1.0), shift_I=(0.5, 0.5, 0.0))
    return {
        "wind_I": tuple(rng.uniform(-5.0, 5.0, 3)),
        "gust_wind_speed": rng.uniform(1.0, 8.0),
        "linear_drag_B": tuple(rng.uniform(0.0, 0.5, 3)),
        "ground_effect": True,
        "battery": quad_gym.BatteryParams(charge=rng.uniform(0.6, 1.0)),
        "ground": quad_gym.GroundParams(),
        "obstacles": (wall,),
        "geofence": ((-9.0, -9.0, -2.0), (9.0, 9.0, 9.0)),
    }


def other_options(rng):
    """Return values of keywords other than faults, world and randomization."""
    return {
        "sensors": [*SUITES, AIDED],
        "observation": ["truth", "noisy", "measurements"],
        "layout": ["absolute"],
        "include_std": [True],
        "privileged": [True],
        "innovations": [True],
        "estimator": ["ekf"],
        "camera": [False],
        "start": ["ground", "hover", "moving", "mixed"],
        "action": ["motor", "wrench", "attitude", "velocity"],
        "control_rate": [25, 100],
        "action_delay": [1.0, 2.25],
        "substeps": [2],
        "height": [0.3],
        "truncate_when_diverged": [True],
        "max_episode_steps": [int(rng.integers(2, 9))],
        "autoreset_mode": ["SameStep"],
    }


def some(rng, names, most):
    """Choose up to `most` of the names."""
    return rng.choice(sorted(names), rng.integers(0, most + 1), replace=False).tolist()


def drawn_options(rng):
    """Draw keywords, some with effects that an episode could pass on to the next one."""
    keywords = {"sensors": "rtk"}
    for name in some(rng, other_options(rng), 3):
        values = other_options(rng)[name]
        keywords[name] = values[rng.integers(len(values))]
    faults = [fault for name in some(rng, PRESETS, 2) for fault in PRESETS[name]]
    if faults:  # faults with a start time begin at once or soon
        soon = rng.choice([0.0, 0.02, 0.1])
        keywords["faults"] = [f if f.start is None else f.replace(start=soon) for f in faults]
    parts = world_parts(rng)
    if world := {name: parts[name] for name in some(rng, parts, 2)}:
        keywords["world"] = WorldParams(**world)
    if drawn := {name: DRAWN[name] for name in some(rng, DRAWN, 2)}:
        keywords["randomization"] = drawn
    return keywords


def made(name, keywords):
    return gymnasium.make_vec(name, num_envs=FLIGHTS, threads=1, **keywords)


def flown(env, seed, steps):
    """Return results of an episode, and the records at its start and after some steps."""
    rng, batch = np.random.default_rng(seed), env.unwrapped.flights.batch

    def records():
        return {name: batch.record(name) for name in FLIGHT.names if name not in STALE}

    seen = [env.reset(seed=seed), records()]
    seen += [env.step(rng.uniform(-0.6, 0.6, (FLIGHTS, 4))) for _ in range(steps)]
    return [*seen, records()]


@pytest.mark.parametrize(
    "configurations", [range(100), pytest.param(range(100, 5000), marks=pytest.mark.slow)], ids=len
)
def test_episode_of_used_environment_equals_episode_of_fresh_one(configurations):
    refused = 0
    for k in configurations:
        rng = np.random.default_rng([2026, k])
        name, keywords = IDS[rng.integers(len(IDS))], drawn_options(rng)
        try:
            used, fresh = made(name, keywords), made(name, keywords)
        except ValueError:  # options that cannot be combined
            refused += 1
            continue
        flown(used, k, int(rng.integers(3, 20)))
        again, first = (flown(env, 10_000 + k, STEPS) for env in (used, fresh))
        assert_same(again, first, f"{name}, {keywords}")
    assert refused < 0.4 * len(configurations)
