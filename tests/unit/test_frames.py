"""Earth frames against the geometry of the ellipsoid and published coordinates."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quad_gym.frames import ecef_to_enu, ecef_to_geodetic

EQUATOR, POLE = 6378137.0, 6356752.314245179  # WGS-84 semi-axes [m]

reduced_latitudes = st.floats(-1.57, 1.57)
longitudes = st.floats(-np.pi, np.pi)
heights = st.floats(-1e4, 1e6)


def place(reduced_latitude, longitude, height):
    """A point at a height above the ellipsoid, and the ellipsoid's outward normal below it."""
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
def test_axes_are_right_handed_with_east_along_the_parallel(latitude, longitude, height):
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
def test_geodetic_coordinates_lead_back_to_the_place(latitude, longitude, height):
    r_G, normal = place(latitude, longitude, height)
    lat, lon, h = ecef_to_geodetic(r_G)
    assert lat == pytest.approx(np.arcsin(np.clip(normal[2], -1, 1)), abs=1e-7)
    np.testing.assert_allclose(
        [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], normal, atol=1e-14
    )
    assert h == pytest.approx(height, abs=1e-8)


def test_a_published_pair_of_coordinates():
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
def test_the_axes_at_the_equator_and_the_poles(r_G, axes):
    np.testing.assert_allclose(ecef_to_enu(r_G), axes, rtol=0.0, atol=1e-15)
    assert ecef_to_geodetic(r_G)[2] == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize(
    "bad", [[1.0, 2.0], 0.0, "Austin", [np.nan, 0.0, EQUATOR], [0.0, 0.0, 5e5], None]
)
def test_what_is_no_place_is_refused_by_name(bad):
    with pytest.raises(ValueError, match=r"^r_G must"):
        ecef_to_geodetic(bad)
    with pytest.raises(ValueError, match=r"^r0_G must"):
        ecef_to_enu(bad)
