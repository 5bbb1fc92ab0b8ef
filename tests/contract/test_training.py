"""Trainings are repeatable, stop on a signal, and refuse invalid plans at the start."""

import json
import os
import signal
import subprocess
import time

import gymnasium
import numpy as np
import pytest

import quad_gym

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from baselines.mlp import MlpPolicy, mlp_of  # noqa: E402
from baselines.models import _checked_parameters, algorithm_class, make_model  # noqa: E402
from baselines.plans import Plan  # noqa: E402
from baselines.policies import load_policy  # noqa: E402
from baselines.recipes import ALGORITHMS, Recipe, recipe  # noqa: E402
from baselines.training import train  # noqa: E402
from quad_gym.evaluation import roll_out  # noqa: E402
from tests import console_commands  # noqa: E402

CIRCLE = "QuadGym/Circle-v0"
QUIET = {"quiet": True, "tensorboard": False}


def small_plan(algorithm="ppo", **changes):
    """Return the plan of a training that takes seconds."""
    shipped = recipe(CIRCLE, algorithm)
    if algorithm in ("ppo", "recurrent_ppo"):
        parameters = {"n_steps": 16, "batch_size": 128, "n_epochs": 2}
        small = {"steps": 2560, "n_envs": 16}
    else:
        parameters = {"batch_size": 32, "learning_starts": 200, "buffer_size": 2000}
        parameters["gradient_steps"] = 1
        small = {"steps": 1600, "n_envs": 16}
    small["parameters"] = {**shipped.parameters, **parameters}
    options = {
        "recipe": shipped.replace(**small),
        "environment": {"duration": 1.0},
        "threads": 1,
        "evaluations": 5,
        "episodes": 8,
    }
    return Plan(**{**options, **changes})


def weights(folder, algorithm="ppo"):
    model = algorithm_class(algorithm).load(folder / "last.zip", device="cpu")
    return {k: v.numpy() for k, v in model.policy.state_dict().items()}


def assert_same(first, second):
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a finished training of the small plan, which tests only read."""
    folder = tmp_path_factory.mktemp("trained")
    assert train(small_plan(), folder, **QUIET).finished
    return folder


def test_equal_seeds_give_equal_policies_and_others_do_not(trained, tmp_path):
    for seed in (0, 1):
        train(small_plan(seed=seed), tmp_path / f"{seed}", **QUIET)
    assert_same(weights(trained), weights(tmp_path / "0"))
    other = weights(tmp_path / "1")["action_net.weight"]
    assert not np.array_equal(weights(trained)["action_net.weight"], other)


def test_keywords_of_the_environment_hold_in_training_too():
    plan = small_plan()
    assert plan.make_flights().unwrapped.flights.batch.task.start == "mixed"  # from the recipe
    given = {"start": "ground", "randomize_reference": False, "sensors": "rtk"}
    batch = small_plan(environment=given).make_flights().unwrapped.flights.batch
    assert (batch.task.start, batch.task.randomize_reference) == ("ground", False)
    assert batch.sensors == quad_gym.sensor_suite("rtk")


def test_td3_explores_with_action_noise():
    """TD3's policy is deterministic, so exploration needs action noise."""
    plan = small_plan("td3")
    model = make_model(plan, plan.make_flights())
    model.learn(800)
    noise = model.action_noise
    drawn = np.concatenate([noise() for _ in range(200)])
    assert 0.09 < drawn.std() < 0.11


@pytest.mark.slow  # a process
def test_interrupted_command_keeps_its_last_policy_and_begins_again(tmp_path):
    folder = tmp_path / "run"
    few = ["--no-progress", "--no-tensorboard", "--threads", "1", "--episodes", "4"]
    few += ["--env", "duration=1.0", "--n-envs", "16", "--set", "n_steps=16", "batch_size=128"]
    line = console_commands.line("train", CIRCLE, "--output", folder, *few, "--steps", 500_000)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(line, cwd=tmp_path, text=True, **pipes)
    end = time.monotonic() + 600.0
    while not (folder / "evaluations.csv").exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "The same command begins again" in err
    assert not json.loads((folder / "training.json").read_text())["finished"]
    assert algorithm_class("ppo").load(folder / "last.zip", device="cpu").num_timesteps == 0
    more = ["--output", folder, *few, "--steps", 400, "--evaluations", 2]
    again = console_commands.run("train", CIRCLE, *more, where=tmp_path)
    assert again.returncode == 2  # a different number of steps is a different plan
    assert "different: recipe" in again.stderr


