"""Excerpts of real flights: a suite that describes the sensors has no problems, all others do.
Sources and licenses are in tests/data/flights."""

import gzip
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import replay
from quad_gym.estimation.plausibility import MisfitError
from quad_gym.params.suites import ALL_SUITES

FOLDER = Path(__file__).parents[1] / "data" / "flights"
STARTS = {
    "ardupilot": {},
    "rtk_horizontal": {"heading": -2.827},
    "rtk_vertical": {"heading": -2.705},
}
CASES = [(flight, suite) for flight in STARTS for suite in ALL_SUITES]


@cache
def table(flight):
    with gzip.open(FOLDER / f"{flight}.csv.gz", "rt") as file:
        names = file.readline().strip().split(",")
        values = np.genfromtxt(file, delimiter=",")
    return dict(zip(names, values.T, strict=True))


def replayed(flight, sensors):
    return replay(table(flight), sensors=sensors, start=STARTS[flight])


def test_suite_of_the_air_describes_the_flight_of_a_hobby_vehicle():
    """At its own field, far from the default one, and with time stamps that are 0.2 s late."""
    result = replayed("ardupilot", "flown")
    assert result.problems == ()
    assert result.sensors.magnetometer.inclination == pytest.approx(np.radians(-68.6), abs=0.01)
    rejected = [m.rejected.mean() for m in result.measured.values()]
    assert max(rejected) < 0.02


@pytest.mark.parametrize(("flight", "suite"), [c for c in CASES if c != ("ardupilot", "flown")])
def test_wrong_suite_is_named(flight, suite):
    try:
        problems = replayed(flight, suite).problems
    except MisfitError:  # the suite has none of the sensors, exit code 1 as well
        return
    assert problems


def test_estimates_of_the_rtk_flight_fit_with_its_clock_lever_arm_and_noise():
    """Numbers of `quad-gym calibrate` on the whole flight, rounded."""
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
