"""Sections of the benchmark of parts; no test depends on measured times."""

import json
import subprocess

import numpy as np
import pytest

import quad_gym
from quad_gym.commands.benchmark import hovering
from quad_gym.commands.options import parse
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.kernels.stages import needed_stages
from quad_gym.records import POSITION_BLOCK, WIDTH
from scripts.benchmarks import __main__ as script
from scripts.benchmarks import learning, peers, precision, stages
from scripts.benchmarks.filter import record_one


def run(folder, *options):
    script.main(parse(script.PartsArgs, [*options, "--quick", "--output", str(folder)]))
    return json.loads((folder / "benchmark.json").read_text())


@pytest.mark.slow
def test_filter_section_compares_all_filters(tmp_path, capsys):
    rows = run(tmp_path / "new", "filter", "--batch", "16")["sections"]["filter"]
    kinds = {(row["kind"], row["measurements"]) for row in rows}
    expected = ("lanes", "UnscentedKalmanFilter", "plain NumPy")
    assert {(kind, n) for kind in expected for n in (6, 12)} <= kinds
    for row in rows:
        assert row["seconds"] > 0.0
        assert (row["times_lanes"] == 1.0) == (row["kind"] == "lanes")
    assert "plain NumPy, 12 measurements" in capsys.readouterr().out


def test_filters_section_compares_filters_on_the_same_flights(tmp_path, capsys):
    options = ("--batch", "8", "--sensors", "indoor", "--estimators", "tests.estimators:Simple")
    rows = run(tmp_path, "filters", *options)["sections"]["filters"]
    found = {row["name"]: row for row in rows}
    assert list(found) == ["bound", "UKF", "EKF", "Simple"]
    for row in (found["UKF"], found["EKF"]):
        for part in ("position", "velocity", "attitude"):
            (value, low, high), (bound,) = row[f"{part}_rmse"], found["bound"][f"{part}_rmse"]
            assert low < value < high
            assert row[f"{part}_ratio"] == pytest.approx(value / bound)
            assert 0.5 < value / bound < 2.0  # only eight flights
        assert row["seconds"] > 0.0
        assert list(row["lost"]) == ["none", "wrong_associations"]
    assert (found["Simple"]["nees"], found["Simple"]["nis"]) == (None, None)
    assert "Simple" in capsys.readouterr().out


def test_filters_section_reports_an_estimator_that_fails(tmp_path, capsys):
    options = ("--batch", "8", "--sensors", "indoor", "--estimators", "tests.estimators:Diverges")
    rows = run(tmp_path, "filters", *options)["sections"]["filters"]
    assert rows[-1]["failed"].startswith("Diverges.update must return finite numbers")
    assert "indoor, Diverges: Diverges.update must return" in capsys.readouterr().out


def test_tick_section_names_every_stage_of_a_suite(tmp_path):
    rows = run(tmp_path, "tick", "--batch", "16")["sections"]["tick"]
    for suite in ("standard", "lab"):
        mine = {row["part"]: row for row in rows if row["suite"] == suite}
        batch = quad_gym.FlightBatch(1, sensors=suite, task=TASK_DEFAULTS["hover"])
        stages = {stage.name.lower() for stage in needed_stages(batch._settings[0])}
        assert set(mine) == stages | {"whole tick", "filter", "sum of the tick's stages"}
        ticks = [row["seconds"] for row in mine.values() if row["kind"] == "tick"]
        assert mine["sum of the tick's stages"]["seconds"] == pytest.approx(sum(ticks))
        for row in mine.values():
            assert row["share"] == pytest.approx(row["seconds"] / mine["whole tick"]["seconds"])


@pytest.mark.slow
def test_peers_section_compares_errors_of_filters_on_the_same_measurements(tmp_path):
    """The plain filter computes the same estimate; filterpy's filter has fewer sigma points."""
    rows = run(tmp_path, "peers", "--n-envs", "16")["sections"]["peers"]
    ours, plain, *others = [row for row in rows if row["position"] is not None]
    assert (ours["name"], plain["name"]) == (
        "filter cycle, UnscentedKalmanFilter",
        "filter cycle, plain NumPy",
    )
    for row in (plain, *others):
        assert row["position"] == pytest.approx(ours["position"], rel=0.01)
        assert row["attitude"] == pytest.approx(ours["attitude"], rel=0.01)


def test_making_a_filter_is_not_timed_and_a_run_can_be_repeated(monkeypatch):
    made, sensors = [], quad_gym.sensor_suite("lab").replace(camera=None)

    class Counted(peers.UnscentedKalmanFilter):
        def __init__(self, suite):
            made.append(suite)
            super().__init__(suite)

    monkeypatch.setattr(peers, "UnscentedKalmanFilter", Counted)
    flight = record_one(hovering(WIDTH, sensors=sensors), 0, 20)
    for name, cycles in peers.peers(sensors, flight).items():
        first, second = cycles(), cycles()
        for one, other in zip(first, second, strict=True):
            np.testing.assert_array_equal(one.position, other.position, err_msg=name)
            np.testing.assert_array_equal(one.R_BI, other.R_BI, err_msg=name)
    assert len(made) == 1


def test_precision_section_compares_processes_in_both_precisions(tmp_path, monkeypatch, capsys):
    started = []

    def process(words, *, env, **_):
        started.append((env["QUAD_GYM_PRECISION"], words[3]))
        seconds = {"double": "4e-6\n", "single": "2e-6\n"}[env["QUAD_GYM_PRECISION"]]
        return subprocess.CompletedProcess(words, 0, stdout=seconds)

    monkeypatch.setattr(subprocess, "run", process)
    rows = run(tmp_path, "precision", "--sensors", "lab")["sections"]["precision"]
    turn = [(name, suite) for suite in ("lab", "truth") for name in ("double", "single")]
    assert started == turn  # one turn of a quick run
    assert [row["ratio"] for row in rows] == [0.5, 0.5]
    monkeypatch.undo()
    capsys.readouterr()
    precision.main("truth", "16", "1", "0.01")  # what a process prints
    assert 0.0 < float(capsys.readouterr().out) < 1.0


@pytest.mark.slow
def test_learning_section_finds_when_the_policy_beats_pd(tmp_path, capsys):
    rows = run(tmp_path, "learning", "--seeds", "2")["sections"]["learning"]
    assert [(row["seed"], row["steps_to_pd"]) for row in rows] == [(0, None)]  # a quick run
    assert "0 of 1 below tuned PD" in capsys.readouterr().out
    names = ("steps", "training_seconds", "mean_error", "crash_rate")
    flown = [(0, 0.0, 0.05, 0.5), (10, 1.0, 0.08, 0.0), (20, 2.0, 0.06, 0.0), (30, 3.0, 0.05, 0.0)]
    found = learning.summary([dict(zip(names, row, strict=True)) for row in flown], pd=0.07)
    assert (found["steps_to_pd"], found["seconds_to_pd"], found["error"]) == (20, 2.0, 0.05)


def test_blocks_over_a_period_measure_as_often_as_sensors():
    """GNSS at 10 Hz and a camera at 25 Hz measure in 1 of 20 and 1 of 8 ticks of 5 ms."""
    batch = hovering(40 * WIDTH, sensors="rtk")
    blocks = stages.over_a_period(batch)
    ticks = blocks["tick"][:, 0]
    assert set(ticks - ticks.min()) == set(range(40))
    batch.restore(blocks)
    assert batch.record("block_valid")[:, POSITION_BLOCK].mean() == pytest.approx(1 / 20, abs=0.02)
