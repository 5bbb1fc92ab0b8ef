"""Steps environments of whatever checkout of quad_gym is on the path; `benchmark_against` asks.

It uses nothing but the public environments, so that it runs with older checkouts. A question is a
line of JSON on standard input, its answer a line of JSON on standard output.
"""

import itertools
import json
import os
import sys
import time
from typing import Any, TextIO

import gymnasium
import numpy as np

import quad_gym


def steps_of(row: dict[str, Any]) -> Any:
    """A function that steps the environment of a row, and how many flights a step flies."""
    count, options = row["envs"], row["options"]
    rng = np.random.default_rng(0)
    draws = np.clip(rng.normal(0.0, 0.05, (16, count, 4)), -1.0, 1.0).astype(np.float32)
    if row["interface"] == "single":
        env: Any = gymnasium.make("QuadGym/Hover-v0", **options)
        actions = itertools.cycle(list(draws[:, 0]))

        def step_single() -> None:
            _, _, terminated, truncated, _ = env.step(next(actions))
            if terminated or truncated:
                env.reset()

        env.reset(seed=0)
        return step_single
    actions = itertools.cycle(list(draws))
    threads = row["threads"]
    if row["interface"] == "sb3":
        env = quad_gym.make_sb3_vec_env(
            "QuadGym/Hover-v0", n_envs=count, seed=0, threads=threads, **options
        )
        env.reset()
    else:
        env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=count, threads=threads, **options)
        env.reset(seed=0)
    return lambda: env.step(next(actions))


def lasting(step: Any, calls: int) -> float:
    """Seconds that one of some calls takes."""
    began = time.perf_counter()
    for _ in range(calls):
        step()
    return (time.perf_counter() - began) / calls


def serve(answers: TextIO) -> None:
    """Answer questions until there are none: "suite", "make", "calls" or "time"."""
    step: Any = None
    for line in sys.stdin:
        question = json.loads(line)
        try:
            if "suite" in question:
                quad_gym.sensor_suite(question["suite"])
                answer: Any = quad_gym.__file__
            elif "make" in question:
                step = None  # the memory of the last one is free before the next one takes some
                step = steps_of(question["make"])
                lasting(step, 5)
                answer = lasting(step, 5)
            else:
                answer = lasting(step, question["calls"])
            found = {"answer": answer}
        except Exception as error:  # another checkout may lack what is asked for
            found = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(found), file=answers, flush=True)


if __name__ == "__main__":
    channel = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what anything else prints is no answer
    serve(channel)
