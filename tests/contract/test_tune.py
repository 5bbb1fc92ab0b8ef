"""Tuning PD control from the command line."""

import json

import gymnasium
import pytest

import quad_gym
from baselines.policies import load_policy
from tests import console_commands


def tune(*options):
    return console_commands.run("tune", *options)


def test_finds_gains_no_worse_than_the_start_that_fly(tmp_path):
    tiny = ["--candidates", 64, "--episodes", 4, "--fresh-episodes", 8, "--env", "duration=3.0"]
    done = tune("--env-ids", "hover", *tiny, "--output", tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "gains.json").read_text())
    rows = (tmp_path / "search.csv").read_text().splitlines()
    errors = [float(row.split(",")[0]) for row in rows[1:]]
    assert len(errors) == record["candidates"] == 64
    assert errors[0] == 1.0  # the gains at the start are the first that fly
    assert min(errors) < 1.0
    best = rows[1:][errors.index(min(errors))].split(",")
    assert float(best[1]) == pytest.approx(record["gains"]["position"])
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=2)
    policy = load_policy(f"pd:{tmp_path / 'gains.json'}", env)
    assert policy.gains == quad_gym.PDGains(
        **{k: tuple(v) if isinstance(v, list) else v for k, v in record["gains"].items()}
    )


@pytest.mark.parametrize("text", ["no JSON", "{}", '{"gains": {"wings": 2}}'])
def test_refuses_files_without_gains(tmp_path, text):
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=1)
    (tmp_path / "gains.json").write_text(text)
    with pytest.raises(ValueError, match="does not contain PD gains"):
        load_policy(f"pd:{tmp_path / 'gains.json'}", env)
    with pytest.raises(ValueError, match="there are no gains"):
        load_policy("pd:missing.json", env)
