"""Evaluation and comparison from the command line."""

import csv
import json
import sys

import numpy as np
import pytest

from quad_gym.commands import evaluate
from tests.console_commands import refused, run

pytest.importorskip("stable_baselines3")
pytest.importorskip("matplotlib")


def read_csv(file):
    with file.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_evaluate_writes_the_printed_numbers(tmp_path):
    done = run(
        "evaluate",
        "--policy",
        "pd",
        "pd:lab",
        "pretrained",
        "--episodes",
        20,
        "--output",
        tmp_path / "out",
        "--env",
        "duration=10.0",
        where=tmp_path,
        figures=True,
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


def test_evaluate_without_matplotlib_prints_and_writes_its_numbers(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    few = ["--episodes", 2, "--observation", "truth", "--policy", "pd", "--threads", 1]
    done = run("evaluate", "hover", *few, where=tmp_path)
    assert done.returncode == 0
    assert "pd on truth" in done.stdout
    assert 'A figure needs matplotlib: pip install "quad-gym[plot]".' in done.stdout
    files = {file.name for file in (tmp_path / "results/evaluate/hover").iterdir()}
    assert files == {"episodes.csv", "summary.json"}


def test_evaluate_without_included_policy_flies_pd(tmp_path, capsys):
    few = ("--episodes", 2, "--observation", "truth", "--env", "duration=0.2")
    done = run("evaluate", "trajectory", *few, where=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "results/evaluate/trajectory/summary.json").read_text())
    assert summary["arguments"]["policy"] == ["pd"]
    told = "Only PD control is evaluated: no policy is included for QuadGym/Trajectory-v0"
    assert done.stdout.startswith(told)
    assert "pd on truth" in done.stdout
    for env, told, policies in (
        ({"action": "attitude"}, "trained with action ctbr", ["pd"]),
        ({}, "", ["pd", "pretrained"]),
    ):
        few = {"observation": ("truth",), "output": tmp_path / "made", "episodes": 2}
        cases, _ = evaluate.configure(evaluate.EvaluateArgs(env_id="circle", env=env, **few))
        assert [name for name, _ in cases] == policies
        assert told in capsys.readouterr().out


def compare(where, *more):
    line = ["--quick", "--engine", "compiled", "--steps", 4096, "--output", where / "out"]
    line += ["--env", "duration=0.4", "--train-on", "estimate", "--evaluations", 2]
    line += ["--n-envs", 32, "--set", "n_epochs=3", "batch_size=512"]
    return run("compare", *line, *more, where=where)


def test_compare_writes_report_and_continues(tmp_path):
    done = compare(tmp_path)
    assert done.returncode == 0, done.stderr
    for part in ("trained on the estimate", "PD, tuned", "A single training seed is not concl"):
        assert part in done.stdout
    policies = read_csv(tmp_path / "out/policies.csv")
    assert len(policies) == (1 + 1) * 2
    page = (tmp_path / "out/report.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert "http" not in page
    kept = tmp_path / "out/runs/standard/estimate/seed_0/best.npz"
    plan = json.loads((kept.parent / "training.json").read_text())["plan"]
    assert plan["evaluations"] == 2
    assert plan["recipe"]["n_envs"] == 32
    assert plan["recipe"]["parameters"]["n_epochs"] == 3
    before = kept.stat().st_mtime_ns
    again = compare(tmp_path)
    assert again.returncode == 0, again.stderr
    assert kept.stat().st_mtime_ns == before
    assert read_csv(tmp_path / "out/policies.csv") == policies
    other = compare(tmp_path, "--env", "duration=0.5")
    assert other.returncode == 2
    assert "contains a run of another plan (different: environment)" in other.stderr


def test_evaluate_replaces_results_only_with_overwrite(tmp_path, capsys):
    few = "--policy pd --observation truth --episodes 2 --env duration=0.4"
    line = ["evaluate", "hover", *few.split()]
    run(*line, where=tmp_path)
    folder = tmp_path / "results" / "evaluate"
    file = folder / "hover" / "summary.json"
    before = file.read_text()
    run(*line, "--seed", 5, where=tmp_path)
    assert (folder / "hover_2" / "summary.json").exists()
    assert "--overwrite" in refused([*line, "--output", str(file.parent)], capsys)
    assert file.read_text() == before
    run(*line, "--seed", 5, "--overwrite", where=tmp_path)
    assert file.read_text() != before
    assert not (folder / "hover_3").exists()
