"""Tests of environments in several processes and threads, and of the cores that they use."""

import functools
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv

from quad_gym.batch import threads
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.kernels import library
from tests.builders import actions_of, run_python, vec_env
from tests.contract.comparing import assert_same
from tests.contract.hovering import SHORT, make_hover, next_steps

PATIENCE = 300
"""Timeout of a process [s]."""
STARTS = ["fork", "spawn"]


def expected_run(n, mode, seed=7, steps=40, batch_threads=1):
    """Return (observations, rewards, over) of every step, flown in this process."""
    env = QuadVectorEnv(n, "hover", autoreset_mode=mode, threads=batch_threads, **SHORT)
    rows = [(env.reset(seed=seed)[0], np.zeros(n), np.zeros(n, bool))]
    for k in range(steps):
        observation, reward, terminated, truncated, _ = env.step(actions_at(n, k, steps))
        rows.append((observation, reward, terminated | truncated))
    return rows


def actions_at(n, k, steps):
    return np.stack([actions_of(i, steps)[k] for i in range(n)])


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("context", STARTS)
def test_gymnasium_async_env_equals_flights_in_one_process(context):
    expected_run(64, "NextStep", steps=2, batch_threads=2)  # this process has flown, with threads
    env = AsyncVectorEnv([make_hover] * 2, context=context)
    try:
        observation, _ = env.reset(seed=7)
        for k, (expected, reward, over) in enumerate(expected_run(2, "NextStep")):
            if k > 0:
                observation, mine, term, trunc, _ = env.step(actions_at(2, k - 1, 40))
                np.testing.assert_array_equal(mine, reward)
                np.testing.assert_array_equal(term | trunc, over)
            np.testing.assert_array_equal(observation, expected)
    finally:
        env.close()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize(
    "start_method",
    ["fork", pytest.param("spawn", marks=pytest.mark.slow)],  # each process imports torch
)
def test_sb3_subproc_env_equals_flights_in_one_process(start_method):
    extra = 'this needs "quad-gym[train]"'
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env", reason=extra)
    env = vec_env.SubprocVecEnv([make_hover] * 2, start_method=start_method)
    try:
        env.seed(7)
        observation = env.reset()
        for k, (expected, reward, over) in enumerate(expected_run(2, "SameStep")):
            if k > 0:
                observation, mine, done, _ = env.step(actions_at(2, k - 1, 40))
                np.testing.assert_array_equal(mine, reward)
                np.testing.assert_array_equal(done, over)
            np.testing.assert_array_equal(observation, expected)
    finally:
        env.close()


def test_environments_may_be_stepped_from_several_threads():
    run = functools.partial(expected_run, 64, "SameStep", batch_threads=2)
    with ThreadPoolExecutor(3) as pool:
        runs = [pool.submit(run, seed=seed) for seed in (1, 2, 3)]
        for seed, flown in zip((1, 2, 3), runs, strict=True):
            assert_same(flown.result(PATIENCE), run(seed=seed))


def test_environment_pickled_in_mid_episode_continues_in_another_process():
    env = vec_env(count=9, seed=3, threads=2)
    env.step(np.zeros((9, 4)))
    code = (
        "import pickle, sys; from tests.contract.hovering import next_steps;"
        "env = pickle.load(sys.stdin.buffer);"
        "sys.stdout.buffer.write(pickle.dumps(next_steps(env)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=pickle.dumps(env),
        capture_output=True,
        check=True,
        timeout=PATIENCE,
    )
    assert_same(pickle.loads(done.stdout), next_steps(env))


def test_cores_are_limited_by_quota_affinity_and_variable(monkeypatch):
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    for quota, expected in ((None, 16), (4, 4), (64, 16)):
        monkeypatch.setattr(library, "_cgroup_cores", lambda quota=quota: quota)
        assert library.available_cores() == expected
    monkeypatch.setattr(library, "_cgroup_cores", lambda: None)
    for limit, expected in (("3", 3), ("999", 16), ("", 16), ("0", 16), ("-2", 16), ("many", 16)):
        monkeypatch.setenv("NUMBA_NUM_THREADS", limit)
        assert library.available_cores() == expected


def test_an_environment_takes_the_available_cores(monkeypatch):
    monkeypatch.setattr(threads, "available_cores", lambda: 3)
    assert QuadVectorEnv(4, "hover").flights.batch.threads == 3
    assert QuadVectorEnv(4, "hover", threads=2).flights.batch.threads == 2


def test_import_of_package_loads_no_heavy_modules():
    code = "import sys, quad_gym; print(*sorted(sys.modules))"
    modules = set(run_python("-c", code).stdout.split())
    heavy = ("numba", "llvmlite", "scipy", "torch", "stable_baselines3", "matplotlib", "pygame")
    assert not modules & {*heavy, "quad_gym.kernels", "quad_gym.kernels.batch"}
    assert "gymnasium" in modules
