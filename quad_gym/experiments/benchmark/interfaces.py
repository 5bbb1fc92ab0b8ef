"""Steps per second of all interfaces."""

import itertools
import sys
from collections.abc import Iterator
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import quad_gym
from quad_gym import sensor_suite
from quad_gym.experiments.benchmark import timing

SLOW = sensor_suite("standard").with_rates(gnss=10.0, camera=25.0)
"""Sensors at low rates; 30 Hz does not divide 200 Hz."""


def random_actions(count: int) -> Iterator[NDArray[np.float32]]:
    """Random actions around hover with a standard deviation of 0.05, repeated after sixteen."""
    rng = np.random.default_rng(0)
    draws = np.clip(rng.normal(0.0, 0.05, (16, count, 4)), -1.0, 1.0).astype(np.float32)
    return itertools.cycle(list(draws))


def time_batch(
    interface: str, count: int, effort: timing.Effort, threads: int, **options: Any
) -> timing.Row:
    """Time steps of many flights with the interface "vector" (Gymnasium) or "sb3"."""
    options.update(threads=threads)
    env: Any
    if interface == "sb3":
        env = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", n_envs=count, seed=0, **options)
        batch = env.flights.batch
        env.reset()
    else:
        env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=count, **options)
        batch = env.unwrapped.flights.batch
        env.reset(seed=0)
    actions, steps = random_actions(count), 0
    began = batch.record("episode").sum()

    def step() -> None:
        nonlocal steps
        env.step(next(actions))
        steps += count

    timed = timing.measure(step, effort).per(count)
    resets = float((batch.record("episode").sum() - began) / steps)
    env.close()
    return _row(interface, count, threads, timed, resets, options)


def time_single(effort: timing.Effort, **options: Any) -> timing.Row:
    """Time steps of one flight made by `gymnasium.make`, including its wrappers."""
    env = gymnasium.make("QuadGym/Hover-v0", **options)
    actions = [action[0] for action in itertools.islice(random_actions(1), 16)]
    return _row("single", 1, 1, *time_env(env, itertools.cycle(actions), effort), options)


def time_env(
    env: Any, actions: Iterator[Any], effort: timing.Effort
) -> tuple[timing.Timing, float]:
    """Time steps of a single environment, and count the share of steps that end an episode."""
    steps, resets = 0, 0

    def some_steps() -> None:
        nonlocal steps, resets
        for _ in range(50):
            _, _, terminated, truncated, _ = env.step(next(actions))
            steps += 1
            if terminated or truncated:
                resets += 1
                env.reset()

    env.reset(seed=0)
    timed = timing.measure(some_steps, effort).per(50)
    env.close()
    return timed, resets / steps


def _row(
    interface: str,
    count: int,
    threads: int,
    timed: timing.Timing,
    resets: float,
    options: dict[str, Any],
) -> timing.Row:
    """Row of an interface of this package."""
    observation, rate = options.get("observation", "estimate"), options.get("control_rate", 50)
    suite = options.get("sensors", "standard")
    suite = "standard, GNSS 10 Hz, camera 25 Hz" if suite is SLOW else suite
    return timing.report(
        f"{interface}, {observation}, {rate} Hz, {suite}",
        timed,
        interface=interface,
        envs=count,
        threads=threads,
        reset_share=resets,
        suite=suite,
        options=options | {"sensors": suite},
    )


def time_others(envs: int, effort: timing.Effort) -> list[timing.Row]:
    """Time Gymnasium's pendulum and cart-pole, which have neither sensors nor a filter."""
    alike: dict[str, Any] = {"threads": 1, "suite": None, "options": {}}
    rest = itertools.repeat(np.zeros(1, np.float32))
    timed, resets = time_env(gymnasium.make("Pendulum-v1"), rest, effort)
    what = {"interface": "single", "envs": 1, "reset_share": resets}
    rows = [timing.report("Pendulum-v1", timed, **what, **alike)]
    for env_id, mode, actions in (
        ("Pendulum-v1", "sync", np.zeros((envs, 1), np.float32)),
        ("CartPole-v1", "vector_entry_point", np.zeros(envs, np.int64)),
    ):
        many: Any = gymnasium.make_vec(env_id, envs, vectorization_mode=mode)
        many.reset(seed=0)
        timed = timing.measure(partial(many.step, actions), effort).per(envs)
        what = {"interface": mode, "envs": envs, "reset_share": None}
        rows.append(timing.report(f"{env_id}, {mode}", timed, **what, **alike))
        many.close()
    return rows


def time_interfaces(scope: timing.Scope) -> list[timing.Row]:
    """Time steps of all interfaces with random actions."""
    envs, cores, effort = scope.envs, scope.threads, scope.effort
    rows: list[timing.Row] = []
    for rate in (200, 50):
        for observation in ("estimate", "truth", "noisy", "measurements"):
            what = {"observation": observation, "control_rate": rate}
            for threads in dict.fromkeys((1, cores)):
                rows.append(time_batch("vector", envs, effort, threads, **what))
            try:
                rows.append(time_batch("sb3", envs, effort, cores, **what))
            except ImportError as error:
                print(f"  sb3: {error}", file=sys.stderr)
            rows.append(time_single(effort, **what))
        for sensors in (SLOW, "lab", "rtk"):
            more = {"control_rate": rate, "sensors": sensors}
            rows.append(time_batch("vector", envs, effort, cores, **more))
            rows.append(time_single(effort, **more))
    for count in (1, 8, 64, 256, 1024, 4096):
        rows.append(time_batch("vector", count, effort, cores, control_rate=50))
    return rows + time_others(envs, effort)


SECTION = timing.Section(
    time_interfaces,
    {
        "Random actions around hover": {
            "interface, observation, control, suite": timing.NAME,
            "envs": timing.column("envs", ","),
            "threads": timing.column("threads"),
            "steps/s": timing.per_second,
            "spread": timing.SPREAD,
            "resets": timing.percent("reset_share"),
        }
    },
)
