"""Evaluating and comparing, as a user does it from the command line."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from quad_gym.commands import compare as command
from quad_gym.commands import evaluate
from tests import console_commands
from tests.console import plain
from tests.console_commands import run

pytest.importorskip("stable_baselines3")
pytest.importorskip("matplotlib")

ROOT = Path(__file__).resolve().parents[2]


def read_csv(file):
    with file.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_a_comparison_from_before_there_were_engines_goes_on(tmp_path):
    described = {"steps": 100, "engine": "sb3"}
    (tmp_path / "comparison.json").write_text('{"steps": 100}')
    command._require_same(SimpleNamespace(folder=tmp_path, description=lambda: described))
    described["engine"] = "compiled"
    with pytest.raises(ValueError, match="different: engine"):
        command._require_same(SimpleNamespace(folder=tmp_path, description=lambda: described))


def test_evaluate_writes_what_it_prints(tmp_path):
    done = run(
        "evaluate",
        *("--policy", "pd", "pd:lab", "pretrained", "--episodes", 20, "--output", tmp_path / "out"),
        where=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    rows = read_csv(tmp_path / "out/episodes.csv")
    assert len(rows) == 3 * 2 * 20
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert len(summary["cases"]) == 6
    for case in summary["cases"]:
        mine = [
            float(row["mean_error"])
            for row in rows
            if (row["policy"], row["observation"]) == (case["policy"], case["observation"])
        ]
        assert np.mean(mine) == pytest.approx(case["mean_error"])
        assert f"{1e3 * case['mean_error']:.1f}" in done.stdout
    found = {(c["policy"], c["observation"]): c["mean_error"] for c in summary["cases"]}
    assert found["pd", "estimate"] < found["pd:lab", "estimate"]
    assert found["pretrained", "estimate"] < found["pd", "estimate"]
    for name in ("paths", "errors"):
        for ending in ("png", "svg"):
            assert (tmp_path / f"out/{name}.{ending}").stat().st_size > 1000


def test_evaluate_flies_what_there_is(tmp_path, capsys):
    few = ("--episodes", 2, "--observation", "truth", "--env", "duration=0.2")
    done = run("evaluate", "trajectory", *few, where=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "results/evaluate/trajectory/summary.json").read_text())
    assert summary["arguments"]["policy"] == ["pd"]
    told = "Only PD control is evaluated: no policy is included for QuadGym/Trajectory-v0"
    assert done.stdout.startswith(told)
    assert "pd on truth" in done.stdout
    for args, told, policies in (
        (("QuadGym/OutageDash-v0",), "", ["pd", "pretrained"]),
        (("QuadGym/Circle-v0", {"action": "attitude"}), "trained with action ctbr", ["pd"]),
        (("QuadGym/Circle-v0",), "", ["pd", "pretrained"]),
    ):
        env_id, env = args[0], dict(*args[1:])
        folder = tmp_path / "made"
        cases, _ = evaluate.configure(
            evaluate.Args(env_id=env_id, env=env, observation=("truth",), output=folder, episodes=2)
        )
        assert [name for name, _ in cases] == policies
        assert told in capsys.readouterr().out


@pytest.mark.parametrize("asked", [("pretrained",), ("pd", "pretrained")])
def test_evaluate_refuses_a_policy_that_is_asked_for_and_does_not_ship(tmp_path, asked):
    done = run("evaluate", "trajectory", "--policy", *asked, where=tmp_path)
    assert done.returncode == 2
    assert "error: no policy is included for QuadGym/Trajectory-v0" in done.stderr
    wrong = run("evaluate", "circle", "--env", "acton=motor", where=tmp_path)
    assert wrong.returncode == 2
    assert "did you mean action?" in wrong.stderr
    assert "alone" not in wrong.stdout


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["QuadGym/Square-v0"], "ENV_ID must be one of"),
        (["--policy", "nobody"], "policy must be pd"),
        (["--policy"], "--policy must have at least one value"),
        (["--observation", "measurements"], "select a --policy that was trained on measurements"),
        (["--policy", "missing.zip"], "there is no policy"),
        (["--observation", "guess"], "observation must be one of"),
        (["--observation", "estimat"], "did you mean estimate?"),
        (
            ["--policy", "pretrained", "--env", "include_std=true"],
            "trained with observations of 9 fields, but the environment returns 14 (it adds "
            "position_sigma, velocity_sigma, attitude_sigma, accel_bias_sigma, gyro_bias_sigma):",
        ),
        (
            ["--policy", "pretrained", "--env", "layout=absolute"],
            "but the environment returns 13 (it lacks position_error, velocity_error, up, heading "
            "and adds position, ",
        ),
        (["--observation"], "--observation must have at least one value"),
        (["--episodes", "0"], "--episodes must be at least 1"),
        (["--policy", "pretrained", "--env", "action=motor"], "trained with action ctbr"),
        (["QuadGym/Hover-v0", "--policy", "pretrained", "--env", "wings=2"], "wings is not"),
        (["--output", "/dev/null/x"], "cannot write to --output"),
    ],
)
def test_evaluate_refuses_nonsense(tmp_path, more, message):
    done = run("evaluate", *more, where=tmp_path)
    assert done.returncode == 2
    assert message in plain(done.stderr)
    assert "Traceback" not in done.stderr


def compare(where, *more):
    line = ["--quick", "--steps", 8192, "--output", where / "out", "--env", "duration=0.4"]
    return run("compare", *line, *more, where=where)


def test_compare_reports_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    done = compare(tmp_path)
    assert done.returncode == 0, done.stderr
    for part in ("trained on the estimate", "PD, tuned", "One training seed proves nothing"):
        assert part in done.stdout
    policies = read_csv(tmp_path / "out/policies.csv")
    assert len(policies) == (1 + 3) * 2
    page = (tmp_path / "out/report.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert "http" not in page
    kept = tmp_path / "out/runs/standard/truth/seed_0/best.zip"
    (tmp_path / "out/runs/standard/truth/seed_0/flown_on_truth.npz").unlink()
    before = kept.stat().st_mtime_ns
    with monkeypatch.context() as patch:  # no further process that imports torch
        patch.setattr(command, "ProcessPoolExecutor", lambda jobs, *_: ThreadPoolExecutor(jobs))
        again = compare(tmp_path)
    assert again.returncode == 0, again.stderr
    assert kept.stat().st_mtime_ns == before
    assert read_csv(tmp_path / "out/policies.csv") == policies
    other = compare(tmp_path, "--env", "duration=0.5")
    assert other.returncode == 2
    assert "holds another comparison" in other.stderr


def test_compare_trains_with_the_compiled_engine(tmp_path):
    done = compare(tmp_path, "--engine", "compiled", "--train-on", "estimate")
    assert done.returncode == 0, done.stderr
    assert "trained on the estimate" in done.stdout
    folder = tmp_path / "out/runs/standard/estimate/seed_0"
    assert {file.name for file in folder.glob("best.*")} == {"best.npz"}
    assert json.loads((folder / "training.json").read_text())["plan"]["engine"] == "compiled"
    assert "PPO (the compiled engine)" in (tmp_path / "out/report.html").read_text()
    other = compare(tmp_path, "--train-on", "estimate")
    assert other.returncode == 2
    assert "holds another comparison (different: engine)" in other.stderr


@pytest.mark.slow  # three processes with torch; a training that is killed: test_training.py
def test_compare_that_is_terminated_keeps_its_trainings_and_leaves_no_process(tmp_path):
    options = ["--steps", "300000", "--env", "duration=0.2", "--output", tmp_path / "out"]
    options += ["--seeds", "1", "--jobs", "2", "--train-on", "truth", "noisy"]
    line = console_commands.line("compare.py", *options)
    process = subprocess.Popen(
        line, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    wait_until(lambda: len(list(tmp_path.glob("out/runs/standard/*/seed_0/last.zip"))) >= 2)
    assert process.poll() is None
    process.terminate()
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    wait_until(lambda: nobody_is_in_group(process.pid), seconds=20.0)
    for source in ("truth", "noisy"):
        record = json.loads(
            (tmp_path / f"out/runs/standard/{source}/seed_0/training.json").read_text()
        )
        assert not record["finished"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_processes_end_with_the_comparison_however_that_ends(tmp_path, number):
    (tmp_path / "driver.py").write_text(DRIVER)
    process = subprocess.Popen(
        [sys.executable, "driver.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        start_new_session=True,
    )
    wait_until((tmp_path / "busy").exists, seconds=100.0)
    process.send_signal(number)
    assert process.wait(timeout=60) == -number
    wait_until(lambda: nobody_is_in_group(process.pid), seconds=60.0)


@pytest.mark.parametrize("how", ["returns", "raises", "goes on"])
def test_no_other_training_begins_once_the_comparison_is_gone(tmp_path, how):
    (tmp_path / "driver.py").write_text(TRAINING_DRIVER)
    process = subprocess.Popen(
        [sys.executable, "driver.py", how],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        start_new_session=True,
    )
    wait_until((tmp_path / "first").exists, seconds=100.0)
    process.kill()
    process.wait(timeout=60)
    wait_until(lambda: nobody_is_in_group(process.pid), seconds=60.0)
    assert (tmp_path / "asked").exists()
    assert not (tmp_path / "second").exists()


TRAINING_DRIVER = """
import multiprocessing, signal, sys, time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path


