"""Tables of consistency and recovery: cells, marks, and resumed runs."""

import json
import math

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.commands.consistency import Case, CaseFlights
from quad_gym.commands.options import parse
from quad_gym.faults import GnssJump, GyroBiasStep, PositionJump
from quad_gym.params.suites import SUITES
from scripts.consistency import __main__ as script
from scripts.consistency import causes, compass, evidence, matrix, recovery
from scripts.consistency import tables as runs
from scripts.consistency.recovered import (
    CONSISTENT,
    Recovery,
    follow_recovery,
    measured_coordinates,
)
from scripts.consistency.tables import FLOWN, run_cases, vehicle_of
from tests.field_flights import attitudes, fly, nees

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
    assert sum(name.endswith(", nominal") for name in names) == len(FLOWN) * 6 * 2
    conditions = {condition_of(c) for c in cells if c.name.startswith("rtk, ")}
    assert {"gnss_outage", "camera_occlusion", "two periods late", "lever arm"} <= conditions
    assert "gnss_ramp" not in conditions  # it does not end
    assert "gnss_outage" not in {condition_of(c) for c in cells if c.name.startswith("indoor")}


def test_cells_are_consistent_but_for_the_reports_filter(tmp_path):
    cells = chosen("rtk, hover, warm, nominal", "lab, circle, cold, nominal")
    done = run(cells, tmp_path)
    sound, report = (done[f"{name}, nominal"] for name in ("rtk, hover, warm", "lab, circle, cold"))
    assert 13.0 < sound["values"]["state"] < 17.0  # 3 standard deviations: 64 flights, one instant
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
            "values": {"state": 15.0},
            "misses": [],
            "expected": {},
            "filters_failed": 0,
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
    """For 400 flights of 10 s, 0.8 is 2.9 standard deviations even if errors stay constant."""
    cell = matrix.case_of(suite, task, start)
    found = matrix.measure(cell, CaseFlights(400))
    assert found["filters_failed"] == 0
    assert 14.2 < found["values"]["state"] < 15.8
    assert cell.sensors == quad_gym.sensor_suite(suite)


@pytest.mark.slow
@pytest.mark.parametrize("start", matrix.STARTS)
@pytest.mark.parametrize("fault", ["gnss_outage", "gnss_outage+camera_occlusion", "baseline_loss"])
def test_default_filter_is_consistent_without_sensors(fault, start):
    """No filter of 400 flights may use a feature near its position if the position is uncertain."""
    cell = matrix.case_of("standard", "random_trajectory", start, faults=fault)
    found = matrix.measure(cell, CaseFlights(400))
    assert 14.2 < found["values"]["state"] < 15.8


def flights_of(consistent, flagged, large_error, every=0.5):
    time = every * np.arange(1, len(consistent) + 1)
    found = (np.array(flags, bool) for flags in (consistent, flagged, large_error, consistent))
    return Recovery(time, *found)


def test_long_large_errors_without_a_flag_are_missed_alarms():
    large_error = [[1, 1, 1]] * 4 + [[0, 0, 1]]  # for 2 s, 2 s and 2.5 s
    flagged = [[0, 0, 0]] * 3 + [[0, 1, 0]] + [[0, 0, 0]]
    found = flights_of(np.zeros((5, 3)), flagged, large_error)
    assert found.long_large_error().tolist() == [True, True, True]
    assert found.missed_alarms().tolist() == [True, False, True]
    assert found.alarms() == 1
    assert found.hours == pytest.approx(5 * 3 * 0.5 / 3600.0)


def test_recovery_time_ends_when_99_percent_of_flights_are_consistent():
    consistent = np.ones((8, 100), bool)
    consistent[:3] = consistent[4, 0] = consistent[5, :2] = False  # 1 in 100 is allowed
    found = flights_of(consistent, np.zeros_like(consistent), ~consistent)
    assert found.time_to(found.consistent, 1.0) == pytest.approx(1.0)
    assert found.time_to(found.consistent, 2.5) == pytest.approx(1.0)
    assert found.time_to(found.flagged, 1.0) == math.inf
    assert found.share(found.undetected, 3.0) == pytest.approx(0.02)


