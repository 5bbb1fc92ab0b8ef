"""The benchmark's script runs and writes what it says; no test asserts on a clock."""

import json

import numpy as np
import pytest

import quad_gym
from quad_gym.commands import benchmark as script
from quad_gym.commands.options import parse
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.experiments.benchmark import learning, stages
from quad_gym.experiments.benchmark.filter import repeated
from quad_gym.experiments.benchmark.stages import Staged, hovering
from quad_gym.experiments.benchmark.timing import Timing, by_turns
from quad_gym.kernels.stages import Stage, needed_stages
from quad_gym.params.suites import SUITES
from quad_gym.records import POSITION_BLOCK, WIDTH


def run(folder, *options):
    script.main(parse(script.BenchmarkArgs, ["--quick", "--output", str(folder), *options]))
    return json.loads((folder / "benchmark.json").read_text())


def test_filter_section_compares_all_filters(tmp_path, capsys):
    rows = run(tmp_path / "new", "--only", "filter", "--batch", "16")["sections"]["filter"]
    kinds = {(row["kind"], row["measurements"]) for row in rows}
    expected = ("lanes", "UnscentedKalmanFilter", "plain NumPy")
    assert {(kind, n) for kind in expected for n in (6, 12)} <= kinds
    for row in rows:
        assert row["seconds"] > 0.0
        assert (row["times_lanes"] == 1.0) == (row["kind"] == "lanes")
    assert "plain NumPy, 12 measurements" in capsys.readouterr().out


def test_tick_section_names_every_stage_of_a_suite(tmp_path):
    rows = run(tmp_path, "--only", "tick", "--batch", "16", "--n-envs", "16")["sections"]["tick"]
    assert {row["suite"] for row in rows if row["kind"] == "suite"} == set(SUITES)
    for suite in ("standard", "lab"):
        mine = {
            row["part"]: row for row in rows if row["kind"] != "suite" and row["suite"] == suite
        }
        batch = quad_gym.FlightBatch(1, sensors=suite, task=TASK_DEFAULTS["hover"])
        stages = {stage.name.lower() for stage in needed_stages(batch._settings[0])}
        assert set(mine) == stages | {"whole tick", "filter", "sum of the tick's stages"}
        ticks = [row["seconds"] for row in mine.values() if row["kind"] == "tick"]
        assert mine["sum of the tick's stages"]["seconds"] == pytest.approx(sum(ticks))
        for row in mine.values():
            assert row["share"] == pytest.approx(row["seconds"] / mine["whole tick"]["seconds"])


def test_options_section_compares_each_with_everything_off(tmp_path):
    found = run(tmp_path, "--only", "options", "--batch", "16")
    rows = {row["name"]: row for row in found["sections"]["options"]}
    assert {"gate", "gusts", "suite rtk", "extended Kalman filter"} < set(rows)
    for row in rows.values():
        off = rows["everything off"]["seconds"]
        assert row["times_off"] == pytest.approx(row["seconds"] / off)


def test_learning_section_finds_when_the_policy_beats_pd(tmp_path, capsys):
    rows = run(tmp_path, "--only", "learning", "--seeds", "2")["sections"]["learning"]
    assert [(row["seed"], row["steps_to_pd"]) for row in rows] == [(0, None)]  # quick
    assert "0 of 1 below tuned PD" in capsys.readouterr().out
    names = ("steps", "training_seconds", "mean_error", "crash_rate")
    flown = [(0, 0.0, 0.05, 0.5), (10, 1.0, 0.08, 0.0), (20, 2.0, 0.06, 0.0), (30, 3.0, 0.05, 0.0)]
    found = learning.summary([dict(zip(names, row, strict=True)) for row in flown], pd=0.07)
    assert (found["steps_to_pd"], found["seconds_to_pd"], found["error"]) == (20, 2.0, 0.05)


def test_blocks_over_a_period_measure_as_often_as_sensors():
    """GNSS at 10 Hz and a camera at 25 Hz measure in 1 of 20 and 1 of 8 ticks of 5 ms."""
    batch = stages.hovering(40 * WIDTH, sensors="rtk")
    blocks = stages.over_a_period(batch)
    ticks = blocks["tick"][:, 0]
    assert set(ticks - ticks.min()) == set(range(40))
    batch.restore(blocks)
    assert batch.record("block_valid")[:, POSITION_BLOCK].mean() == pytest.approx(1 / 20, abs=0.02)


def test_what_takes_turns_is_timed_by_turns():
    order, slow, fast = [], iter([4.0, 2.0, 3.0]), iter([1.0, 1.0, 1.5])
    jobs = [lambda: order.append("slow") or next(slow), lambda: order.append("fast") or next(fast)]
    timings = by_turns(jobs, 3)
    assert order == ["slow", "fast"] * 3
    assert timings == [Timing(2.0, 0.5), Timing(1.0, 0.0)]


def test_update_of_repeated_flights_shrinks_each_covariance():
    batch = hovering(16)
    blocks = repeated(batch, np.array([3, 5]), 32)
    before = np.abs(blocks["L"]).sum(axis=(1, 2))
    Staged(batch, Stage.UPDATE)(blocks)
    assert (np.abs(blocks["L"]).sum(axis=(1, 2)) < before).all()