def test_a_folder_with_a_run_is_not_overwritten(trained):
    with pytest.raises(ValueError, match="already contains a run"):
        train(small_plan(), trained, **QUIET)
    with pytest.raises(ValueError, match=r"another plan \(different: seed, first_flights\)"):
        train(small_plan(seed=3), trained, **QUIET)
    record = json.loads((trained / "training.json").read_text())
    assert record["finished"]
    assert record["plan"]["recipe"]["flights"] == {"start": "mixed", "randomize_reference": True}
    assert os.path.getsize(trained / "evaluations.csv") > 0


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "td3", "tqc"])
def test_plain_weights_act_as_the_model_does(tmp_path, algorithm):
    plan = small_plan(algorithm)
    model = make_model(plan, plan.make_flights())
    policy = mlp_of(model, {"interface": {}})
    policy.save(tmp_path / "p.npz")
    loaded = MlpPolicy.load(tmp_path / "p.npz")
    observations = np.random.default_rng(0).normal(size=(50, 28)).astype(np.float32)
    want, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(loaded.predict(observations)[0], want, atol=2e-6)


def test_policies_that_do_not_fit_are_refused(trained, tmp_path):
    def env(**keywords):
        return gymnasium.make_vec(CIRCLE, num_envs=2, **keywords)

    best = str(trained / "best.zip")
    assert load_policy(best, env()) is not None
    with pytest.raises(ValueError, match="trained with action ctbr"):
        load_policy(best, env(action="motor"))
    with pytest.raises(ValueError, match="trained with observation"):
        load_policy(best, env(layout="absolute"))
    with pytest.raises(ValueError, match="there is no policy"):
        load_policy(str(tmp_path / "none.zip"), env())
    (tmp_path / "broken.zip").write_bytes(b"PK nonsense")
    with pytest.raises(ValueError, match="is not a policy of Stable-Baselines3"):
        load_policy(str(tmp_path / "broken.zip"), env())
    (tmp_path / "broken.npz").write_bytes(b"PK nonsense")
    with pytest.raises(ValueError, match="is not a policy"):
        load_policy(str(tmp_path / "broken.npz"), env())
    with pytest.raises(ValueError, match="policy must be"):
        load_policy("ppo", env())


def test_every_task_and_algorithm_has_a_valid_recipe():
    for env_id in quad_gym.IDS:
        for algorithm in ALGORITHMS:
            chosen = recipe(env_id, algorithm)
            assert chosen.algorithm == algorithm
            assert _checked_parameters(chosen) == dict(chosen.parameters)
    with pytest.raises(ValueError, match="learning_rate"):
        Recipe(learning_rate=(1e-3, 0.0))
    with pytest.raises(ValueError, match="algorithm must be one of"):
        recipe(CIRCLE, "dqn")


@pytest.mark.parametrize("algorithm", [pytest.param("td3", marks=pytest.mark.slow), "tqc"])
def test_td3_and_tqc_write_best_policy(tmp_path, algorithm):
    assert train(small_plan(algorithm), tmp_path, **QUIET).best_policy.exists()


def test_recurrent_policy_resets_memory_at_start_of_episode(tmp_path):
    plan = small_plan("recurrent_ppo")
    done = train(plan, tmp_path, **QUIET)
    many, one = (gymnasium.make_vec(CIRCLE, num_envs=n, duration=1.0) for n in (4, 1))
    policy = load_policy(str(done.best_policy), many)
    together, again = (roll_out(policy, many, seed=7) for _ in range(2))
    np.testing.assert_array_equal(together.returns, again.returns)
    alone = [roll_out(policy, one, seed=7 + i).returns[0] for i in range(4)]
    np.testing.assert_allclose(together.returns, alone, rtol=1e-4)
    env = gymnasium.make_vec(CIRCLE, num_envs=1, duration=1.0)
    observation, _ = env.reset(seed=7)
    total, state, over = 0.0, None, False
    while not over:  # the memory is the state that is passed on
        starts = np.array([state is None])
        actions, state = policy.predict(observation, state, starts, deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(actions)
        total, over = total + reward[0], bool(terminated[0] or truncated[0])
    assert total == pytest.approx(alone[0], rel=1e-4)
    forgetful = policy.predict(observation, None, np.array([True]), deterministic=True)[0]
    remembering = policy.predict(observation, state, np.array([False]), deterministic=True)[0]
    assert abs(forgetful - remembering).max() > 1e-6
