"""The verdict on a replay, by quantity, on simulated flights with known faults."""

import math
import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

from quad_gym.estimation import calibrate, replay, smooth
from quad_gym.logs.calibrating import calibration
from quad_gym.logs.formats import Log, Stream
from quad_gym.logs.replaying import rules
from quad_gym.logs.replaying.results import (
    QUANTITIES,
    Finding,
    InnovationSeries,
    Severity,
    by_quantity,
    exceeds,
    fit_of,
    larger,
    rejected_for_their_size,
    runs_beyond_chance,
)
from quad_gym.logs.replaying.rules import HORIZONS, changes
from quad_gym.logs.replaying.verdict import RULES, in_one_line
from quad_gym.records import GateDecision
from quad_gym.rotations import euler_to_dcm
from tests import foreign_logs
from tests.statistical import verdicts

NAME = "consumer"


@cache
def flight():
    return next(iter(verdicts.flown(NAME, 1, seed=7)))


def judged(change):
    return verdicts.judged(NAME, change, *flight(), seed=0)[0]


def disturb(table, wrong):
    """Make positions or velocities of a table wrong from 20 to 32 s."""
    name = "gnss_enu" if wrong == "positions" else "gnss_velocity_enu"
    since = table["time"] - 20.0
    inside = verdicts.rows(table, name) & (since > 0.0) & (since < 12.0)
    gain = since[inside] if wrong == "positions" else np.ones(inside.sum())
    table[name][inside] += np.outer(gain, [1.5, 1.0, 0.0])


def of(result, quantity):
    return [f for f in result.findings if f.quantity == quantity]


def test_a_flight_without_a_fault_is_usable_in_every_quantity():
    result = judged(verdicts.nothing)
    assert [re.split(r"[;\n]", line)[0] for line in by_quantity(result.findings)] == [
        f"{quantity}: usable" for quantity in ("position", "height", "attitude", "heading")
    ]
    assert result.verdict.startswith("usable: NIS per degree of freedom ")


def test_several_findings_are_a_list():
    findings = [
        Finding(quantity="height", severity=Severity.UNCERTAIN, text="first"),
        Finding(quantity="heading", severity=Severity.NOTE, text="one"),
        Finding(quantity="height", severity=Severity.LOST, text="second"),
    ]
    assert "\n".join(by_quantity(findings)).splitlines() == [
        "position: usable",
        "height: not usable",
        "  - first",
        "  - second",
        "attitude: usable",
        "heading: usable; one",
    ]


def test_a_heading_that_nothing_shows_is_uncertain():
    still = foreign_logs.flight(6.0, rest=100.0).table()
    del still["magnetometer"]
    (heading,) = of(replay(still, sensors=NAME), "heading")
    assert heading.severity == Severity.UNCERTAIN
    assert "unknown until the end" in heading.text


@pytest.mark.parametrize("change", [verdicts.ramp, verdicts.jump])
def test_gnss_that_drifts_or_jumps_makes_the_position_unusable(change):
    result = judged(change)
    worst = [f.text for f in of(result, "position") if f.severity == Severity.LOST]
    assert any("which the IMU does not explain" in text or "rejected for" in text for text in worst)
    assert result.verdict.startswith("not usable, because position: ")


@pytest.mark.parametrize(
    ("wrong", "right"), [("positions", "velocities"), ("velocities", "positions")]
)
def test_the_imu_shows_which_of_positions_and_velocities_is_wrong_for_some_time(wrong, right):
    def change(table, rng, suite):
        disturb(table, wrong)

    result, error = verdicts.judged(NAME, change, *flight(), seed=0)
    assert not result.problems
    assert any(f"{right}, so that the {wrong} are left out" in f.text for f in result.findings)
    assert error < 3.0


