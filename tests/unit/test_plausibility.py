"""Replays report implausible units and axes, and suites that do not describe the log."""

import json
import math
import re

import numpy as np
import pytest

import quad_gym
from quad_gym.commands.main import main
from quad_gym.estimation import replay
from quad_gym.logs.replaying.results import Severity
from quad_gym.params.magnetometer import MICROTESLA
from quad_gym.rotations import quaternion_to_dcm
from tests.filter_states import at_rest
from tests.logged_flights import PX4, Recorded, flown

SUITE = PX4
RATE, RADIUS, COUNT, DT = 0.4, 3.0, 1000, 0.005


def turntable(count=COUNT, seed=1):
    """Five seconds on a turntable, as in docs/logs.md, with a compass and a barometer."""
    rng, time = np.random.default_rng(seed), DT * np.arange(count)

    def noise(sigma):
        return rng.normal(0.0, sigma, (count, 3))

    angle = RATE * time
    ahead = np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    east, north, up = SUITE.magnetometer.field_I
    sideways = np.stack([-ahead[:, 1], ahead[:, 0], 0.0 * angle], axis=1)
    level = np.array([east, north, 0.0])
    field = np.stack([ahead @ level, sideways @ level, np.full(count, up)], axis=1)
    table = {
        "time": time,
        "gyro": noise(0.002) + np.array([0.0, 0.0, RATE]),
        "accel": noise(0.05) + np.array([0.0, RADIUS * RATE**2, 9.8]),
        "gnss_enu": RADIUS * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        + [0.0, 0.0, SUITE.gnss.primary_antenna_B[2]]
        + noise(0.01),
        "gnss_velocity_enu": RADIUS * RATE * ahead + noise(0.05),
        "barometer": rng.normal(0.0, 0.1, count),
        "magnetometer": field + noise(0.5 * MICROTESLA),
    }
    for name in ("gnss_enu", "gnss_velocity_enu", "barometer", "magnetometer"):
        table[name][np.arange(count) % 20 > 0] = np.nan
    return table


def replayed(table, sensors=SUITE, **options):
    return replay(table, sensors=sensors, start={"course": True}, **options)


def test_a_sound_log_has_no_problems():
    result = replayed(turntable())
    assert result.problems == ()
    assert result.summary()["problems"] == ()
    assert not result.diverged.any()


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("accel", 3.28084, "force is 32.2 m/s^2, 9.8 expected: accelerometer in ft/s^2?"),
        ("accel", 1000 / 9.80665, "9.8 expected: accelerometer in milli-g or cm/s^2?"),
        ("accel", 0.3, "force is 2.9 m/s^2, 9.8 expected: unit or scale of the accelerometer?"),
        ("gyro", 180 / math.pi, "rate is 22.9 rad/s, at most 10 expected: gyro in deg/s?"),
        ("gyro", 1000 / math.pi, "rad/s, gyros measure up to 35 rad/s: gyro in deg/s?"),
        ("magnetometer", 1e4, "field is 0.463 T, 4.63e-05 expected: field in gauss?"),
        ("magnetometer", 1e6, "expected: field in microtesla?"),
        ("magnetometer", 0.01, "expected: unit of the field?"),
        ("barometer", -1e6, "mean barometric height is"),
    ],
)
def test_units_that_are_wrong_are_named(name, change, sentence):
    table = turntable()
    offset = 101_325.0 if name == "barometer" else 0.0
    table[name] = table[name] * change + offset
    assert any(sentence in problem for problem in replayed(table).problems)


@pytest.mark.parametrize(
    ("axes", "body", "sentence"),
    [
        ((1, -1, -1), "flu", "along the body's -z axis, +z expected: body='frd' (--body frd)?"),
        ((1, 1, 1), "frd", "along the body's -z axis, +z expected: body='flu' (--body flu)?"),
    ],
)
def test_axes_of_the_other_frame_are_named(axes, body, sentence):
    table = turntable()
    for name in ("gyro", "accel", "magnetometer"):
        table[name] = table[name] * axes
    assert sentence in replayed(table, body=body).problems[0]
    table = turntable()
    table["accel"] = np.roll(table["accel"], 1, axis=1)
    assert "along the body's +x axis, +z expected: axes of the IMU" in replayed(table).problems[0]


def test_wrong_noise_of_a_suite_is_named_by_sensor():
    table = turntable()
    wrong = np.random.default_rng(2).normal(0.0, 0.5, (COUNT, 3))
    table["gnss_velocity_enu"] = table["gnss_velocity_enu"] + wrong
    sentences = [p for p in replayed(table).problems if "GNSS velocity: NIS per degree" in p]
    assert sentences[0].endswith("rejected: the suite's noise model does not fit this log")


def test_a_bias_that_the_suite_does_not_admit_is_a_note_if_a_sensor_can_have_it():
    table = turntable()
    table["gyro"] = table["gyro"] + [0.0, 0.0, 0.1]
    suite = SUITE.replace(imu=SUITE.imu.replace(gyro_bias_sigma=0.015))
    findings = replayed(table, suite).findings
    (note,) = [f for f in findings if f.text.startswith("gyro: estimated bias")]
    assert note.severity == Severity.NOTE


@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_resets_to_a_compass_find_a_bias_far_beyond_its_prior(seed):
    """Resets of the heading alone repeat: the bias drives the heading off again."""
    table = turntable(4000, seed)
    table["gyro"] = table["gyro"] + [0.0, 0.0, 0.1]
    assert replayed(table).gyro_bias[-1, 2] == pytest.approx(0.1, abs=0.01)


