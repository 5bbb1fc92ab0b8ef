"""Frames of the Earth: ECEF (G, WGS-84) and local east-north-up (I)."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks as check
from quad_gym.params.portable import atan2, cos, hypot, norm, sin

WGS84_SEMI_MAJOR_AXIS = 6378137.0  #: semi-major axis of the WGS-84 ellipsoid [m]
WGS84_FLATTENING = 1.0 / 298.257223563


def ecef_to_geodetic(r_G: ArrayLike) -> tuple[float, float, float]:
    """Return the geodetic latitude, longitude and height of a point.

    The latitude is iterated to convergence: with N the radius of curvature in the prime vertical,
    tan(lat) = (z + e^2 N sin(lat)) / p.

    Args:
        r_G: (3,) position in G [m], outside the Earth's core.

    Returns:
        Latitude [rad], longitude [rad], height above the ellipsoid [m].

    Raises:
        ValueError: If `r_G` is not three finite numbers, or lies within 1,000 km of the Earth's
            center.
    """
    return _geodetic(_checked_place("r_G", r_G))


def geodetic_to_ecef(latitude: float, longitude: float, height: float) -> NDArray[np.float64]:
    """Return a point in ECEF from its geodetic coordinates: the inverse of `ecef_to_geodetic`.

    Args:
        latitude: Latitude, from the equator toward north [rad].
        longitude: Longitude, from Greenwich toward east [rad].
        height: Height above the ellipsoid [m].

    Returns:
        (3,) position in G [m].

    Raises:
        ValueError: If an argument is not finite, the latitude is beyond a pole, or the point lies
            within 1,000 km of the Earth's center.
    """
    lat = check.angle("latitude", latitude, most=0.5 * math.pi)
    lon, h = check.angle("longitude", longitude), check.number("height", height, least=-5.3e6)
    eccentricity2 = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING)
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    radius = WGS84_SEMI_MAJOR_AXIS / math.sqrt(1.0 - eccentricity2 * sin_lat**2)
    p = (radius + h) * cos_lat
    z = (radius * (1.0 - eccentricity2) + h) * sin_lat
    return np.array([p * math.cos(lon), p * math.sin(lon), z])


def _checked_place(name: str, value: ArrayLike) -> NDArray[np.float64]:
    place = check.array(name, value, (3,))
    if norm(place) < 1e6:
        raise ValueError(
            f"{name} must be a place near the Earth's surface in meters, got {value!r}"
        )
    return place


def _geodetic(r_G: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = map(float, r_G)
    eccentricity2 = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING)
    p = hypot(x, y)
    lat = atan2(z, p * (1.0 - eccentricity2))
    for _ in range(50):
        sin_lat = sin(lat)
        radius = WGS84_SEMI_MAJOR_AXIS / math.sqrt(1.0 - eccentricity2 * (sin_lat * sin_lat))
        previous, lat = lat, atan2(z + eccentricity2 * radius * sin_lat, p)
        if lat == previous:
            break
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    radius = WGS84_SEMI_MAJOR_AXIS / math.sqrt(1.0 - eccentricity2 * sin_lat**2)
    height = p * cos_lat + z * sin_lat - WGS84_SEMI_MAJOR_AXIS**2 / radius
    return float(lat), float(atan2(y, x)), float(height)


def ecef_to_enu(r0_G: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation R_IG from ECEF to the east-north-up frame at a point.

    Its rows are the unit east, north and up vectors at the geodetic latitude and longitude of the
    point, in G; v_I = R_IG v_G.

    Args:
        r0_G: (3,) position of the reference antenna in G [m].

    Returns:
        (3, 3) R_IG.

    Raises:
        ValueError: If `r0_G` is not three finite numbers on the Earth.
    """
    return _enu_at(_checked_place("r0_G", r0_G).tobytes()).copy()


@lru_cache  # for bytes, as numbers that are equal have other bits at zero
def _enu_at(place: bytes) -> NDArray[np.float64]:
    lat, lon, _ = _geodetic(np.frombuffer(place))
    (sin_lat, sin_lon), (cos_lat, cos_lon) = map(sin, (lat, lon)), map(cos, (lat, lon))
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