def test_flights_that_were_flagged_before_an_instant_do_not_count():
    flagged = np.zeros((4, 3))
    flagged[1, 0] = flagged[2, 1] = True  # after 1.0 and 1.5 s
    found = flights_of(np.ones((4, 3)), flagged, np.zeros((4, 3)))
    assert found.flagged_since(1.0).tolist() == [False, True, False]


def test_a_quantity_counts_as_measured_where_a_sensor_of_the_suite_observes_it():
    found = {name: measured_coordinates(quad_gym.sensor_suite(name)) for name in FLOWN}
    assert found.pop("crazyflie") == [2, 3, 4, 5, 6, 7]  # neither place nor heading
    assert found.pop("uwb") == [0, 1, 2, 3, 4, 5, 6, 7]
    assert all(coordinates == list(range(9)) for coordinates in found.values())


def test_a_remedy_changes_one_sensor():
    for (suite, fault), (sensor, source) in causes.REMEDIES.items():
        found, before = causes.remedied(suite, fault), quad_gym.sensor_suite(suite)
        assert getattr(found, sensor) == getattr(quad_gym.sensor_suite(source), sensor)
        assert getattr(found, sensor) != getattr(before, sensor)
        assert found.replace(**{sensor: getattr(before, sensor)}) == before


JUMP = 0.02  #: size of a jump [m]


def evidence_of_jump(name, suite, fault, duration):
    keywords = {"faults": (fault,)} | vehicle_of(name)
    case = Case(name, suite, "hover", "warm", keywords)
    return evidence.evidence_of(case, seeds=range(128), duration=duration, threads=1)


def test_evidence_of_a_jump_of_positions_is_its_square_over_the_variance_of_an_innovation():
    """Twice the logarithm of the ratio of two normal densities, with mean d^2 and variance 4 d^2.

    There is one position after the jump, and the estimate is known better than its noise.
    """
    suite = quad_gym.sensor_suite("mocap")
    suite = suite.replace(gnss=suite.gnss.replace(phase=0.0, latency=0.0))
    sigma = suite.gnss.position_sigma_I[0]
    fault = GnssJump(start=0.21, size=JUMP, direction=(1.0, 0.0, 0.0))
    found = evidence_of_jump("mocap", suite, fault, 0.22)
    square = (JUMP / sigma) ** 2
    assert abs(found.mean() - square) < 0.15 * square + 6.0 * 2.0 * JUMP / sigma / np.sqrt(128)
    assert found.std() == pytest.approx(2.0 * JUMP / sigma, rel=0.4)


def test_a_horizontal_jump_leaves_no_evidence_for_optical_flow_and_range_finder():
    suite = quad_gym.sensor_suite("crazyflie")
    fault = PositionJump(start=0.5, direction=(1.0, 1.0, 0.0))
    found = evidence_of_jump("crazyflie", suite, fault, 2.0)
    assert np.median(found) < 0.1 * evidence.REQUIRED
    assert (found > evidence.REQUIRED).mean() < 0.02
    upward = PositionJump(start=0.5, direction=(0.0, 0.0, 1.0))
    assert evidence_of_jump("crazyflie", suite, upward, 2.0).min() > 10.0 * evidence.REQUIRED


def test_consistent_flights_and_flags_equal_a_plain_computation():
    batch = fly(
        quad_gym.sensor_suite("rtk"), 64, filter_start="warm", faults=GyroBiasStep(start=0.3)
    )
    found = follow_recovery(batch, seeds=range(64), duration=1.5, every=0.5)
    square = nees(batch, slice(0, 9))
    np.testing.assert_array_equal(found.consistent[-1], square < stats.chi2.ppf(CONSISTENT, 9))
    assert 0.0 < found.share(found.consistent, 1.5) < 1.0
    np.testing.assert_array_equal(found.flagged[-1], batch.record("diverged") > 0.0)
    assert found.time.tolist() == pytest.approx([0.5, 1.0, 1.5])
    with pytest.raises(ValueError, match="at least twice every"):
        follow_recovery(batch, seeds=range(64), duration=0.1, every=0.1)


