"""The soak: one case of each kind passes, and planted differences, crashes and growth are found."""

import contextlib
import dataclasses
import os

import numpy as np
import pytest

from quad_gym import FlightBatch
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.exported import as_printed
from tests.soak import __main__ as program
from tests.soak import configurations, damaged_logs, exports, faults, log, snapshots
from tests.soak.cases import Case, Kind, generator, run_case
from tests.soak.kinds import KINDS
from tests.soak.running import row_of

MODULES = {
    "configurations": configurations,
    "snapshots": snapshots,
    "faults": faults,
    "damaged_logs": damaged_logs,
}
"""Kinds of which a case takes little time."""


def flown(name):
    """Number of the first case of a kind that is not refused."""
    return next(k for k in range(20) if not run_case(name, KINDS[name], k).refused)


def failure(name, number):
    return run_case(name, KINDS[name], number).failure


@pytest.mark.parametrize("name", MODULES)
def test_a_case_passes_and_follows_from_its_number(name):
    number = flown(name)
    assert failure(name, number) == ""
    draws = [generator(name, k).random() for k in (number, number, number + 1)]
    assert draws[0] == draws[1] != draws[2]


def test_mild_damages_change_tables_that_are_still_read(tmp_path):
    """Of each damage, most tables are read; none is unchanged, and the head stays."""
    rows = damaged_logs.table("rtk_vertical.csv.gz")
    for damage in damaged_logs.MILD:
        read = 0
        for number in range(4):
            file = tmp_path / f"{damage.__name__}{number}.csv"
            changed = damaged_logs.damaged_table(np.random.default_rng(number), rows, (damage,))
            assert changed[0] == rows[0]
            file.write_text("".join(",".join(row) + "\n" for row in changed), encoding="utf-8")
            with contextlib.suppress(ValueError):
                read += len(damaged_logs.read_log(file).imu) > 100
        assert read >= 3, damage.__name__


def test_a_bit_in_a_single_environment_is_found(monkeypatch):
    number, step = flown("configurations"), QuadEnv.step

    def other(self, action):
        observation, reward, *rest = step(self, action)
        return observation, np.nextafter(reward, np.inf), *rest

    monkeypatch.setattr(QuadEnv, "step", other)
    assert failure("configurations", number).startswith("AssertionError at ")


def test_another_refusal_in_a_single_environment_is_found(monkeypatch):
    monkeypatch.setattr(configurations, "configuration", lambda rng: ("hover", {"layout": "x"}))
    case = run_case("configurations", KINDS["configurations"], 0)
    assert (case.refused, case.failure) == (True, "")

    def refuse(**keywords):
        raise ValueError("other words")

    monkeypatch.setattr(configurations, "QuadEnv", refuse)
    assert "the single one 'other words'" in failure("configurations", 0)


@pytest.mark.parametrize("kind", ["same", "new", "pickled", "copied"])
def test_a_bit_after_a_restored_state_is_found(kind, monkeypatch):
    simple = ("hover", {"observation": "truth"})
    chosen = {("same", "new", "pickled", "copied"): kind}
    monkeypatch.setattr(snapshots, "configuration", lambda rng: simple)
    monkeypatch.setattr(snapshots, "pick", lambda rng, some: chosen.get(some, "NextStep"))
    assert failure("snapshots", 1) == ""
    step, calls = QuadVectorEnv.step, []

    def other(self, actions):
        calls.append(1)
        observations, rewards, *rest = step(self, actions)
        return observations, rewards + 1e-15 * len(calls), *rest

    with monkeypatch.context() as patch:
        patch.setattr(QuadVectorEnv, "step", other)
        assert f"{kind}[0][1]" in failure("snapshots", 1)
    if kind in ("same", "new"):
        restore = FlightBatch.restore

        def moved(self, snapshot):
            snapshot = snapshot.copy()
            snapshot["r"][0, 0, 0] = np.nextafter(snapshot["r"][0, 0, 0], np.inf)
            restore(self, snapshot)

        monkeypatch.setattr(FlightBatch, "restore", moved)
        assert "the restored state differs" in failure("snapshots", 1)


@pytest.mark.parametrize("plant", ["error", "words", "library", "nan", "second"])
def test_wrong_end_of_a_replay_is_found(plant, monkeypatch):
    number, replay, calls = flown("damaged_logs"), damaged_logs.replay, []

    def wrong(log, **options):
        calls.append(1)
        if plant == "error":
            raise KeyError("fix_type")
        if plant == "words":
            raise ValueError("no")
        if plant == "library":
            np.zeros(3).reshape(2)
        result = replay(log, **options)
        sigma = result.sigma.copy()
        sigma[-1, -1] *= np.nan if plant == "nan" else 1.0 + 1e-15 * len(calls)
        return dataclasses.replace(result, sigma=sigma)

    monkeypatch.setattr(damaged_logs, "replay", wrong)
    words = {
        "error": "KeyError",
        "words": "has no sentence",
        "library": "another library says: ValueError('cannot reshape",
        "nan": "gyro_bias_sigma_z is not finite",
        "second": "the second time.gyro_bias_sigma_z",
    }
    assert words[plant] in failure("damaged_logs", number)


@pytest.mark.parametrize("plant", ["nan", "factor", "flag"])
def test_invalid_record_of_a_flight_with_faults_is_found(plant, monkeypatch):
    record = FlightBatch.record
    plants = {
        "nan": ("accel", lambda values: values * np.nan),
        "factor": ("L", lambda values: np.where(np.eye(15, k=1) > 0.0, 1e-9, values)),
        "flag": ("filter_status", lambda values: values | 2),
    }
    field, changed = plants[plant]

    def other(self, name, *flights):
        values = record(self, name, *flights)
        return changed(values) if name == field else values

    monkeypatch.setattr(FlightBatch, "record", other)
    assert failure("faults", 0).startswith("AssertionError at ")


