"""The experiment's script: what it prints, what it writes, what it refuses."""

import csv
import json

import numpy as np
import pytest

from quad_gym import pd_gains
from quad_gym.commands import circle as script
from quad_gym.commands.options import parse

pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")

CASES = ("truth", "estimate", "estimate_without_camera")


def run(folder, line=""):
    script.main(parse(script.CircleArgs, [*line.split(), "--output", str(folder)]))
    return json.loads((folder / "summary.json").read_text())


@pytest.fixture
def no_figures(monkeypatch):
    """Leave out the figures, which take most of the time of a short run."""
    monkeypatch.setattr(script, "write_figures", lambda results, setup: [])


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("circle")
    return folder, run(folder, "--episodes 20")


class TestSummary:
    def test_errors_are_those_expected(self, flown):
        cases = flown[1]["cases"]
        mean = {case: cases[case]["tracking_error"]["mean"]["mean"] for case in CASES}
        late = {case: cases[case]["tracking_error"]["last_half"]["mean"] for case in CASES}
        assert 0.109 < mean["truth"] < 0.112
        assert 0.109 < mean["estimate"] < 0.125
        assert 0.110 < mean["estimate_without_camera"] < 0.116
        assert 0.018 < late["truth"] < 0.021
        assert 0.019 < late["estimate"] < 0.026
        estimation = cases["estimate"]["estimation_error"]["last_half"]["mean"]
        assert 0.0025 < estimation < 0.0040

    def test_every_flight_is_counted_once(self, flown):
        for case in flown[1]["cases"].values():
            assert case["finished"] + case["crashed"] + case["filter_failed"] == 20
            assert case["tracking_error"]["mean"]["count"] == case["finished"]

    def test_flights_on_the_truth_are_alike(self, flown):
        truth = flown[1]["cases"]["truth"]
        assert truth["tracking_error"]["mean"]["sd"] == 0.0
        assert "estimation_error" not in truth

    def test_compares_the_cases_seed_by_seed(self, flown):
        pairs = flown[1]["paired_differences_of_mean_tracking_error"]
        found = pairs["estimate_without_camera - truth"]
        low, high = found["interval"]
        assert 0.0 < low < found["spread"]["mean"] < high


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
        want = summary["cases"][case]["tracking_error"]["mean"]["mean"]
        assert np.mean(errors) == pytest.approx(want, rel=1e-9)
        assert all(row["ended_at_s"] == "" for row in finished)


def test_figures_are_those_of_the_report(flown):
    names = {f"{kind}_{case}" for kind in ("path", "height") for case in CASES[1:]}
    names |= {f"error_{case}" for case in CASES} | {"overview"}
    written = {file.name for file in flown[0].iterdir() if file.suffix in (".png", ".svg")}
    assert written == {f"{name}.{ending}" for name in names for ending in ("png", "svg")}


def test_results_do_not_depend_on_batch_or_threads(tmp_path, flown, no_figures):
    one = run(tmp_path / "one", "--seed 3 --episodes 1 --threads 1")
    with (flown[0] / "flights.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for case in CASES:
        want = next(r for r in rows if r["case"] == case and r["seed"] == "3")
        found = one["cases"][case]["tracking_error"]["mean"]
        assert found["mean"] == pytest.approx(float(want["tracking_error_mean_m"]), rel=1e-12)
        assert found["sd"] is None


def test_options_reach_the_flights(tmp_path, no_figures):
    line = "--episodes 2 --duration 1 --radius 2 --gains tuned --velocity-gain 4 --gnss-rate 10"
    configuration = run(tmp_path, f"{line} --bearing-noise-at predicted")["configuration"]
    assert configuration["task"]["radius"] == 2.0
    assert configuration["gains"]["position"] == pd_gains("tuned").position
    assert configuration["gains"]["velocity"] == 4.0
    suite = configuration["sensors"]["estimate"]
    assert (suite["gnss"]["rate"], suite["camera"]["rate"]) == (10.0, 200.0)
    assert suite["estimator"]["bearing_noise_at"] == "predicted"


def test_crashes_are_counted(tmp_path, capsys):
    weak = "--episodes 3 --duration 4 --position-gain 0 --velocity-gain 0 --attitude-gain 0 0 0"
    summary = run(tmp_path, f"--no-camera {weak}")
    for case in summary["cases"].values():
        assert (case["finished"], case["crashed"]) == (0, 3)
    with (tmp_path / "flights.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert {row["ending"] for row in rows} <= {"out_of_bounds", "tipped_over", "below_min_height"}
    assert all(0.0 < float(row["ended_at_s"]) <= 4.0 for row in rows)
    assert "too few flights were completed" in capsys.readouterr().out


def test_recorded_error_is_the_distance_from_the_recorded_reference(tmp_path):
    args = script.CircleArgs(episodes=1, duration=0.5, output=tmp_path)
    trace = script.configure(args).fly("estimate").trace
    distance = np.linalg.norm(trace.position - trace.reference, axis=1)
    np.testing.assert_allclose(trace.error, distance, atol=1e-12)
    assert trace.time[-1] == pytest.approx(0.5)
    np.testing.assert_allclose(trace.heading[0], [-1.0, 0.0], atol=1e-12)