def test_recovery_table_is_written_with_misses_marked(tmp_path):
    chosen = [t for t in recovery.cases() if t.name in ("rtk, camera_occlusion", "rtk, hover")]
    chosen = [t for t in chosen if t.keywords]  # hovering takes a minute
    how = (recovery.measure, recovery.table_of)
    cells = run_cases(chosen, tmp_path / "recovery", CaseFlights(32), *how)
    values = cells["rtk, camera_occlusion"]["values"]
    assert values["consistent"] >= 90.0
    assert set(values) == set(recovery.COLUMNS)
    assert "| rtk, camera_occlusion | " in (tmp_path / "recovery.md").read_text()
    calm = {"values": {"alarms_per_hour": 0.25, "flagged": 0.01, "hours": 6.0}, "misses": []}
    calm |= {"expected": {}, "filters_failed": 0}
    lost = {"values": dict.fromkeys(recovery.COLUMNS, 5.0), "misses": ["undetected"]}
    lost |= {"expected": {}, "filters_failed": 1}
    rows = {"a": lost, "b": lost | {"expected": {"": "why"}}, "c": calm}
    text = recovery.table_of(rows, CaseFlights(32))
    assert "| **5.0** |" in text.splitlines()[4]
    assert "**1 filters failed**" in text
    assert "| *5.0* |" in text
    assert "| why" in text
    assert "| c | 0.2 | 0.0 | 6.0 |" in text


@pytest.mark.parametrize("what", ["reversed", "none"])
def test_compass_table_compares_filters_with_a_plain_computation(tmp_path, what):
    (case,) = (c for c in compass.cases() if c.name == f"consumer, circle, {what}")
    flights, how = CaseFlights(16, duration=5.0), (compass.measure, compass.table_of)
    cell = run_cases([case], tmp_path / "compass", flights, *how)[case.name]
    values, batch = cell["values"], case.batch(16)
    batch.reset(seeds=range(16))
    worst = np.zeros(16)
    for step in range(1, 1 + round(5.0 * batch.sensors.imu.rate)):
        batch.step()
        if step % round(0.1 * batch.sensors.imu.rate) == 0:
            true, found = attitudes(batch.record("q"))[:, :, 2], batch.record("R_hat")[:, :, 2]
            worst = np.maximum(worst, np.arccos(np.clip((true * found).sum(axis=1), -1.0, 1.0)))
    assert values["worst_tilt"] == pytest.approx(np.degrees(worst.max()), rel=1e-6)
    assert values["tilted"] == pytest.approx(100.0 * np.mean(np.degrees(worst) > 10.0))
    assert ("in_use" in values) == (what != "none")
    if what != "none":
        still = batch.record("compass_out") <= 0.0
        assert values["in_use"] == pytest.approx(100.0 * still.mean())
    assert (cell["misses"] == ["nees"]) == (values["nees"] > compass.MOST_NEES)
    assert f"| {case.name} | " in (tmp_path / "compass.md").read_text()


def tables(capsys, output, *options):
    common = ("--episodes", "48", "--duration", "1.1", "--output", str(output))
    script.main(parse(script.TableArgs, [*options, *common]))
    return capsys.readouterr().out, json.loads((output / f"{options[0]}.json").read_text())


def test_filters_table_compares_forms_of_the_filter(tmp_path, capsys):
    printed, found = tables(capsys, tmp_path, "filters", "--sensors", "indoor")
    rows = found["rows"]
    assert list(rows)[:2] == ["UKF", "EKF"]
    assert all(name in printed for name in rows)
    assert rows["UKF"]["relative_cost"] == 1.0
    whole = rows["UKF, no recursive image update"]["nees_state"]
    assert whole > 1.05 * rows["UKF"]["nees_state"]
