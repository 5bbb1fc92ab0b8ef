"""Tests of the command `circle`: errors, files and options."""

import csv
import json

import numpy as np
import pytest

from quad_gym import pd_gains
from quad_gym.commands import circle as script
from quad_gym.commands.options import parse
from tests.console_commands import without_figures

pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")

CASES = ("truth", "estimate", "estimate_without_camera")


def run(folder, line=""):
    script.main(parse(script.CircleArgs, [*line.split(), "--output", str(folder)]))
    return json.loads((folder / "summary.json").read_text())


@pytest.fixture
def no_figures():
    with without_figures():
        yield


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("circle")
    with without_figures():
        return folder, run(folder, "--episodes 20")


def test_errors_are_within_expected_ranges(flown):
    cases = flown[1]["cases"]
    mean = {case: cases[case]["tracking_error"]["mean"]["mean"] for case in CASES}
    late = {case: cases[case]["tracking_error"]["last_half"]["mean"] for case in CASES}
    assert 0.109 < mean["truth"] < 0.112
    assert 0.109 < mean["estimate"] < 0.125
    assert 0.110 < mean["estimate_without_camera"] < 0.116
    assert 0.018 < late["truth"] < 0.021
    assert 0.019 < late["estimate"] < 0.026
    assert 0.0025 < cases["estimate"]["estimation_error"]["last_half"]["mean"] < 0.0040
    assert cases["truth"]["tracking_error"]["mean"]["sd"] == 0.0
    pairs = flown[1]["paired_differences_of_mean_tracking_error"]
    low, high = pairs["estimate_without_camera - truth"]["interval"]
    assert 0.0 < low < high


def test_csv_agrees_with_the_summary(flown):
    folder, summary = flown
    with (folder / "flights.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 3 * 20
    for case in CASES:
        of_case = [row for row in rows if row["case"] == case]
        assert [int(row["seed"]) for row in of_case] == list(range(20))
        finished = [row for row in of_case if row["ending"] == "finished"]
        errors = [float(row["tracking_error_mean_m"]) for row in finished]
        found = summary["cases"][case]
        assert found["finished"] + found["crashed"] + found["filter_failed"] == 20
        want = found["tracking_error"]["mean"]["mean"]
        assert np.mean(errors) == pytest.approx(want, rel=1e-9)
        assert all(row["ended_at_s"] == "" for row in finished)


def test_figures_of_report_are_written_as_png_and_svg(flown):
    names = {f"{kind}_{case}" for kind in ("path", "height") for case in CASES[1:]}
    names |= {f"error_{case}" for case in CASES} | {"overview"}
    written = {file.name for file in flown[0].iterdir() if file.suffix in (".png", ".svg")}
    assert written == {f"{name}.{ending}" for name in names for ending in ("png", "svg")}


def test_results_do_not_depend_on_batch_or_threads(tmp_path, no_figures):
    run(tmp_path / "many", "--episodes 5 --duration 1")
    one = run(tmp_path / "one", "--seed 3 --episodes 1 --duration 1 --threads 1")
    with (tmp_path / "many/flights.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for case in CASES:
        want = next(r for r in rows if r["case"] == case and r["seed"] == "3")
        found = one["cases"][case]["tracking_error"]["mean"]
        assert found["mean"] == pytest.approx(float(want["tracking_error_mean_m"]), rel=1e-12)
        assert found["sd"] is None


def test_crashes_are_counted(tmp_path, capsys, no_figures):
    summary = run(tmp_path, "--no-camera --episodes 3 --duration 4 --radius 30 --period 3")
    for case in summary["cases"].values():
        assert (case["finished"], case["crashed"]) == (0, 3)
    assert "too few flights were completed" in capsys.readouterr().out


def test_options_reach_the_flights(tmp_path, no_figures):
    line = "--episodes 2 --duration 1 --radius 2 --gains tuned --gnss-rate 10"
    configuration = run(tmp_path, f"{line} --bearing-noise-at predicted")["configuration"]
    assert configuration["task"]["radius"] == 2.0
    assert configuration["gains"]["position"] == pd_gains("tuned").position
    suite = configuration["sensors"]["estimate"]
    assert (suite["gnss"]["rate"], suite["camera"]["rate"]) == (10.0, 200.0)
    assert suite["estimator"]["bearing_noise_at"] == "predicted"


def test_estimator_option_selects_the_filter():
    found = {
        name: script.configure(script.CircleArgs(estimator=name)).cases for name in ("ukf", "ekf")
    }
    for name, cases in found.items():
        assert {suite.estimator.kind for _, suite in cases.values()} == {name}
