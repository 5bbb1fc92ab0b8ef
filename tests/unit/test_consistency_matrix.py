"""The matrix of consistency: its cells, a small slice of it, what it marks, and how it resumes."""

import json

import pytest

import quad_gym
from quad_gym.experiments.consistency import cases as runs
from quad_gym.experiments.consistency import matrix
from quad_gym.experiments.consistency.cases import CaseFlights, run_cases
from quad_gym.params.suites import SUITES

SMALL = CaseFlights(64, duration=1.0)


def run(cases, folder, flights=SMALL):
    return run_cases(cases, folder / "matrix", flights, matrix.measure, matrix.table_of)


def chosen(*names):
    found = [cell for cell in matrix.cases_of("all") if cell.name in names]
    assert len(found) == len(names)
    return found


def condition_of(case):
    return case.name.split(", ", 3)[-1]


def test_matrix_has_every_suite_on_every_task_once():
    cells = matrix.cases_of("all")
    names = [cell.name for cell in cells]
    assert len(set(names)) == len(names)
    assert sum(name.endswith(", nominal") for name in names) == len(SUITES) * 6 * 2
    conditions = {condition_of(c) for c in cells if c.name.startswith("rtk, ")}
    assert {"gnss_outage", "camera_occlusion", "two periods late", "lever arm"} <= conditions
    assert "gnss_ramp" not in conditions  # it does not end
    assert "gnss_outage" not in {condition_of(c) for c in cells if c.name.startswith("indoor")}


def test_cells_are_consistent_but_for_the_reports_filter(tmp_path):
    cells = chosen("rtk, hover, warm, nominal", "lab, circle, cold, nominal")
    done = run(cells, tmp_path)
    sound, report = (done[f"{name}, nominal"] for name in ("rtk, hover, warm", "lab, circle, cold"))
    assert 13.0 < sound["values"]["state"] < 17.0  # 3 deviations of the mean of 64 at one instant
    assert report["values"]["state"] > 17.0
    assert report["misses"]
    assert report["expected"] == {"": "the report's filter"}
    written = json.loads((tmp_path / "matrix.json").read_text())
    assert written["seeds"] == [0, 63]
    assert written["cells"][cells[0].name]["sensors"]["imu"]["rate"] == 200.0


def test_run_continues_and_repeats_with_other_flights(tmp_path, monkeypatch):
    flown = []

    def measured(cell, flights):
        flown.append(cell.name)
        return {
            **{"values": {"state": 15.0}, "misses": [], "expected": {}, "filters_failed": 0},
            "sensors": cell.sensors,
        }

    monkeypatch.setattr(matrix, "measure", measured)
    cells = matrix.cases_of("suites")
    run(cells[:2], tmp_path)
    run(cells[:4], tmp_path)
    assert flown == [cell.name for cell in cells[:4]]
    run(cells[:1], tmp_path, CaseFlights(65, duration=1.0))
    assert flown[4:] == [cells[0].name]
    monkeypatch.setattr(runs, "flights_digest", lambda: "of other sources")
    run(cells[:1], tmp_path, CaseFlights(65, duration=1.0))
    assert flown[5:] == [cells[0].name]


@pytest.mark.slow
@pytest.mark.parametrize("start", matrix.STARTS)
@pytest.mark.parametrize("task", ["hover", "circle", "random_trajectory", "waypoints"])
@pytest.mark.parametrize("suite", [name for name in SUITES if name != "lab"])
def test_the_suites_are_consistent_on_the_tasks(suite, task, start):
    """Means over 400 flights of 10 s: 0.8 is 2.9 deviations even if a flight's errors stayed."""
    cell = matrix.case_of(suite, task, start)
    found = matrix.measure(cell, CaseFlights(400))
    assert found["filters_failed"] == 0
    assert 14.2 < found["values"]["state"] < 15.8
    assert cell.sensors == quad_gym.sensor_suite(suite)


@pytest.mark.slow
@pytest.mark.parametrize("start", matrix.STARTS)
@pytest.mark.parametrize("fault", ["gnss_outage", "gnss_outage+camera_occlusion", "baseline_loss"])
def test_default_filter_is_consistent_without_sensors(fault, start):
    """Of 400 flights none may take a feature near a position that is uncertain for a fix."""
    cell = matrix.case_of("standard", "random_trajectory", start, faults=fault)
    found = matrix.measure(cell, CaseFlights(400))
    assert 14.2 < found["values"]["state"] < 15.8
