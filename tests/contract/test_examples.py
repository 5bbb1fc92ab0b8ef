"""Scripts of the documentation that need no package beyond those for training."""

import re

import gymnasium
import pytest

import quad_gym
from quad_gym.evaluation import roll_out
from tests.examples import example


@pytest.fixture(scope="module")
def script():
    pytest.importorskip("stable_baselines3")
    return example("sb3_defaults")


def evaluations(text):
    """Steps and errors, of the lines that the script prints."""
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


def test_training_and_evaluation_fly_as_the_options_say(script, monkeypatch):
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


def test_evaluations_change_nothing_that_is_learned(script, capsys):
    options = {"algorithm": "sac", "total_timesteps": 160, "evaluate": 4}
    for every in (20, 160):
        script.main(script.Args(**options, every=every))
    often, once = capsys.readouterr().out.split("160 steps:")[1:]
    assert often.splitlines()[0] == once.splitlines()[0]
