"""The Earth's magnetic field at the place of a flight: the World Magnetic Model 2025.

The potential is a sum of spherical harmonics with the Schmidt semi-normalized functions P_nm,

    V = a sum_n (a / r)^(n + 1) sum_m (g_nm cos(m lon) + h_nm sin(m lon)) P_nm(sin lat),

and the field its negative gradient. The coefficients in WMM_2025.COF change linearly with time.

Source: National Centers for Environmental Information and British Geological Survey, The US/UK
World Magnetic Model for 2025-2030 (public domain).
"""

import math
from functools import cache
from pathlib import Path

import numpy as np

from quad_gym.frames import ecef_to_enu
from quad_gym.logs.formats.log import Floats
from quad_gym.params.magnetometer import MagnetometerParams
from quad_gym.params.suites import SensorSuite

_RADIUS = 6_371_200.0  #: radius a of the model [m]
_EPOCH, _YEAR = 2025.0, 2026.0  #: year of the coefficients; and of the default fields in suites
_SAME = 0.02  #: relative difference up to which two fields are equal


@cache
def _coefficients() -> tuple[Floats, Floats, Floats, Floats]:
    """Return g and h (13, 13) of the epoch [nT], and their changes [nT per year]."""
    tables = np.zeros((4, 13, 13))
    for line in (Path(__file__).parent / "WMM_2025.COF").read_text("ascii").splitlines()[1:]:
        words = line.split()
        if len(words) == 6:
            tables[:, int(words[0]), int(words[1])] = [float(word) for word in words[2:]]
    g, h, dg, dh = tables
    return g, h, dg, dh


def earth_field(place_G: Floats, year: float = _YEAR) -> Floats:
    """Return the Earth's magnetic field east, north, up.

    Args:
        place_G: (3,) place in ECEF [m].
        year: Date as a decimal year; the model is for 2025 to 2030.

    Returns:
        (3,) field in the east-north-up frame of the place [T].
    """
    g, h, dg, dh = _coefficients()
    g, h = g + (year - _EPOCH) * dg, h + (year - _EPOCH) * dh
    x, y, z = place_G
    level, r = math.hypot(x, y), float(np.linalg.norm(place_G))
    s, c, lon = z / r, level / r, math.atan2(y, x)
    P, dP = np.zeros((13, 13)), np.zeros((13, 13))  # and its derivative by the latitude
    P[0, 0] = 1.0
    up = north = east = 0.0
    for n in range(1, 13):
        for m in range(n + 1):
            if m == n:
                k = math.sqrt((2 * n - 1) / (2 * n)) if n > 1 else 1.0
                P[n, m] = k * c * P[n - 1, m - 1]
                dP[n, m] = k * (c * dP[n - 1, m - 1] - s * P[n - 1, m - 1])
            else:
                k, two = math.sqrt(n * n - m * m), 2 * n - 1
                before = math.sqrt((n - 1) ** 2 - m * m) if n > 1 else 0.0
                last, dlast = (P[n - 2, m], dP[n - 2, m]) if n > 1 else (0.0, 0.0)
                P[n, m] = (two * s * P[n - 1, m] - before * last) / k
                dP[n, m] = (two * (s * dP[n - 1, m] + c * P[n - 1, m]) - before * dlast) / k
            cosine, sine, ratio = math.cos(m * lon), math.sin(m * lon), (_RADIUS / r) ** (n + 2)
            along = g[n, m] * cosine + h[n, m] * sine
            up += (n + 1) * ratio * along * P[n, m]
            north -= ratio * along * dP[n, m]
            east += m * ratio * (g[n, m] * sine - h[n, m] * cosine) * P[n, m] / max(c, 1e-9)
    across = np.array([-y, x, 0.0]) / max(level, 1e-9)
    radial = np.asarray(place_G) / r
    field_G = up * radial + north * np.cross(radial, across) + east * across
    return np.asarray(1e-9 * ecef_to_enu(place_G) @ field_G)


def at_place(suite: SensorSuite, origin_G: Floats) -> SensorSuite:
    """Return a suite with another origin, and with the Earth's field there.

    A magnetometer whose field is not the model's at the suite's reference antenna keeps its own.
    """
    if suite.gnss is None:
        return suite
    before, compass = np.array(suite.gnss.reference_antenna_G), suite.magnetometer
    moved = suite.replace(gnss=suite.gnss.replace(reference_antenna_G=tuple(origin_G.tolist())))
    if compass is None or np.array_equal(before, origin_G):
        return moved
    field = earth_field(before)
    if np.linalg.norm(np.subtract(compass.field_I, field)) > _SAME * np.linalg.norm(field):
        return moved
    return moved.replace(magnetometer=_with_field(compass, earth_field(origin_G)))


def _with_field(compass: MagnetometerParams, field_I: Floats) -> MagnetometerParams:
    east, north, up = field_I
    level = math.hypot(east, north)
    return compass.replace(
        strength=math.hypot(level, up),
        declination=math.atan2(east, north),
        inclination=math.atan2(-up, level),
    )