def test_smoothing_and_calibration_leave_out_the_same_positions(monkeypatch):
    """The calibration ends where its search would begin."""
    log, truth = flight()
    table = {name: column.copy() for name, column in log.items()}
    disturb(table, "positions")
    reading = {"from_": 12.0, "until": 36.0}
    smoothed = smooth(table, sensors=NAME, **reading)
    assert any("so that the positions are left out" in note for note in smoothed.notes)
    assert verdicts.position_errors(smoothed, truth).max() < 3.0
    searched = []

    def stop(*flight):
        searched.append(flight[0])
        raise InterruptedError

    monkeypatch.setattr(calibration, "turn_on_biases", stop)
    with pytest.raises(InterruptedError):
        calibrate(table, sensors=NAME, share=0.95, **reading)
    stamps, (place,) = (
        searched[0].gnss.time,
        (
            value
            for name, value in searched[0].gnss.values.items()
            if name.startswith("gnss_position_")
        ),
    )
    known = np.isfinite(place).all(axis=1)
    assert not known[(stamps > 21.0) & (stamps < 31.0)].any()
    assert known[stamps < 19.0].mean() > 0.9


def test_gnss_that_drifts_while_a_camera_holds_the_position_is_a_problem():
    log, truth = next(iter(verdicts.flown("rtk", 1, seed=7)))
    result, error = verdicts.judged("rtk", verdicts.ramp, log, truth, seed=0)
    assert error < 0.1
    assert any("GNSS position rejected for" in problem for problem in result.problems)


@pytest.mark.parametrize(("stop", "usable"), [(35.0, True), (60.0, False)])
def test_errors_after_the_motors_have_stopped_do_not_count(stop, usable):
    def change(table, rng, suite):
        time = table["time"]
        table["gnss_enu"][time > 36.0] += (300.0, 0.0, 0.0)
        table["motors"] = np.where(time[:, np.newaxis] < stop, 5.0, 0.0) * np.ones(4)

    assert bool(judged(change).problems) != usable


def test_measurements_of_another_clock_are_named_with_the_difference():
    log, _ = flight()
    table = log | {"time": np.where(np.isfinite(log["gyro"][:, 0]), log["time"], log["time"] - 1.5)}
    result = replay(table, sensors=NAME)
    (text,) = (f.text for f in of(result, "height") if "clocks" in f.text)
    assert "all by about 1.50 s: the clocks differ, use log_delays.barometer = -1.50" in text
    assert any("nothing corrects it for 4" in p for p in result.problems)


@pytest.mark.parametrize("skew", [0.0, 0.008])
def test_clocks_that_run_apart_are_named_with_their_ratio(skew):
    """The IMU's clock is slower by `skew`, so its stamps need the factor 1 / (1 - skew)."""
    log, _ = flight()
    result = replay(log, sensors=NAME)
    own = np.isfinite(log["gyro"][:, 0])
    imu = Stream(log["time"][own], log["time"][own], {n: log[n][own] for n in ("gyro", "accel")})
    fixes = np.isfinite(log["gnss_velocity_enu"][:, 0])
    stamps = log["time"][fixes] / (1.0 - skew)
    gnss = Stream(stamps, stamps, {"gnss_velocity_I": log["gnss_velocity_enu"][fixes]})
    case = SimpleNamespace(log=SimpleNamespace(imu=imu, gnss=gnss), result=result)
    found = [*rules.clocks(case)]
    assert bool(found) == (skew > 0.0)
    for finding in found:
        assert finding.severity == Severity.LOST
        ratio = float(re.search(r"stamps of the IMU by ([0-9.]+)", finding.text)[1])
        assert ratio == pytest.approx(1.0 / (1.0 - skew), abs=0.0015)


def test_stamps_that_step_back_are_named_with_their_time():
    log, _ = flight()
    late = np.isfinite(log["gnss_enu"][:, 0]) & (log["time"] > 30.0)
    result = replay(log | {"time": np.where(late, log["time"] - 1.0, log["time"])}, sensors=NAME)
    (text,) = (f.text for f in of(result, "position") if "step back" in f.text)
    assert re.search(
        r"all from 3[01]\.\d s on, by about 1\.\d\d s: the time stamps step back", text
    )