def train(how, folder, **options):
    asked = Path("asked")
    signal.signal(signal.SIGTERM, lambda *_: asked.touch())
    folder.touch()
    while not asked.exists() or how == "goes on":
        time.sleep(0.05)
    if how == "raises":
        raise OSError("no space left")


def begin():
    import baselines.training
    from quad_gym.commands import compare

    baselines.training.train = train
    compare.GRACE = 1.0 if sys.argv[1] == "goes on" else 1000.0
    compare.end_with_parent()


def work(how, folder):
    from quad_gym.commands.compare import train_one

    train_one(how, folder)


if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), begin)
    for folder in ("first", "second"):
        pool.submit(work, sys.argv[1], Path(folder))
    time.sleep(1000.0)
"""

DRIVER = """
import multiprocessing, time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path


def begin():
    from quad_gym.commands.compare import end_with_parent

    end_with_parent()


def work():
    Path("busy").touch()
    time.sleep(1000.0)


if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), begin)
    pool.submit(work)
    pool.submit(work)
    time.sleep(1000.0)
"""


def wait_until(condition, seconds=1200.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def nobody_is_in_group(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def test_compare_refuses_nonsense(tmp_path):
    for more, message in (
        (["QuadGym/Waypoints-v0"], "ENV_ID must be one of QuadGym/Hover-v0"),
        (["--sensors", "sonar"], "sensors must be one of"),
        (["--seeds", "0"], "--seeds must be at least 1"),
        (["--env", "observation=truth"], "must not contain observation: use --train-on"),
        (["--engine", "compiled", "--algorithm", "sac"], "engine"),
    ):
        done = run("compare", *more, "--output", tmp_path / "x", where=tmp_path)
        assert done.returncode == 2, more
        assert message in plain(done.stderr)
