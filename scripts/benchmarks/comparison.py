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
from quad_gym.commands import benchmark
from quad_gym.commands.benchmark import hovering, time_batch, time_env, time_single
from quad_gym.records import WIDTH
from scripts.benchmarks.filter import record_one
from scripts.benchmarks.peers import Estimate, MeasuredTick, peers
from scripts.benchmarks.scope import Scope

TICKS = 1000  #: ticks of a flight on which filters are compared, in its second half by their errors
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


def _time_simulators(scope: Scope) -> list[benchmark.Row]:
    """Time steps of this package at 50 Hz and of the others with their own rates."""
    rows = list[benchmark.Row]()
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
            timed = benchmark.measure(partial(env.step, rest), scope.effort)
            env.close()
        rows.append(benchmark.report(name, timed.per(envs), envs=envs))
    return [row | {"position": None, "attitude": None} for row in rows]


def _error(found: list[Estimate], flight: list[MeasuredTick]) -> tuple[float, float]:
    """Root mean square errors in the second half of a flight: position [m], attitude [rad]."""
    squares = []
    for estimate, now in list(zip(found, flight, strict=True))[len(flight) // 2 :]:
        r, R = now.truth
        cosine = (np.sum(estimate.R_BI * R) - 1.0) / 2.0
        distance = np.linalg.norm(estimate.position - r)
        squares.append((distance**2, np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2))
    position, attitude = np.sqrt(np.mean(squares, axis=0)).tolist()
    return position, attitude


def _time_filters(scope: Scope) -> list[benchmark.Row]:
    """Time cycles of filters on fixes and baselines, and compare estimates with the truth."""
    sensors, rows = quad_gym.sensor_suite("lab").replace(camera=None), list[benchmark.Row]()
    # the filters start in motion: with the suite's 3 cm/s they would take velocity for tilt
    moving = sensors.estimator.replace(initial_velocity_variance=0.1)
    sensors = sensors.replace(estimator=moving)
    batch = hovering(WIDTH, sensors=sensors)
    ticks, count = (TICKS // 10, 1) if scope.quick else (TICKS, 4)
    flights = [record_one(batch, k, ticks) for k in range(count)]
    runs = [peers(sensors, flight) for flight in flights]
    for name in runs[0]:
        found = [_error(run[name](), flight) for run, flight in zip(runs, flights, strict=True)]
        position, attitude = np.sqrt(np.mean(np.square(found), axis=0)).tolist()
        timed = benchmark.measure(runs[0][name], scope.effort).per(ticks)
        what = {"envs": 1, "position": position, "attitude": attitude}
        rows.append(benchmark.report(f"filter cycle, {name}", timed, **what))
    return rows


def time_peers(scope: Scope) -> list[benchmark.Row]:
    """Time other simulators and other filters."""
    return _time_simulators(scope) + _time_filters(scope)


SECTION = benchmark.Section(
    time_peers,
    {
        "Simulators, a thread each, and filters on the same measurements": {
            "steps or cycles": benchmark.NAME,
            "envs": benchmark.column("envs", ","),
            "per second": benchmark.per_second,
            "spread": benchmark.SPREAD,
            "position error, mm": benchmark.column("position", ".1f", 1e3),
            "attitude error, deg": benchmark.column("attitude", ".3f", 180.0 / np.pi),
        }
    },
)
