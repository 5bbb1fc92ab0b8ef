"""Sweeps: expansion of files and options, and tables from folders."""

import csv
import json
import time

import numpy as np
import pytest
from scipy.stats import binomtest

from baselines.recipes import description
from quad_gym.commands.sweep import FILES, expand, groups_of, row_of, write_tables
from tests import console_commands

TRUTH = {"duration": 1.0, "observation": "truth"}
SMALL = """
engine = "compiled"
evaluations = 40
episodes = 4
env = {duration = 1.0, observation = "truth"}
set = {n_steps = 16, batch_size = 128, n_epochs = 1, gamma = [0.97, 0.9, 0.8]}
steps = 40960
n_envs = 16
"""


def test_every_combination_has_own_folder_and_is_ordered_by_seed(tmp_path):
    given = {
        "env_ids": ["QuadGym/Hover-v0", "QuadGym/Circle-v0"],
        "seeds": [3, 1],
        "env": {"sensors": ["lab", "rtk"], "duration": 2.0},
        "recipe": {"layers": [[32, 32]]},
        "set": {"gamma": [0.9, 0.99]},
    }
    found = expand(given, tmp_path, threads=2)
    assert len(found) == len({t.folder for t in found}) == 2 * 2 * 2 * 2
    first = found[0]
    assert first.folder == tmp_path / "runs/hover,ppo,sensors=lab,gamma=0.9,layers=32x32/seed_3"
    assert [t.plan.seed for t in found] == 8 * [3] + 8 * [1]
    assert dict(first.plan.environment) == {"sensors": "lab", "duration": 2.0}
    assert first.plan.recipe.layers == (32, 32)
    assert first.plan.recipe.parameters["gamma"] == 0.9
    assert first.plan.recipe.parameters["n_epochs"] == 5  # from the recipe
    assert (first.plan.engine, first.plan.threads) == ("sb3", 2)
    fewer = expand({**given, "set": {"gamma": [0.9]}, "seeds": [3]}, tmp_path)
    assert {t.folder for t in fewer} < {t.folder for t in found}


def test_options_override_the_file(tmp_path):
    (tmp_path / "mine.toml").write_text(SMALL)
    line = "mine.toml --dry-run --set gamma=0.9,0.95,0.99 --env camera=true,false --seeds 1"
    done = console_commands.run("sweep", *line.split(), where=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].endswith("mine/runs/circle,compiled_ppo,camera=true,gamma=0.9/seed_0")
    assert lines[-1] == "6 trainings, 245,760 steps."
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seeds = [", "is not valid TOML"),
        ("sedes = 3", "must be one of env_ids, algorithm"),
        ("env = 3", "env in bad.toml must be a table, got 3"),
        ("seeds = [1, 1]", "seeds must be different numbers, at least one, got [1, 1]"),
        ("set = {gamma = [0.9, 0.9]}", "every value of a sweep must be given once"),
        ('env_ids = "QuadGym/Hover-v0"', "env_ids must be a list of names"),
        ('algorithm = ["alphago"]', "algorithm must be one of ppo"),
        ("episodes = 1.5", "episodes must be a whole number"),
        ("set = {gamma = []}", "set.gamma must have at least one value"),
        ("recipe = {steps = 1000}", "recipe must not hold steps: use steps instead"),
        ('engine = "compiled"\nset = {gama = 0.9}', "circle,compiled_ppo: "),
        ('engine = "compiled"\nenv = {radius = -1}', "radius must be greater than 0"),
        ("env = {threads = 1}", "--env must not contain threads: use --threads instead"),
    ],
)
def test_invalid_file_is_rejected_with_one_line(tmp_path, text, message):
    (tmp_path / "bad.toml").write_text(text)
    done = console_commands.run("sweep", "bad.toml", where=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "results/sweep/bad/runs").exists()


def pretend(training, error):
    """Write the files of a training, finished if an error is given."""
    training.folder.mkdir(parents=True)
    (training.folder / "last.npz").touch()
    best = {"steps": 96.0, "mean_error": error, "crash_rate": 0.25, "return": 7.0}
    record = {"plan": description(training.plan), "finished": error is not None}
    record |= {} if error is None else {"steps": 128, "best": best, "training_seconds": time.time()}
    (training.folder / "training.json").write_text(json.dumps(record))
    (training.folder / "evaluations.csv").write_text("steps,mean_error\n0,1\n64,0.5\n")


def test_tables_contain_records_of_folders(tmp_path):
    trainings = expand({"seeds": 5, "env": TRUTH}, tmp_path)
    for training, error in zip(trainings, (0.1, 0.2, 0.6, None), strict=False):
        pretend(training, error)
    rows = [row_of(training) for training in trainings]
    assert [row["finished"] for row in rows] == [True, True, True, False, False]
    assert [row["steps"] for row in rows] == [128, 128, 128, 64, 0]
    assert [row["mean_error"] for row in rows] == [0.1, 0.2, 0.6, None, None]
    (group,) = groups_of(rows)
    assert (group["trainings"], group["finished"]) == (5, 3)
    np.testing.assert_allclose(group["mean_error"], 0.3)
    # Student's t of three values: 4.3027 standard errors
    half = 4.3027 * np.std([0.1, 0.2, 0.6], ddof=1) / np.sqrt(3.0)
    np.testing.assert_allclose(group["mean_error_high"] - 0.3, half, rtol=1e-4)
    np.testing.assert_allclose(0.3 - group["mean_error_low"], half, rtol=1e-4)
    limits = binomtest(25, 100).proportion_ci(method="exact")  # the rate is the same in all seeds
    # three trainings hardly exclude that others fail: the interval is wider than over episodes
    assert 0.0 < group["crash_rate_low"] < limits.low
    assert limits.high < group["crash_rate_high"] < 1.0
    write_tables(rows, tmp_path)
    with (tmp_path / "trainings.csv").open(newline="") as stream:
        written = list(csv.DictReader(stream))
    assert [row["mean_error"] for row in written] == ["0.1", "0.2", "0.6", "", ""]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*FILES, "runs"])


def test_folder_with_another_training_is_rejected(tmp_path):
    (training,) = expand({"env": TRUTH}, tmp_path / "out")
    pretend(training, 0.1)
    options = ["--env", "duration=2.0", "--output", "out"]
    done = console_commands.run("sweep", *options, where=tmp_path)
    assert done.returncode == 2
    assert "contains a run of another plan (different: environment)" in done.stderr
