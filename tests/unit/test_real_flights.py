"""Excerpts of real flights: a replay reports problems unless the suite describes the sensors.
Sources and licenses are in tests/data/flights."""

import gzip
import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import replay
from quad_gym.params.suites import ALL_SUITES
from tests.console_commands import run

FOLDER = Path(__file__).parents[1] / "data" / "flights"
STARTS = {
    "ardupilot": {},
    "rtk_horizontal": {"heading": -2.827},
    "rtk_vertical": {"heading": -2.705},
}
WORSE = ("consumer", "field")  #: suites of receivers that are worse than RTK
CASES = [(flight, suite) for flight in STARTS for suite in ALL_SUITES]


def fits(flight, suite):
    """True for a suite whose noise is not smaller than the noise of a flight."""
    return suite in WORSE if flight.startswith("rtk") else suite == "field"


def packed(flight):
    return FOLDER / f"{flight}.csv.gz"


@cache
def table(flight):
    with gzip.open(packed(flight), "rt") as file:
        names = file.readline().strip().split(",")
        values = np.genfromtxt(file, delimiter=",")
    return dict(zip(names, values.T, strict=True))


def replayed(flight, sensors):
    return replay(table(flight), sensors=sensors, start=STARTS[flight])


def test_flown_suite_describes_the_ardupilot_flight():
    """The magnetic field is local, far from the default one; time stamps are 0.2 s late."""
    result = replayed("ardupilot", "field")
    assert result.problems == ()
    assert result.sensors.magnetometer.inclination == pytest.approx(np.radians(-68.6), abs=0.01)
    rejected = [m.rejected.mean() for m in result.measured.values()]
    assert max(rejected) < 0.02


@pytest.mark.parametrize("flight", ["rtk_horizontal", "rtk_vertical"])
@pytest.mark.parametrize("suite", WORSE)
def test_suite_of_a_worse_receiver_is_pessimistic_about_the_rtk_flight(flight, suite):
    result = replayed(flight, suite)
    assert result.problems == ()
    assert "pessimistic in GNSS position by a factor of " in result.verdict


WRONG = [
    pytest.param(*case, marks=[pytest.mark.slow] * (case[1] not in ("standard", "indoor")))
    for case in CASES
    if not fits(*case)
]


@pytest.mark.parametrize(("flight", "suite"), WRONG)
def test_command_with_a_wrong_suite_ends_with_a_sentence_and_exit_code_1(flight, suite, tmp_path):
    (tmp_path / "flight.csv").write_bytes(gzip.decompress(packed(flight).read_bytes()))
    start = [f"--{name}={math.degrees(angle)}" for name, angle in STARTS[flight].items()]
    options = ["--sensors", suite, "--no-figure", "--output", "found", *start]
    ended = run("replay", "flight.csv", *options, where=tmp_path)
    assert ended.returncode == 1
    cause = "does not fit this log|dead reckoning|does not explain|a correlation of 0.9"
    cause += "|contradicts the GNSS velocities|run apart"
    pattern = rf"Not usable, because .*({cause})|no measurement"
    assert re.search(pattern, ended.stdout + ended.stderr)


def test_calibrated_suite_describes_the_rtk_flight():
    """The suite has rounded results of `quad-gym calibrate` on the whole flight."""
    rtk = quad_gym.sensor_suite("rtk")
    suite = rtk.replace(
        imu=rtk.imu.replace(
            accel_noise_density=0.08,
            accel_bias_sigma=0.2,
            gyro_noise_density=0.001,
            gyro_bias_sigma=0.005,
        ),
        gnss=rtk.gnss.replace(
            primary_antenna_B=(0.08, 0.09, 0.23),
            position_sigma_I=(0.01, 0.01, 0.02),
            drift_sigma_I=(0.04, 0.04, 0.06),
            drift_tau=0.6,
        ),
        log_delays=rtk.log_delays.replace(gnss=-0.1),
    )
    result = replayed("rtk_horizontal", suite)
    assert result.problems == ()
    fixes = result.measured["gnss_position"]
    assert 0.2 < fixes.nis.mean() / 3.0 < 1.5
