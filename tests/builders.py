"""Builders of environments, batches, flights and processes for tests."""

import functools
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np

import quad_gym
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.flights import FlightRecorder

MAKERS = {
    "make": lambda **keywords: gymnasium.make("QuadGym/Circle-v0", **keywords),
    "make_vec": lambda **keywords: gymnasium.make_vec("QuadGym/Circle-v0", num_envs=2, **keywords),
    "make_sb3_vec_env": lambda **keywords: quad_gym.make_sb3_vec_env(
        "QuadGym/Circle-v0", 2, **keywords
    ),
}
"""Every interface, on the circle."""
STEPS = 60
SHORT = {"max_episode_steps": 25, "max_tilt": 0.6}
"""Keywords for episodes that end by time limit and by tipping over, at different steps."""


def single_env(base="hover", seed=None, **keywords):
    """A single environment, reset if a seed is given."""
    made = QuadEnv(base=base, **keywords)
    if seed is not None:
        made.reset(seed=seed)
    return made


def vec_env(base="hover", count=5, seed=None, **keywords):
    """A vector environment, reset if a seed is given."""
    made = QuadVectorEnv(count, base=base, **keywords)
    if seed is not None:
        made.reset(seed=seed)
    return made


def batch(count=5, seed=0, **keywords):
    """A batch of flights after a reset, with consecutive seeds from the given one."""
    made = FlightBatch(count, **keywords)
    made.reset(seeds=range(seed, seed + count))
    return made


def flown(base="circle", count=5, steps=20, seed=1, **keywords):
    """A vector environment after some steps of random actions."""
    made, rng = vec_env(base, count, seed, **keywords), np.random.default_rng(seed)
    for _ in range(steps):
        made.step(rng.uniform(-0.2, 0.3, (count, 4)))
    return made


def flown_batch(seeds, ticks, **keywords):
    """A batch of one thread after some steps, with a flight for each seed."""
    made = FlightBatch(len(seeds), **{"threads": 1, **keywords})
    made.reset(seeds=seeds)
    for _ in range(ticks):
        made.step()
    return made


def recorded_flight(task="circle", steps=12, seed=2, **keywords):
    """Fly random actions; return (environment, recorded flight, observations of each row)."""
    env = QuadEnv(task, **keywords)
    recorder = FlightRecorder(env.flights.batch, about={"seed": seed})
    observations = [env.reset(seed=seed)[0]]
    recorder.keep()
    for action in np.random.default_rng(seed).uniform(-0.3, 0.3, (steps, 4)):
        observations.append(env.step(action)[0])
        recorder.keep()
    return env, recorder.flight, np.array(observations)


def run_python(*words, where=None, **environment):
    """Run Python in a process in a folder; return it when it ended.

    Variables of the environment are set or, with None, removed.
    """
    variables = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])} | environment
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=where,
        env={name: value for name, value in variables.items() if value is not None},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


class Still:
    """A policy whose actions are zero."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 4)), None


def put(flights, **fields):
    """Set fields of all flights of a batch."""
    snapshot = flights.snapshot()
    for name, values in fields.items():
        lanes = np.zeros((len(snapshot) * snapshot[name].shape[-1], *np.shape(values)[1:]))
        lanes[: flights.count] = values
        blocks = lanes.reshape(len(snapshot), -1, *lanes.shape[1:])
        snapshot[name] = np.moveaxis(blocks, 1, -1)
    flights.restore(snapshot)


def part(env, observations, name):
    """One part of observations, by its name in the table."""
    field = next(f for f in env.unwrapped.flights.table if f.name == name)
    return observations[..., field.slice]


@functools.cache
def actions_of(flight, steps=STEPS):
    """Random actions (steps, 4) with an offset, so that flights end at different times."""
    rng = np.random.default_rng([flight, 77])
    lean = rng.uniform(-0.5, 0.5, 4)
    found = np.clip(lean + rng.uniform(-0.6, 0.6, (steps, 4)), -1.0, 1.0).astype(np.float32)
    found.setflags(write=False)
    return found


def actions_for(flights, steps=STEPS):
    """Random actions (steps, n, 4) of some flights."""
    return np.stack([actions_of(flight, steps) for flight in flights], axis=1)


def flat(observation):
    """An observation as one array; the parts of a dictionary are concatenated."""
    if isinstance(observation, dict):
        return np.concatenate(list(observation.values()), axis=-1)
    return observation