@pytest.mark.parametrize(("begin", "end"), [(44.0, 60.0), (20.0, 27.0)])
def test_a_receiver_that_is_refused_to_the_end_or_for_a_tenth_of_a_log_is_lost(begin, end):
    """It is 150 m away from one fix to the next, which the filter refuses in a row."""

    def change(table, rng, suite):
        wrong = (table["time"] > begin) & (table["time"] < end)
        table["gnss_enu"][wrong] += (150.0, 0.0, 0.0)

    result = judged(change)
    assert result.verdict.startswith("not usable, because position: ")
    assert any("GNSS position rejected for" in problem for problem in result.problems)


@pytest.mark.parametrize("pause", [False, True])
def test_a_log_without_a_position_is_not_usable_however_short_its_parts_are(pause):
    """Seven seconds, or three parts of seven, in which nothing corrects the position."""
    table = foreign_logs.flight(21.0 if pause else 7.0).table()
    kept = (table["time"] % 7.0 < 5.0) if pause else np.ones(len(table["time"]), bool)
    table = {k: v[kept] for k, v in table.items() if not k.startswith("gnss")}
    start = {"position": (0.0, 0.0, 0.0), "heading": 0.0}
    result = replay(table, sensors="field", start=start)
    (text,) = (f.text for f in of(result, "position") if f.severity == Severity.LOST)
    flown = 15 if pause else 7
    assert re.fullmatch(rf"nothing corrects it for {flown} s, the whole log: .*", text)


def test_a_start_that_the_flight_contradicts_is_said():
    """A given place that is off by 10 m, and IMU and compass that lean by 20 degrees."""
    log, truth = flight()
    place = truth["position"][0] + [8.0, -6.0, 0.0]
    start = {"position": place, "heading": math.pi / 2.0}
    result = replay(log, sensors=NAME, start=start)
    assert any(
        re.search(r"given position at the start contradicts .* by about (9|1[01])\.?\d* m:", text)
        for text in result.problems
    )
    fast = int(np.argmax(np.linalg.norm(truth["velocity"], axis=1)))
    since, speed = truth["time"][fast], float(np.linalg.norm(truth["velocity"][fast]))
    w, x, y, z = truth["quaternion"][fast]
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    start = {"position": truth["position"][fast], "heading": heading}
    result = replay(log, sensors=NAME, start=start, from_=since, until=since + 8.0)
    (text,) = (text for text in result.problems if "velocity at the start contradicts" in text)
    found = float(re.search(r"about ([\d.]+) m/s: the vehicle is not at rest", text)[1])
    assert found == pytest.approx(speed, rel=0.3)
    lean = euler_to_dcm((0.35, 0.0, 0.0))
    leaning = {n: log[n] @ lean.T for n in ("gyro", "accel", "magnetometer")}
    result = replay(log | leaning, sensors=NAME)
    (text,) = (f.text for f in of(result, "attitude") if "roll and pitch at the start" in f.text)
    assert 17 <= int(re.search(r"about (\d+) degrees", text)[1]) <= 23


def test_a_wrong_given_heading_comes_before_the_innovations_that_it_enlarges():
    log, truth = flight()
    log = {name: values for name, values in log.items() if name != "magnetometer"}
    first = int(np.searchsorted(truth["time"], 12.0))
    w, x, y, z = truth["quaternion"][first]
    heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    result = replay(log, sensors=NAME, start={"heading": heading + 0.5}, from_=12.0)
    assert re.search(r"because heading: the given heading .* by about 2\d degrees", result.verdict)
    names = [rule.find for rule in RULES]
    assert names.index(rules.given_heading) < names.index(rules.misfits)


def test_an_outage_of_twelve_seconds_is_dead_reckoning_and_one_of_six_is_not():
    assert any("dead reckoning" in p for p in judged(verdicts.silence).problems)
    assert not judged(verdicts.outage).problems


def test_a_compass_that_turns_makes_the_heading_unusable():
    assert any(f.severity == Severity.LOST for f in of(judged(verdicts.compass), "heading"))


@pytest.mark.parametrize("change", [verdicts.outliers, verdicts.biases, verdicts.vibration])
def test_disturbances_that_a_filter_withstands_are_no_problem(change):
    assert not judged(change).problems


