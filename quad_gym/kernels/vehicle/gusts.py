"""Dryden gusts in the low-altitude form of MIL-F-8785C (3.7.3.4), discretized exactly.

Along the mean wind, the gust u is white noise through a first-order filter; across (v) and upward
(w), it is white noise through `(1 + sqrt(3) T s) / (1 + T s)^2` with T = L / V. In the time h = V t
/ L all three are stationary at any airspeed V and length L, so V and L may change from tick to
tick: the states below have fixed variances, and only the intensities are multiplied in.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import clip, exp, log, maximum
from quad_gym.kernels.maths.linalg import load3, norm
from quad_gym.kernels.maths.random import normal_pair, stream_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import DRAW_GUST

MIN_AIRSPEED = 1.0
"""Least airspeed with which gusts change [m/s]: turbulence that is frozen in the air (Taylor's
hypothesis) would be constant for a vehicle that drifts with the wind."""
_FOOT = 0.3048
_LOWEST, _HIGHEST = 10.0, 1000.0  #: feet: where the low-altitude form holds
_ROOT3, _ROOT_HALF, _ROOT_EIGHTH = math.sqrt(3.0), math.sqrt(0.5), math.sqrt(0.125)


@kernel
def gust_scales(height, wind_speed):
    """(sigma_u, sigma_w) [m/s] and (L_u, L_w) [m]; sigma_v = sigma_u and L_v = L_u.

    `sigma_w = 0.1 W20`, `sigma_u = sigma_w / k^0.4`, `L_w = h`, `L_u = h / k^1.2` with `k = 0.177 +
    0.000823 h` and h in feet.
    `height` above ground [m] counts as between 10 and 1,000 feet; `wind_speed` is W20, 20 feet
    above ground [m/s].
    """
    h = clip(height / _FOOT, _LOWEST, _HIGHEST)
    log_k = log(0.177 + 0.000823 * h)
    sigma_w = 0.1 * wind_speed
    return sigma_w * exp(-0.4 * log_k), sigma_w, _FOOT * h * exp(-1.2 * log_k), _FOOT * h


@kernel
def sinh_less_argument(h):
    """Sinh h - h for h >= 0, without cancellation."""
    z = h * h
    tail = 1.0 + z / 156.0 * (1.0 + z / 210.0 * (1.0 + z / 272.0))
    tail = 1.0 + z / 42.0 * (1.0 + z / 72.0 * (1.0 + z / 110.0 * tail))
    series = z * h / 6.0 * (1.0 + z / 20.0 * tail)
    return select(h < 1.0, series, 0.5 * (exp(h) - exp(-h)) - h)


@kernel
def first_order(x, h, n):
    """Carry `x' = -x + white noise` of unit variance over the time h, with a standard normal n."""
    kept = exp(-h)
    return kept * x + math.sqrt((1.0 - kept) * (1.0 + kept)) * n


@kernel
def second_order(x, y, h, n, m):
    """Carry `x' = -x + noise`, `y' = -y + x` of unit noise density over the time h.

    With e = exp(-h), the added noise has the covariance [[e sinh h, c], [c, d]], where c = e (sinh
    h - h e) / 2, and d gives it the determinant e^2 (sinh^2 h - h^2) / 4.
    h is in units of the filter's time constant, n and m are standard normals, and the stationary
    covariance of (x, y) is [[1/2, 1/4], [1/4, 1/4]].
    """
    e, excess = exp(-h), sinh_less_argument(h)
    sinh = h + excess
    variance = e * sinh
    deviation = math.sqrt(variance)
    shared = 0.5 * e * (excess + h * (1.0 - e)) / select(h > 0.0, deviation, 1.0)
    rest = 0.25 * e * excess * (sinh + h) / select(h > 0.0, sinh, 1.0)
    return e * x + deviation * n, e * (y + h * x) + shared * n + math.sqrt(rest) * m


@kernel
def draw_gust(flight, stream, mask):
    """Draw the stationary gust at the start of an episode, where `mask`."""
    n_u, n_v = normal_pair(stream, DRAW_GUST)
    m_v, n_w = normal_pair(stream, DRAW_GUST + 1)
    m_w, _ = normal_pair(stream, DRAW_GUST + 2)
    start = (
        n_u,
        _ROOT_HALF * n_v,
        _ROOT_EIGHTH * (n_v + m_v),
        _ROOT_HALF * n_w,
        _ROOT_EIGHTH * (n_w + m_w),
    )
    for i in range(5):
        flight.gust[i] = select(mask, start[i], flight.gust[i])


@kernel
def carry_gust(flight, p):
    """Carry the gust over a tick, at the vehicle's present height and airspeed."""
    _, _, L_u, L_w = gust_scales(flight.r[2] - p.ground_height, p.gust_wind_speed)
    airspeed = norm(load3(flight.v) - load3(p.wind_I))
    way = p.dt * maximum(airspeed, MIN_AIRSPEED)
    stream = stream_of(flight)
    n_u, n_v = normal_pair(stream, DRAW_GUST)
    m_v, n_w = normal_pair(stream, DRAW_GUST + 1)
    m_w, _ = normal_pair(stream, DRAW_GUST + 2)
    gust = flight.gust
    gust[0] = first_order(gust[0], way / L_u, n_u)
    gust[1], gust[2] = second_order(gust[1], gust[2], way / L_u, n_v, m_v)
    gust[3], gust[4] = second_order(gust[3], gust[4], way / L_w, n_w, m_w)


@kernel
def gust_velocity(flight, p):
    """Velocity of the gust in I [m/s]; u lies along the horizontal mean wind (or east), w is up."""
    sigma_u, sigma_w, _, _ = gust_scales(flight.r[2] - p.ground_height, p.gust_wind_speed)
    gust = flight.gust
    u = sigma_u * gust[0]
    v = sigma_u * (_ROOT3 * gust[1] + (1.0 - _ROOT3) * gust[2])
    w = sigma_w * (_ROOT3 * gust[3] + (1.0 - _ROOT3) * gust[4])
    x, y = p.wind_I[0], p.wind_I[1]
    speed = math.sqrt(x * x + y * y)
    blows = speed > 0.0
    along = select(blows, speed, 1.0)
    c, s = select(blows, x, 1.0) / along, y / along
    return (c * u - s * v, s * u + c * v, w)