@pytest.mark.parametrize("bits", [0, 1])
def test_a_bit_of_an_exported_filter_is_found(bits, monkeypatch):
    """Without compiling one: its output is the replay's."""
    kept, replay = [], exports.replay

    def kept_replay(*words, **options):
        kept.append(replay(*words, **options))
        return kept[-1]

    def printed(*command):
        rows = as_printed(kept[-1])
        rows[-1, 3] = np.nextafter(rows[-1, 3], np.inf) if bits else rows[-1, 3]
        return list(kept[-1].columns()), rows

    monkeypatch.setattr(exports, "replay", kept_replay)
    monkeypatch.setattr(exports, "estimates", printed)
    monkeypatch.setattr(exports, "export_filter", lambda *words: None)
    monkeypatch.setattr(exports.subprocess, "run", lambda *words, **options: None)
    assert ("Arrays are not equal" in failure("exports", 0)) == bool(bits)
    assert len(kept) == (1 if bits else 2)


def test_missing_programs_of_exports_are_named(monkeypatch):
    monkeypatch.setattr(exports.shutil, "which", lambda tool: None)
    assert exports.missing() == ["gcc-aarch64-linux-gnu", "qemu-user-static"]


CASES = []


def planted(rng):
    """Three cases: one that passes, one with a difference, and one that ends the process."""
    CASES.append(1)
    assert len(CASES) != 2, "planted"
    if len(CASES) == 3:
        os._exit(3)
    return False


def test_failures_and_crashes_are_in_the_log_and_in_the_exit_code(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(KINDS, "planted", Kind(run=planted, about=""))
    file = tmp_path / "soak.csv"
    args = program.SoakArgs(minutes=1.0, kinds=("planted",), seed=7, log=file)
    assert program.main(args) == 1
    (row,) = log.read(file)
    assert (row.kind, row.first, row.cases, row.differing) == ("planted", 7, 3, 2)
    assert row.failure.startswith("8: AssertionError at test_soak.py:")
    assert "2 failed" in capsys.readouterr().out
    assert log.next_case("planted", [row]) == 10
    assert log.next_case("snapshots", [row]) == 0


def test_kind_whose_programs_are_missing_is_left_out(tmp_path, monkeypatch, capsys):
    kind = Kind(run=planted, about="", missing=lambda: ["qemu-user-static"])
    monkeypatch.setitem(KINDS, "planted", kind)
    assert program.main(program.SoakArgs(kinds=("planted",), log=tmp_path / "soak.csv")) == 0
    assert "planted are left out, as this machine lacks qemu-user-static" in capsys.readouterr().out
    assert not (tmp_path / "soak.csv").exists()


def test_options_are_checked():
    with pytest.raises(ValueError, match="--kinds must be one of configurations, "):
        program.SoakArgs(kinds=("nothing",))
    with pytest.raises(ValueError, match="--case must be"):
        program.SoakArgs(case=("snapshots", -1))


def row_with(memory):
    return row_of("planted", 0, [Case(k, False, "", 0.1 * k, m) for k, m in enumerate(memory)])


def test_growth_of_memory_after_the_warm_up_is_limited():
    """Of 4,000 cases, the second half counts: 1,800 cases between the medians of tenths."""
    k = np.arange(4000)
    loading = 300.0 + 100.0 * (k < 2000) * k / 2000
    assert not row_with(loading + 0.8 * log.MEMORY_LIMIT * k / 1000).grows
    row = row_with(300.0 + 1.3 * log.MEMORY_LIMIT * k / 1000)
    assert row.grows
    assert "the memory has grown" in row.failure
    assert row.grown_in == 1600
    assert row.growth == pytest.approx(1.3 * log.MEMORY_LIMIT * 1.6, abs=0.1)
    few = row_with([300.0, 400.0, 400.0, 400.0 + 1.1 * log.MEMORY_LIMIT])
    assert few.grows


def test_summary_of_a_log_adds_its_rows():
    row = row_with([300.0] * 20)
    rows = [
        dataclasses.replace(row, date="2026-11-30", seconds=3600.0, refused=5, kind="snapshots"),
        dataclasses.replace(row, date="2026-12-02", seconds=1800.0, growth=0.4, grown_in=8),
        dataclasses.replace(row, date="2026-12-01", seconds=0.0, differing=1, grown_in=8, growth=0),
    ]
    texts = log.texts(rows)
    assert texts["soak"].startswith(
        "The log has 1.50 of 24 h of processor time: 60 cases ran from 2026-11-30 to 2026-12-02, "
    )
    assert texts["soak"].endswith(", and 1 of them failed.")
    lines = [[cell.strip() for cell in line.split("|")] for line in texts["soak.kinds"].split("\n")]
    assert ["", "snapshots", "20", "5", "60.0 min", "0", "+0.0 MB in 8 cases", ""] in lines
    assert ["", "planted", "40", "0", "30.0 min", "1", "+0.4 MB in 16 cases", ""] in lines


def test_log_of_a_file_has_the_rows_that_were_appended(tmp_path):
    rows = [row_with([300.0] * n) for n in (1, 20)]
    for row in rows:
        log.append(row, tmp_path / "soak.csv")
    assert log.read(tmp_path / "soak.csv") == rows
    assert log.read(tmp_path / "none.csv") == []
