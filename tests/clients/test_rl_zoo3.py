"""rl-zoo3 trains as docs/libraries.md shows, with fewer steps, and evaluates the policy."""

import os
import shlex
import subprocess
import sys

import pytest

from tests.clients.run import PAGE, ROOT
from tests.contract.test_documentation import blocks

pytest.importorskip("rl_zoo3")


def run(folder, *words):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_command_of_the_page_trains_and_the_policy_flies(tmp_path):
    (command,) = (
        line
        for _, text, _ in blocks(PAGE, "sh")
        for line in text.splitlines()
        if "rl_zoo3.train" in line
    )
    (config,) = (text for _, text, _ in blocks(PAGE, "yaml"))
    (tmp_path / "zoo.yml").write_text(config)
    less = ("--conf-file", "zoo.yml", "-n", "4000", "--hyperparams", "n_steps:32", "batch_size:64")
    run(tmp_path, *shlex.split(command)[1:], *less)
    assert list(tmp_path.glob("logs/ppo/*/*.zip"))
    flying = ("--algo", "ppo", "--env", "QuadGym/Circle-v0", "--gym-packages", "quad_gym")
    out = run(tmp_path, "-m", "rl_zoo3.enjoy", *flying, "-f", "logs", "-n", "600", "--no-render")
    assert "Episode Reward" in out
