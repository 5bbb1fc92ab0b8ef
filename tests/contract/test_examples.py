"""Scripts of the documentation, and tuning of PD control from the command line."""

import json
import re

import gymnasium
import pytest

import quad_gym
from baselines.policies import load_policy
from quad_gym.evaluation import roll_out
from tests import console_commands
from tests.examples import example


@pytest.fixture(scope="module")
def script():
    pytest.importorskip("stable_baselines3")
    return example("sb3_defaults")


def evaluations(text):
    """Return errors by step, from the lines that the script prints."""
    found = re.findall(r"^([\d,]+) steps: mean error ([\d.]+) m, [\d.]+% of 4", text, re.MULTILINE)
    return {int(steps.replace(",", "")): error for steps, error in found}


@pytest.mark.parametrize(("algorithm", "steps"), [("sac", 130), ("ppo", 2048)])
def test_sb3_defaults_are_evaluated_while_learning(script, algorithm, steps, tmp_path, capsys):
    file = tmp_path / "policy.zip"
    args = script.Args(algorithm=algorithm, total_timesteps=130, num_envs=1, every=100, evaluate=4)
    args.save = file
    script.main(args)
    found = evaluations(capsys.readouterr().out)
    assert found.keys() >= {100, steps}
    kept = script.CLASSES[algorithm].load(file)
    flown = roll_out(kept, gymnasium.make_vec(args.env_id, num_envs=4), seed=0)
    assert found[steps] == f"{flown.mean_error.mean():.4f}"


def test_options_apply_to_training_and_evaluation(script, monkeypatch):
    made = []

    def keeping(make):
        def make_and_keep(*args, **keywords):
            made.append(make(*args, **keywords))
            return made[-1]

        return make_and_keep

    for module, name in ((quad_gym, "make_sb3_vec_env"), (gymnasium, "make_vec")):
        monkeypatch.setattr(module, name, keeping(getattr(module, name)))
    options = {"start": "moving", "out_of_bounds": 1.5}
    script.main(script.Args(algorithm="sac", total_timesteps=120, evaluate=4, **options))
    assert [type(env).__name__ for env in made] == ["QuadSB3VecEnv", "QuadVectorEnv"]
    for task in (env.unwrapped.flights.task for env in made):
        assert (task.start, task.out_of_bounds) == ("moving", 1.5)


def test_number_of_evaluations_does_not_change_training(script, capsys):
    options = {"algorithm": "sac", "total_timesteps": 160, "evaluate": 4}
    for every in (80, 160):
        script.main(script.Args(**options, every=every))
    often, once = capsys.readouterr().out.split("160 steps:")[1:]
    assert often.splitlines()[0] == once.splitlines()[0]


def tune(*options):
    return console_commands.run("tune", *options)


def test_tune_finds_gains_better_than_initial_gains(tmp_path):
    tiny = ["--candidates", 32, "--episodes", 4, "--held-out-episodes", 8, "--env", "duration=3.0"]
    done = tune("--env-ids", "hover", *tiny, "--output", tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "gains.json").read_text())
    rows = (tmp_path / "search.csv").read_text().splitlines()
    errors = [float(row.split(",")[0]) for row in rows[1:]]
    assert len(errors) == record["candidates"] == 32
    assert errors[0] == 1.0  # the initial gains are flown first
    assert min(errors) < 1.0
    best = rows[1:][errors.index(min(errors))].split(",")
    assert float(best[1]) == pytest.approx(record["gains"]["position"])
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=2)
    policy = load_policy(f"pd:{tmp_path / 'gains.json'}", env)
    assert policy.gains == quad_gym.PDGains(
        **{k: tuple(v) if isinstance(v, list) else v for k, v in record["gains"].items()}
    )


@pytest.mark.parametrize("text", ["no JSON", "{}", '{"gains": {"wings": 2}}'])
def test_file_without_pd_gains_raises_value_error(tmp_path, text):
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=1)
    (tmp_path / "gains.json").write_text(text)
    with pytest.raises(ValueError, match='has no valid table "gains"'):
        load_policy(f"pd:{tmp_path / 'gains.json'}", env)
    with pytest.raises(ValueError, match="there are no gains"):
        load_policy("pd:missing.json", env)
