"""Trainings are repeatable, resume after a kill, and refuse invalid plans at the start."""

import json
import os
import signal
import subprocess
import time
import zipfile

import gymnasium
import numpy as np
import pytest

import quad_gym

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from baselines.keeping import STATE  # noqa: E402
from baselines.mlp import MlpPolicy, mlp_of  # noqa: E402
from baselines.models import _checked_parameters, algorithm_class, make_flights, make_model  # noqa: E402
from baselines.policies import load_policy  # noqa: E402
from baselines.recipes import (  # noqa: E402
    ALGORITHMS,
    Plan,
    Recipe,
    recipe,
)
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
    assert make_flights(plan).unwrapped.flights.batch.task.start == "mixed"  # from the recipe
    given = {"start": "ground", "randomize_reference": False, "sensors": "rtk"}
    batch = make_flights(small_plan(environment=given)).unwrapped.flights.batch
    assert (batch.task.start, batch.task.randomize_reference) == ("ground", False)
    assert batch.sensors == quad_gym.sensor_suite("rtk")


def test_td3_explores_with_action_noise():
    """TD3's policy is deterministic, so exploration needs action noise."""
    plan = small_plan("td3")
    model = make_model(plan, make_flights(plan))
    model.learn(800)
    noise = model.action_noise
    drawn = np.concatenate([noise() for _ in range(200)])
    assert 0.09 < drawn.std() < 0.11


@pytest.mark.parametrize(
    ("algorithm", "steps"),
    [
        ("ppo", 70),
        ("sac", 75),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("ppo", 20), ("td3", 75))),
    ],
)
def test_resumed_run_equals_uninterrupted_run(tmp_path, monkeypatch, algorithm, steps):
    plan = small_plan(algorithm)
    train(plan, tmp_path / "whole", **QUIET)
    from baselines.models import Keeper

    calls = iter(range(10_000))

    def die(self):
        if next(calls) == steps:
            raise RuntimeError("died")
        return True

    with monkeypatch.context() as patch:
        patch.setattr(Keeper, "_on_step", die)
        with pytest.raises(RuntimeError, match="died"):
            train(plan, tmp_path / "cut", **QUIET)
    done = train(plan, tmp_path / "cut", resume=True, **QUIET)
    assert done.finished
    assert_same(weights(tmp_path / "whole", algorithm), weights(tmp_path / "cut", algorithm))


def options(folder, *more):
    few = ["--no-progress", "--no-tensorboard", "--threads", "1", "--episodes", "4"]
    few += ["--env", "duration=1.0", "--n-envs", "16", "--set", "n_steps=16", "batch_size=128"]
    return [CIRCLE, "--output", str(folder), *few, *more]


def script(folder, *more):
    return console_commands.line("train", *options(folder, *more))


def rows(folder):
    file = folder / "evaluations.csv"
    return len(file.read_text().splitlines()) - 1 if file.exists() else 0


def wait_for(condition, process, seconds=1200.0):
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


CALM = [pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGINT, signal.SIGTERM)]


@pytest.mark.parametrize("number", [signal.SIGKILL, *CALM])
def test_a_killed_run_loses_at_most_one_interval(tmp_path, number):
    folder = tmp_path / "run"
    line = script(folder, "--steps", "500000", "--evaluations", "400")
    process = subprocess.Popen(
        line, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: rows(folder) >= 3, process)
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    calm = number != signal.SIGKILL
    assert process.returncode == (130 if calm else -signal.SIGKILL), err
    if calm:
        assert "--resume" in err
    kept = rows(folder)
    model = algorithm_class("ppo").load(folder / "last.zip", device="cpu")
    # the first row is of step 0, and the last may be written shortly before its checkpoint
    assert model.num_timesteps >= (kept - 1) * 1250 - 1250 - 256
    steps = str(int(model.num_timesteps) + 1024)
    finished = train_again(folder, steps, tmp_path)
    assert "goes on" not in finished.stderr
    assert finished.returncode == 2  # a different number of steps is a different plan
    assert "different: recipe" in finished.stderr


def train_again(folder, steps, where):
    more = ("--steps", steps, "--evaluations", "400", "--resume")
    return console_commands.run("train", *options(folder, *more), where=where)


def test_resume_without_run_starts_new_run_with_message(tmp_path):
    few = ("--steps", 400, "--evaluations", 2, "--no-tensorboard", "--resume")
    done = console_commands.run("train", *options(tmp_path / "run", *few), where=tmp_path)
    assert done.returncode == 0
    assert done.stdout.startswith(
        f"There is no run to resume in {tmp_path / 'run'}: starting a new one.\n"
    )
    again = console_commands.run("train", *options(tmp_path / "run", *few), where=tmp_path)
    assert again.returncode == 0
    assert "no run to resume" not in again.stdout


def test_a_folder_with_a_run_is_not_overwritten(trained):
    with pytest.raises(ValueError, match="already contains a run"):
        train(small_plan(), trained, **QUIET)
    with pytest.raises(ValueError, match=r"another plan \(different: seed, first_flights\)"):
        train(small_plan(seed=3), trained, resume=True, **QUIET)
    record = json.loads((trained / "training.json").read_text())
    assert record["finished"]
    assert record["plan"]["recipe"]["flights"] == {"start": "mixed", "randomize_reference": True}
    flown = record["configuration"]  # defaults, too
    assert (flown["name"], flown["task"]["radius"]) == ("circle", 4.0)
    assert (flown["sensors"]["sensors"], flown["vehicle"]["control_rate"]) == ("standard", 50.0)
    assert os.path.getsize(trained / "evaluations.csv") > 0
    with zipfile.ZipFile(trained / "last.zip") as archive:
        kept = archive.read(STATE)  # survives a move of any module or class
    assert b"quad_gym" not in kept
    assert b"baselines" not in kept


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "td3", "tqc"])
def test_plain_weights_act_as_the_model_does(tmp_path, algorithm):
    plan = small_plan(algorithm)
    model = make_model(plan, make_flights(plan))
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
    with pytest.raises(ValueError, match="policy file not found"):
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
