"""Rules of the verdict that need physics alone: the field, axes, the start, samples of the IMU."""

import math

import numpy as np
import pytest

from quad_gym.estimation import replay
from quad_gym.logs.replaying.results import Severity
from quad_gym.rotations import euler_to_dcm
from tests import foreign_logs


@pytest.fixture(scope="module")
def table():
    return foreign_logs.flight(30.0).table()


def found(table, words, **options):
    """Findings of a replay that have some words."""
    result = replay(table, sensors="field", **options)
    return [f for f in result.findings if words in f.text]


def test_flight_without_damage_has_no_such_finding(table):
    result = replay(table, sensors="field")
    for words in ("axes of the magnetometer", "magnetic field", "heading at the start", "pause"):
        assert not [f for f in result.findings if words in f.text and f.severity > Severity.NOTE]
    assert result.problems == ()


@pytest.mark.parametrize("degrees", [45, 90, 180, -90])
@pytest.mark.parametrize("names", [("magnetometer",), ("gyro", "accel")])
def test_axes_that_differ_are_named_with_their_angle(table, degrees, names):
    """A compass turned about the vertical axis, or an IMU turned the other way."""
    angle = math.radians(degrees if len(names) == 1 else -degrees)
    R = euler_to_dcm((0.0, 0.0, angle))
    turned = table | {name: table[name] @ R.T for name in names}
    (finding,) = found(turned, "axes of the magnetometer and the IMU differed by")
    assert finding.severity == Severity.LOST
    assert f"{abs(degrees)} degrees about the vertical axis" in finding.text


def test_compass_on_its_side_is_named_with_its_axes(table):
    field = table["magnetometer"][:, [1, 2, 0]]
    (finding,) = found(table | {"magnetometer": field}, "axes of the magnetometer and the IMU")
    assert "a rotation that makes (x, y, z) to (" in finding.text


def test_field_that_jumps_for_some_seconds_is_named_with_its_times(table):
    """20 uT along the body's x axis, as by a power line."""
    field = table["magnetometer"].copy()
    near = (table["time"] > 12.0) & (table["time"] < 20.0)
    field[near] += (20e-6, 0.0, 0.0)
    (finding,) = found(table | {"magnetometer": field}, "the magnetic field jumps by")
    assert finding.severity == Severity.UNCERTAIN
    assert "until 20." in finding.text or "until 19." in finding.text


def test_one_wrong_field_is_no_jump(table):
    field = table["magnetometer"].copy()
    rows = np.flatnonzero(np.isfinite(field[:, 0]))
    field[rows[200]] += (30e-6, 0.0, 0.0)
    assert not found(table | {"magnetometer": field}, "the magnetic field jumps by")


def test_strength_of_the_field_that_changes_for_seconds_is_named(table):
    field = table["magnetometer"].copy()
    time = table["time"]
    share = 0.6 * np.exp(-(((time - 18.0) / 3.0) ** 2))
    field *= 1.0 + share[:, np.newaxis]
    (finding,) = found(table | {"magnetometer": field}, "the strength of the magnetic field")
    assert finding.severity == Severity.UNCERTAIN


@pytest.mark.parametrize("pauses", [0, 3])
def test_pauses_of_the_imu_are_counted(table, pauses):
    gone = np.zeros(len(table["time"]), bool)
    for k in range(pauses):
        gone |= (table["time"] > 10.0 + 5.0 * k) & (table["time"] < 10.8 + 5.0 * k)
    gone &= np.isfinite(table["gyro"][:, 0])
    texts = [f.text for f in found({k: v[~gone] for k, v in table.items()}, "the IMU has")]
    wanted = [f"the IMU has {pauses} pauses of up to 0.8"] if pauses else []
    assert [text[: len(wanted[0])] for text in texts] == wanted


def test_half_of_the_samples_of_an_imu_that_are_lost_are_counted(table):
    lost = np.random.default_rng(0).random(len(table["time"])) < 0.4
    gone = lost & np.isfinite(table["gyro"][:, 0])
    (finding,) = found({k: v[~gone] for k, v in table.items()}, "of the IMU's samples")
    assert finding.severity == Severity.NOTE
    assert int(finding.text.split("about ")[1].split()[0]) == pytest.approx(40, abs=6)


def test_heading_from_north_that_is_given_as_from_east_is_named(table):
    """The true heading is 0.3 rad from east, the given one its complement."""
    flown = {k: v for k, v in foreign_logs.flight(60.0).table().items() if k != "magnetometer"}
    (finding,) = found(flown, "at the start", start={"heading": 0.5 * math.pi - 0.3})
    assert finding.severity == Severity.LOST
    assert "--heading-from-north" in finding.text
    assert not found(flown, "heading at the start", start={"heading": 0.3})


def test_positions_that_drift_for_some_seconds_do_not_cost_the_velocities(table):
    """They drift by 2 m/s for eight seconds, and the velocities stay correct."""
    since = np.clip(table["time"] - 14.0, 0.0, 8.0)[:, np.newaxis]
    places = table["gnss_enu"] + 2.0 * since * [1.0, 0.0, 0.0]
    result = replay(table | {"gnss_enu": places}, sensors="field")
    assert "gnss_velocity" in result.measured
    assert not any("velocities contradict" in problem for problem in result.problems)
