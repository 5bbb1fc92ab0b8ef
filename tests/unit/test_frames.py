"""Earth frames and the magnetic field against geometry, published numbers and other code."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import quad_gym
from quad_gym.estimation import replay
from quad_gym.frames import ecef_to_enu, ecef_to_geodetic, geodetic_to_ecef
from quad_gym.logs.formats.earth_field import at_place, earth_field

EQUATOR, POLE = 6378137.0, 6356752.314245179  # WGS-84 semi-axes [m]

reduced_latitudes = st.floats(-1.57, 1.57)
longitudes = st.floats(-np.pi, np.pi)
heights = st.floats(-1e4, 1e6)


def place(reduced_latitude, longitude, height):
    """Return a point at a height above the ellipsoid, and the outward normal below the point."""
    c, s = np.cos(reduced_latitude), np.sin(reduced_latitude)
    foot = np.array([EQUATOR * c * np.cos(longitude), EQUATOR * c * np.sin(longitude), POLE * s])
    gradient = foot / np.array([EQUATOR, EQUATOR, POLE]) ** 2
    normal = gradient / np.linalg.norm(gradient)
    return foot + height * normal, normal


@given(reduced_latitudes, longitudes, heights)
def test_up_is_the_normal_of_the_ellipsoid(latitude, longitude, height):
    r_G, normal = place(latitude, longitude, height)
    np.testing.assert_allclose(ecef_to_enu(r_G)[2], normal, rtol=0.0, atol=1e-14)


@given(reduced_latitudes, longitudes, heights)
def test_axes_form_a_right_handed_frame_with_east_along_the_parallel(latitude, longitude, height):
    r_G, _ = place(latitude, longitude, height)
    R_IG = ecef_to_enu(r_G)
    np.testing.assert_allclose(R_IG @ R_IG.T, np.eye(3), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(np.cross(R_IG[0], R_IG[1]), R_IG[2], rtol=0.0, atol=1e-15)
    east = (
        place(latitude, longitude + 1e-4, height)[0] - place(latitude, longitude - 1e-4, height)[0]
    )
    north = place(latitude + 1e-4, longitude, 0.0)[0] - place(latitude - 1e-4, longitude, 0.0)[0]
    np.testing.assert_allclose(R_IG[0], east / np.linalg.norm(east), rtol=0.0, atol=3e-7)
    np.testing.assert_allclose(R_IG[1], north / np.linalg.norm(north), rtol=0.0, atol=1e-7)


@given(reduced_latitudes, longitudes, heights)
def test_ecef_to_geodetic_recovers_the_position(latitude, longitude, height):
    r_G, normal = place(latitude, longitude, height)
    lat, lon, h = ecef_to_geodetic(r_G)
    assert lat == pytest.approx(np.arcsin(np.clip(normal[2], -1, 1)), abs=1e-7)
    np.testing.assert_allclose(
        [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], normal, atol=1e-14
    )
    assert h == pytest.approx(height, abs=1e-8)


def test_geodetic_coordinates_match_published_example():
    # the worked example of IOGP guidance note 7-2, method 9602
    lat, lon, height = ecef_to_geodetic([3771793.968, 140253.342, 5124304.349])
    assert np.degrees(lat) == pytest.approx(53 + 48 / 60 + 33.820 / 3600, abs=2e-8)
    assert np.degrees(lon) == pytest.approx(2 + 7 / 60 + 46.380 / 3600, abs=2e-8)
    assert height == pytest.approx(73.0, abs=2e-3)


@pytest.mark.parametrize(
    ("r_G", "axes"),
    [
        ([EQUATOR, 0.0, 0.0], [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        ([0.0, EQUATOR, 0.0], [[-1, 0, 0], [0, 0, 1], [0, 1, 0]]),
        ([0.0, 0.0, POLE], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        ([0.0, 0.0, -POLE], [[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    ],
)
def test_axes_at_equator_and_poles_have_known_directions(r_G, axes):
    np.testing.assert_allclose(ecef_to_enu(r_G), axes, rtol=0.0, atol=1e-15)
    assert ecef_to_geodetic(r_G)[2] == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize(
    "bad", [[1.0, 2.0], 0.0, "Austin", [np.nan, 0.0, EQUATOR], [0.0, 0.0, 5e5], None]
)
def test_invalid_ecef_position_raises_value_error_with_its_name(bad):
    with pytest.raises(ValueError, match=r"^r_G must"):
        ecef_to_geodetic(bad)
    with pytest.raises(ValueError, match=r"^r0_G must"):
        ecef_to_enu(bad)


# latitude, longitude [deg], height [km], year; north, east, down [nT] by pygeomag 1.1.0, which
# reproduces the test values of the World Magnetic Model 2025
PLACES = [
    (-37.87, 144.676, 0.0, 2027.5, 21195.0, 4454.7, -55950.1),
    (30.29, -97.74, 0.17, 2027.5, 23980.8, 1261.1, 39354.3),
    (89.9, 10.0, 5.0, 2027.5, 1615.8, 876.9, 56781.8),
    (-80.0, 240.0, 100.0, 2027.5, 5984.0, 14760.1, -49317.7),
    (45.0, 120.0, 2.0, 2027.5, 24304.4, -4247.6, 50947.1),
]


def place_at(latitude, longitude, height=0.0):
    return geodetic_to_ecef(np.radians(latitude), np.radians(longitude), 1e3 * height)


@pytest.mark.parametrize("row", PLACES)
def test_magnetic_field_matches_pygeomag(row):
    latitude, longitude, height, year, north, east, down = row
    field = 1e9 * earth_field(place_at(latitude, longitude, height), year)
    np.testing.assert_allclose(field, [east, north, -down], atol=0.1)


def test_default_field_is_the_model_at_the_laboratory():
    field = earth_field(np.array(quad_gym.GnssParams().reference_antenna_G))
    np.testing.assert_allclose(quad_gym.MagnetometerParams().field_I, field, rtol=0.002)


def test_moved_suite_takes_magnetic_field_of_new_place():
    melbourne = place_at(-37.87, 144.676)
    moved = at_place(quad_gym.sensor_suite("consumer"), melbourne)
    np.testing.assert_allclose(moved.magnetometer.field_I, earth_field(melbourne), rtol=1e-12)
    assert moved.gnss.reference_antenna_G == tuple(melbourne)


def test_moved_suite_keeps_field_given_by_user():
    suite = quad_gym.sensor_suite("consumer")
    compass = suite.magnetometer.replace(declination=0.4)
    moved = at_place(suite.replace(magnetometer=compass), place_at(-37.87, 144.676))
    assert moved.magnetometer == compass


def test_replay_far_from_the_laboratory_uses_local_magnetic_field():
    count, spot = 400, place_at(47.4, 8.5)
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