def test_noise_that_is_assumed_too_large_is_pessimistic_and_no_problem():
    result = judged(verdicts.pessimism)
    assert not result.problems
    assert "pessimistic in GNSS position by a factor of " in result.verdict
    assert any("a calibration finds the noise" in f.text for f in of(result, "log"))


def test_accuracy_that_a_receiver_reports_is_not_called_pessimistic():
    log, _ = flight()
    fixes = np.isfinite(log["gnss_enu"])
    result = replay(log | {"gnss_sigma": np.where(fixes, 6.0, np.nan)}, sensors=NAME)
    assert not result.problems
    assert "pessimistic in GNSS position" not in result.verdict
    (text,) = (f.text for f in result.findings if "the receiver reports" in f.text)
    assert text.startswith("GNSS position: innovations are ")


def test_noise_of_a_barometer_makes_the_height_uncertain_only():
    log, _ = flight()
    heights = log["barometer"] + np.random.default_rng(1).normal(0.0, 0.3, len(log["time"]))
    result = replay(log | {"barometer": heights}, sensors=NAME)
    assert [f.severity for f in of(result, "height")] == [Severity.UNCERTAIN]
    assert "barometer: NIS per degree of freedom" in of(result, "height")[0].text
    assert not result.problems


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The filter kept its last good state")  # of gyros in deg/s
@pytest.mark.parametrize("faulty", [False, True])
def test_verdicts_on_sixty_flights_are_wrong_three_times_at_most(faulty):
    kinds = verdicts.FAULTS if faulty else verdicts.HARMLESS
    wrong = list(verdicts.run(verdicts.cases(kinds, 60), faulty))
    assert len(wrong) <= 3, wrong


def test_a_share_exceeds_its_limit_as_often_as_the_test_says():
    """Of independent cases at the limit, at most 5 % are rejected, and nearly all at its double."""
    rng = np.random.default_rng(0)
    at, above = ([exceeds(rng.random(300) < p, 0.1) for _ in range(400)] for p in (0.1, 0.2))
    assert np.mean(at) < 0.08
    assert np.mean(above) > 0.95


def test_runs_of_rejections_are_those_that_independent_outliers_hardly_have():
    """Of logs with independent outliers, one in a thousand has such a run."""
    rng = np.random.default_rng(3)
    for share in (0.03, 0.2):
        found = [bool(runs_beyond_chance(rng.random(400) < share, 1e-3)) for _ in range(1500)]
        assert np.mean(found) < 0.005
    rejected = rng.random(400) < 0.03
    rejected[348:] = True
    assert runs_beyond_chance(rejected, 1e-3)[-1] == pytest.approx((348, 399), abs=2)
    half = np.arange(100) >= 50
    assert runs_beyond_chance(half, 1e-3) == [(50, 99)]


def test_repeated_cases_are_no_further_evidence():
    rng = np.random.default_rng(1)
    hits = [np.repeat(rng.random(30) < 0.1, 20) for _ in range(200)]
    assert np.mean([exceeds(each, 0.1) for each in hits]) < 0.12


def test_outliers_do_not_make_innovations_larger():
    nis = chi2.rvs(3, size=500, random_state=2)
    nis[:100] *= 1e4
    assert not larger(nis, 3, 4.0)
    assert larger(6.0 * nis, 3, 4.0)


def measured(innovation, rejected):
    gate = np.where(rejected, GateDecision.REJECTED, GateDecision.ACCEPTED)
    time = np.arange(len(innovation), dtype=float)
    nis = (innovation**2).sum(axis=1)
    return InnovationSeries(time, time, innovation, np.ones_like(innovation), nis, gate)


def test_mean_nis_is_per_degree_of_freedom_and_includes_rejected_measurements():
    innovation = np.array([[1.0, 0.0], [0.0, 1.0], [3.0, 3.0], [1.0, 1.0]])
    fit = fit_of(measured(innovation, [False, False, True, False]))
    assert fit.mean_nis == pytest.approx((1.0 + 1.0 + 18.0 + 2.0) / 4.0 / 2.0)
    assert fit.rejected == 0.25


