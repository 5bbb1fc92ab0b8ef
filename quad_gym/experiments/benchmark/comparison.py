"""Other simulators, as far as they are installed, and other filters on the same measurements."""

import importlib
import itertools
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np

import quad_gym
from quad_gym.experiments.benchmark import timing
from quad_gym.experiments.benchmark.filter import record_one
from quad_gym.experiments.benchmark.interfaces import time_batch, time_env, time_single
from quad_gym.experiments.benchmark.peers import Estimate, peers
from quad_gym.experiments.benchmark.stages import hovering

Make = Callable[[int], Any]
SIMULATORS: dict[str, tuple[str, Make]] = {
    "PyFlyt": ("PyFlyt.gym_envs", lambda _: gymnasium.make("PyFlyt/QuadX-Hover")),
    "gym-pybullet-drones": ("gym_pybullet_drones", lambda _: gymnasium.make("hover-aviary-v0")),
    "crazyflow": (
        "crazyflow",
        lambda envs: gymnasium.make_vec("DroneReachPos-v0", num_envs=envs, freq=50),
    ),
}
"""Module that registers an environment, and the function that makes it, or many of them."""


def _time_simulators(scope: timing.Scope) -> list[timing.Row]:
    """Time steps of this package at 50 Hz and of the others with their own rates."""
    rows = list[timing.Row]()
    for observation in ("estimate", "truth"):
        own: dict[str, Any] = {"observation": observation, "control_rate": 50}
        rows.append(time_single(scope.effort, **own))
        rows.append(time_batch("vector", scope.envs, scope.effort, 1, **own))
    for name, (module, make) in SIMULATORS.items():
        try:
            importlib.import_module(module)
        except ImportError as error:
            print(f"  {name} is not measured: {error}", file=sys.stderr)
            continue
        env = make(scope.envs)
        envs = getattr(env, "num_envs", 1)
        rest = np.zeros(env.action_space.shape, env.action_space.dtype)
        if envs == 1:
            timed, _ = time_env(env, itertools.repeat(rest), scope.effort)
        else:
            env.reset(seed=0)
            timed = timing.measure(partial(env.step, rest), scope.effort)
            env.close()
        rows.append(timing.report(name, timed.per(envs), envs=envs))
    return [row | {"position": None, "attitude": None} for row in rows]


def _error(found: list[Estimate], truth: list[Estimate]) -> dict[str, float]:
    """Root mean square errors of the second half: position [m], attitude [rad]."""
    half = len(found) // 2
    r_hat, R_hat = (np.array([each[k] for each in found[half:]]) for k in range(2))
    r, R = (np.array([each[k] for each in truth[half:]]) for k in range(2))
    cosine = (np.einsum("nij,nij->n", R_hat, R) - 1.0) / 2.0
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    position = np.linalg.norm(r_hat - r, axis=1)
    return {
        "position": float(np.sqrt(np.mean(position**2))),
        "attitude": float(np.sqrt(np.mean(angle**2))),
    }


def _time_filters(scope: timing.Scope) -> list[timing.Row]:
    """Time cycles of filters on the measurements of one flight, and compare them with its truth."""
    sensors, rows = quad_gym.sensor_suite("lab"), list[timing.Row]()
    flight = record_one(hovering(8, sensors=sensors), 0, 20 if scope.quick else 200)
    fewest = min(len(now.pixels) for now in flight)
    flight = [now._replace(pixels=now.pixels[:fewest]) for now in flight]
    for name, run in peers(sensors, flight).items():
        found = run()
        timed = timing.measure(run, scope.effort).per(len(flight))
        errors = _error(found, [now.truth for now in flight])
        rows.append(timing.report(f"filter cycle, {name}", timed, envs=1, **errors))
    return rows


def time_peers(scope: timing.Scope) -> list[timing.Row]:
    """Time other simulators and other filters."""
    return _time_simulators(scope) + _time_filters(scope)


SECTION = timing.Section(
    time_peers,
    {
        "Simulators, a thread each, and filters on the same measurements": {
            "steps or cycles": timing.NAME,
            "envs": timing.column("envs", ","),
            "per second": timing.per_second,
            "spread": timing.SPREAD,
            "position error, mm": timing.column("position", ".1f", 1e3),
            "attitude error, deg": timing.column("attitude", ".3f", 180.0 / np.pi),
        }
    },
)