def test_a_verdict_names_the_time_before_a_bias_far_beyond_its_prior_is_found():
    """The suite admits 0.0004 of 0.1 rad/s: the heading is wrong until the bias is found."""
    early, late, right = turntable(2000), turntable(6000), replayed(turntable(6000))
    for table in (early, late):
        table["gyro"] = table["gyro"] + [0.0, 0.0, 0.1]
    result = replayed(late)
    assert result.gyro_bias[-1, 2] == pytest.approx(0.1, abs=0.03)
    overlap = np.abs(np.sum(result.quaternion * right.quaternion, axis=1))
    wrong = np.degrees(2.0 * np.arccos(np.minimum(overlap, 1.0)))
    assert wrong[result.time < 10.0].max() > 10.0
    assert wrong[result.time > 25.0].max() < 3.0
    assert max(finding.severity for finding in replayed(early).findings) > Severity.NOTE
    texts = [f.text for f in result.findings if f.severity == Severity.LOST]
    (lost,) = [text for text in texts if "the filter was wrong before" in text]
    assert float(re.search(r"at about (\S+) s", lost)[1]) < 10.0


def test_a_rejected_outlier_is_no_problem():
    table = turntable()
    table["gnss_enu"][500] += 1000.0
    result = replayed(table)
    assert result.measured["gnss_position"].rejected.sum() == 1
    assert result.summary()["measurements"]["gnss_position"]["mean_nis"] > 100.0
    assert result.problems == ()


def test_a_log_without_gnss_starts_from_a_position_and_a_heading():
    suite = quad_gym.sensor_suite("indoor")
    flight = flown(suite, 4.0)
    table = Recorded(flight, suite).table()
    with pytest.raises(ValueError, match=r"--start-position 0 0 0 --heading 0"):
        replay(table, sensors=suite)
    x_I = quaternion_to_dcm(flight["quaternion"][0])[0]  # the first row of R_BI
    yaw = math.atan2(x_I[1], x_I[0])
    result = replay(table, sensors=suite, start={"position": flight["position"][0], "heading": yaw})
    assert result.problems == ()
    ticks = np.rint(result.time * suite.imu.rate).astype(int)
    errors = np.linalg.norm(result.position - flight["position"][ticks], axis=1)
    assert errors[result.time > 1.0].max() < 0.1
    sigma = suite.initial_pose
    np.testing.assert_allclose(result.sigma[0, :3], sigma.position_sigma)
    np.testing.assert_allclose(result.sigma[0, 8], sigma.heading_sigma)
    with pytest.raises(ValueError, match="nose is not a keyword of a start at a position"):
        replay(table, sensors=suite, start={"position": np.zeros(3), "nose": 1.0})


def test_a_suite_without_the_sensors_of_the_log_is_refused():
    with pytest.raises(ValueError, match="this suite uses no measurement of this log, which has"):
        replay(turntable(), sensors="indoor")
    result = replay(turntable(), sensors="indoor", start=at_rest(covariance=np.eye(15)))
    assert any(p.endswith("which has gnss, barometer, magnetometer") for p in result.problems)


def written(table, file):
    """Write a table as a CSV."""
    columns = {}
    axes = {"gnss_enu": ("gnss_east", "gnss_north", "gnss_up")}
    axes["gnss_velocity_enu"] = tuple(f"gnss_velocity_{a}" for a in ("east", "north", "up"))
    for name, values in table.items():
        if values.ndim == 1:
            columns[name] = values
        else:
            names = axes.get(name) or tuple(f"{name}_{axis}" for axis in "xyz")
            columns.update(zip(names, values.T, strict=True))
    np.savetxt(
        file, np.column_stack(list(columns.values())), "%.9g", ",", header=",".join(columns),
        comments="",
    )  # fmt: skip


def test_the_command_ends_with_the_problems_and_exit_code_1(tmp_path, capsys):
    table = turntable()
    table["accel"] = table["accel"] / 9.80665
    written(table, tmp_path / "flight.csv")
    words = ["replay", str(tmp_path / "flight.csv"), "--sensors", "rtk", "--course", "--no-figure"]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--output", str(tmp_path / "out")])
    assert ended.value.code == 1
    *_, advice = lines = capsys.readouterr().out.splitlines()
    assert "Log: median specific force is 1.0 m/s^2, 9.8 expected: accelerometer in g?" in lines
    assert advice.startswith("Check the units, axes and time stamps")
    found = json.loads((tmp_path / "out" / "replay.json").read_text())
    assert found["problems"][0].startswith("median specific force is 1.0 m/s^2")
    assert set(found["measurements"]["gnss_velocity"]) == {
        "count", "gated", "degrees_of_freedom", "mean_nis", "nis_per_degree_of_freedom",
    }  # fmt: skip
    assert (tmp_path / "out" / "estimates.csv").exists()


def test_the_command_starts_a_log_without_gnss_at_a_position(tmp_path, capsys):
    table = {n: v for n, v in turntable().items() if not n.startswith("gnss")}
    written(table, tmp_path / "flight.csv")
    words = ["replay", str(tmp_path / "flight.csv"), "--sensors", "consumer", "--no-figure"]
    words += ["--output", str(tmp_path / "out"), "--start-position", "3", "0", "0"]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "--start-position must come with --heading or" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:  # no sensor measures the position
        main([*words, "--heading", "90"])
    assert ended.value.code == 1
    rows = np.genfromtxt(tmp_path / "out/estimates.csv", delimiter=",", names=True)
    assert rows["position_x"][0] == 3.0
