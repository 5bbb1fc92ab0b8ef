"""The environments' part of the benchmark: steps a second of all interfaces."""

import itertools
import sys
from typing import Any

import gymnasium
import numpy as np

import quad_gym
from quad_gym import sensor_suite
from quad_gym.analysis.reports import text_table
from quad_gym.commands.benchmark.timing import Effort, Row, Timing, measure, percent, report


def random_actions(count: int) -> Any:
    """Actions around hover, the same sixteen for ever."""
    rng = np.random.default_rng(0)
    draws = np.clip(rng.normal(0.0, 0.05, (16, count, 4)), -1.0, 1.0).astype(np.float32)
    return itertools.cycle(list(draws))


def time_batch(interface: str, count: int, effort: Effort, threads: int, **options: Any) -> Row:
    """Steps of many flights, by Gymnasium's interface or Stable-Baselines3's."""
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

    timing = measure(step, effort).per(count)
    resets = float((batch.record("episode").sum() - began) / steps)
    env.close()
    return interface_row(interface, count, threads, timing, resets, options)


def time_single(effort: Effort, **options: Any) -> Row:
    """Steps of one flight behind `gymnasium.make`, wrappers included."""
    env = gymnasium.make("QuadGym/Hover-v0", **options)
    env.reset(seed=0)
    timing, resets = time_plain_env(
        env, [a[0] for a in itertools.islice(random_actions(1), 16)], effort
    )
    return interface_row("single", 1, 1, timing, resets, options)


SLOW = sensor_suite("standard").with_rates(gnss=10.0, camera=25.0)
"""Sensors at low rates; 30 Hz does not divide 200 Hz."""


def time_plain_env(env: Any, actions: list[Any], effort: Effort) -> tuple[Timing, float]:
    """Steps of a single environment, and the share of steps that end an episode."""
    cycle, steps, resets = itertools.cycle(actions), 0, 0

    def step() -> None:
        nonlocal steps, resets
        _, _, terminated, truncated, _ = env.step(next(cycle))
        steps += 1
        if terminated or truncated:
            resets += 1
            env.reset()

    def some_steps() -> None:
        for _ in range(50):
            step()

    timing = measure(some_steps, effort).per(50)
    env.close()
    return timing, resets / steps


def interface_row(
    interface: str, count: int, threads: int, timing: Timing, resets: float, options: dict[str, Any]
) -> Row:
    """A row of the interfaces."""
    named = dict(options)
    named.pop("threads", None)
    observation, rate = named.pop("observation", "estimate"), named.pop("control_rate", 50)
    suite = named.pop("sensors", "standard")
    suite = "standard, GNSS 10 Hz, camera 25 Hz" if suite is SLOW else suite
    extra = "".join(f", {key}={value:g}" for key, value in named.items())
    label = f"{interface}, {observation}, {rate} Hz, {suite}{extra}"
    what = {"interface": interface, "envs": count, "threads": threads, "reset_share": resets}
    return report(label, timing, **what, suite=suite, options=options | {"sensors": suite})


def time_others(envs: int, effort: Effort) -> list[Row]:
    """Gymnasium's own pendulum and cart-pole, for scale: neither has sensors nor a filter."""
    env = gymnasium.make("Pendulum-v1")
    env.reset(seed=0)
    timing, resets = time_plain_env(env, [np.zeros(1, np.float32)], effort)
    what = {
        "interface": "single",
        "envs": 1,
        "threads": 1,
        "reset_share": resets,
        "suite": None,
        "options": {},
    }
    rows = [report("Pendulum-v1", timing, **what)]
    for env_id, mode, actions in (
        ("Pendulum-v1", "sync", np.zeros((envs, 1), np.float32)),
        ("CartPole-v1", "vector_entry_point", np.zeros(envs, np.int64)),
    ):
        many: Any = gymnasium.make_vec(env_id, envs, vectorization_mode=mode)
        many.reset(seed=0)

        def step(many: Any = many, actions: Any = actions) -> None:
            many.step(actions)

        timing = measure(step, effort).per(envs)
        what = {"interface": mode, "envs": envs, "threads": 1, "reset_share": None, "suite": None}
        what["options"] = {}
        rows.append(report(f"{env_id}, {mode}", timing, **what))
        many.close()
    return rows


def time_interfaces(envs: int, cores: int, effort: Effort) -> list[Row]:
    """Steps a second of all interfaces; random actions around hover, standard deviation 0.05.

    Args:
        envs: Environments in a batch.
        cores: Most threads.
        effort: How long to measure.
    """
    rows: list[Row] = []
    more = ({"sensors": SLOW}, {"sensors": "lab"}, {"sensors": "rtk"})
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
        for options in more:
            rows.append(time_batch("vector", envs, effort, cores, control_rate=rate, **options))
            rows.append(time_single(effort, control_rate=rate, **options))
    for count in (1, 8, 64, 256, 1024, 4096):
        rows.append(time_batch("vector", count, effort, cores, control_rate=50))
    return rows + time_others(envs, effort)


def interfaces_table(rows: list[Row]) -> str:
    """The interfaces' figures."""
    cells = [
        (
            r["name"],
            f"{r['envs']:,}",
            str(r["threads"]),
            f"{1.0 / r['seconds']:,.0f}",
            percent(r["spread"]),
            "-" if r["reset_share"] is None else percent(r["reset_share"]),
        )
        for r in rows
    ]
    heading = "Random actions around hover"
    columns = [
        "interface, observation, control, suite",
        "envs",
        "threads",
        "steps/s",
        "spread",
        "resets",
    ]
    return text_table({heading: columns}, cells)