def test_measurements_within_the_gate_are_not_rejected_for_their_size():
    """The limit for 1 % and two degrees of freedom is -2 log(0.01) = 9.21."""
    innovation = np.array([[3.0, 0.0], [3.1, 0.0], [3.1, 0.0]])
    own = rejected_for_their_size(measured(innovation, [True, True, False]), 0.01)
    assert own.rejected.tolist() == [False, True, False]
    assert own.gated.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("times", "severity"),
    [(1.3, None), (1.55, Severity.UNCERTAIN), (1.85, Severity.UNCERTAIN), (2.2, Severity.LOST)],
)
def test_errors_of_twice_the_assumed_ones_make_a_log_unusable(times, severity):
    """Limits of the standard deviations are 2 (lost) and its root (uncertain). The statistics of
    2,000 measurements vary by a few percent."""
    errors = times * np.random.default_rng(5).normal(size=(2000, 3))
    case = measured(errors, np.zeros(2000, bool))
    fit = fit_of(case)
    fits = SimpleNamespace(fits={"gnss_velocity": fit})
    found = [finding.severity for finding in rules._size(fits, "gnss_velocity", case, fit)]
    assert found == ([] if severity is None else [severity])


def test_the_estimate_changes_by_what_is_added_to_it():
    """A vehicle on a circle, exactly as its IMU has it, with a step of position or of heading."""
    rate, radius, dt = 0.8, 2.0, 0.005
    time = dt * np.arange(4001)
    result = judged(verdicts.nothing)
    c, s, zero = np.cos(rate * time), np.sin(rate * time), 0.0 * time
    gyro = np.tile([0.0, 0.0, rate], (len(time), 1))
    accel = np.tile([0.0, radius * rate**2, 9.80665], (len(time), 1))
    half = 0.5 * (rate * time + 0.5 * math.pi)  # the nose is ahead
    sigma = np.tile(np.repeat([0.1, 0.1, 0.01, 0.01, 0.001], 3), (len(time), 1))
    exact = replace(
        result,
        time=time,
        position=radius * np.stack([c, s, zero], axis=1),
        velocity=radius * rate * np.stack([-s, c, zero], axis=1),
        quaternion=np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1),
        accel_bias=np.zeros((len(time), 3)),
        gyro_bias=np.zeros((len(time), 3)),
        sigma=sigma,
    )
    log = Log(imu=Stream(time, time, {"gyro": gyro, "accel": accel}))
    found, count = changes(log, exact, 5.0)
    assert count > 0
    assert max(each.ratio for each in found) < 0.05
    moved = exact.position + np.where(time > 12.0, 3.0, 0.0)[:, np.newaxis] * [1.0, 0.0, 0.0]
    sizes = {c.quantity: c.size for c in changes(log, replace(exact, position=moved), 5.0)[0]}
    assert sizes["position"] == pytest.approx(3.0, rel=1e-2)
    turned = half + np.where(time > 12.0, 0.1, 0.0)
    quaternion = np.stack([np.cos(turned), zero, zero, np.sin(turned)], axis=1)
    found, _ = changes(log, replace(exact, quaternion=quaternion), 5.0)
    (heading,) = (each for each in found if each.quantity == "heading")
    assert heading.size == pytest.approx(0.2, rel=1e-2)
    assert abs(heading.time - 12.0) <= max(HORIZONS)


def test_a_line_names_the_first_problem_or_the_worst_sensors():
    lost = Finding(quantity="heading", severity=Severity.LOST, text="turned")
    doubtful = [replace(lost, quantity=q, severity=Severity.UNCERTAIN) for q in QUANTITIES[1::-1]]
    fits = {
        name: fit_of(measured(size * np.ones((5, 1)), np.zeros(5, bool)))
        for name, size in (("gnss_position", 0.5), ("barometer", 1.1))
    }
    assert in_one_line([lost], fits) == "not usable, because heading: turned"
    assert in_one_line(doubtful, fits).startswith(
        "usable with reservations: position, height; NIS per degree of freedom 0.25 to 1.2"
    )
    assert in_one_line([], fits) == (
        "usable: NIS per degree of freedom 0.25 to 1.2, pessimistic in GNSS position by a factor "
        "of 2.0"
    )
