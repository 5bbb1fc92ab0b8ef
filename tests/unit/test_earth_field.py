"""The Earth's magnetic field, and where a suite moves with a log."""

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import replay
from quad_gym.estimation.earth_field import at_place, earth_field
from quad_gym.frames import geodetic_to_ecef

# latitude, longitude [deg], height [km], year; north, east, down [nT]: of pygeomag 1.1.0, which
# reproduces the test values of the World Magnetic Model 2025
PLACES = [
    (-37.87, 144.676, 0.0, 2027.5, 21195.0, 4454.7, -55950.1),
    (30.29, -97.74, 0.17, 2027.5, 23980.8, 1261.1, 39354.3),
    (89.9, 10.0, 5.0, 2027.5, 1615.8, 876.9, 56781.8),
    (-80.0, 240.0, 100.0, 2027.5, 5984.0, 14760.1, -49317.7),
    (45.0, 120.0, 2.0, 2027.5, 24304.4, -4247.6, 50947.1),
]


def place(latitude, longitude, height=0.0):
    return geodetic_to_ecef(np.radians(latitude), np.radians(longitude), 1e3 * height)


@pytest.mark.parametrize("row", PLACES)
def test_field_is_that_of_another_implementation(row):
    latitude, longitude, height, year, north, east, down = row
    field = 1e9 * earth_field(place(latitude, longitude, height), year)
    np.testing.assert_allclose(field, [east, north, -down], atol=0.1)


def test_default_field_is_the_model_at_the_laboratory():
    field = earth_field(np.array(quad_gym.GnssParams().reference_antenna_G))
    np.testing.assert_allclose(quad_gym.MagnetometerParams().field_I, field, rtol=0.002)


def test_suite_that_moves_takes_the_field_of_the_place():
    melbourne = place(-37.87, 144.676)
    moved = at_place(quad_gym.sensor_suite("consumer"), melbourne)
    np.testing.assert_allclose(moved.magnetometer.field_I, earth_field(melbourne), rtol=1e-12)
    assert moved.gnss.reference_antenna_G == tuple(melbourne)


def test_suite_that_moves_keeps_a_field_that_a_user_gave():
    suite = quad_gym.sensor_suite("consumer")
    compass = suite.magnetometer.replace(declination=0.4)
    moved = at_place(suite.replace(magnetometer=compass), place(-37.87, 144.676))
    assert moved.magnetometer == compass


def test_replay_far_from_the_laboratory_has_the_field_there():
    count, spot = 400, place(47.4, 8.5)
    field = earth_field(spot)
    time = 0.005 * np.arange(count)
    still = np.tile([0.0, 0.0, 0.0], (count, 1))
    heading_east = np.array([field[0], field[1], field[2]])  # nose to the east
    table = {
        "time": time,
        "gyro": still,
        "accel": still + np.array([0.0, 0.0, 9.8]),
        "gnss": still + spot,
        "magnetometer": still + heading_east,
    }
    for name in ("gnss", "magnetometer"):
        table[name][np.arange(count) % 20 > 0] = np.nan
    result = replay(table, sensors="consumer")
    np.testing.assert_allclose(result.quaternion[-1], [1.0, 0.0, 0.0, 0.0], atol=2e-3)
    assert not result.problems
