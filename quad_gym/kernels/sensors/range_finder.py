"""The range finder: distance to the ground along the body z axis.

It measures `z = h / u + v` with white noise v, the height h = r_z - ground and u, the cosine of the
tilt: the vertical component of the body z axis. With a pair of sigma points, R(+-e) R_hat = (I +
even +- odd) R_hat, h +- dh and u + even_u +- odd_u, that is

    odd:   (dh U - h odd_u) / D,   even:   (h (odd_u^2 - U even_u) - u dh odd_u) / (u D),

U = u + even_u and D = U^2 - odd_u^2; the derivative along an offset is dh / u - h du / u^2.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import E, R, reset_variance
from quad_gym.kernels.filter.measurements import (
    by_derivative,
    put_block,
    put_column,
    with_pairs,
)
from quad_gym.kernels.numbers.elementary import maximum
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import cross, diagonal, load3, load4, load33, load_column3
from quad_gym.kernels.numbers.random import normal_pair, stream_of
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm
from quad_gym.kernels.sensors.common import aid_stage
from quad_gym.records import AID_BLOCK, AID_NUMBERS, DRAW_AID, Aid

_S = int(Aid["RANGE_FINDER"])
_BLOCK, _DRAW = AID_BLOCK[_S], DRAW_AID[_S]
_N = AID_NUMBERS[_S]
MIN_COSINE = 0.5  #: cosine of the tilt below which it does not measure: 60 degrees


@kernel
def ground_range(p, r, R_BI):
    """Height above the ground, and cosine of the tilt."""
    return r[2] - p.ground_height, R_BI[2][2]


@kernel
def _measure(flight, p, i):
    """The distance, within range."""
    n, _ = normal_pair(stream_of(flight), _DRAW)
    h, u = ground_range(p, flight.r, quaternion_to_dcm(load4(flight.q)))
    steep = u < MIN_COSINE
    distance = h / select(steep, 1.0, u)
    within = (distance >= p.aid_numbers[_N, 0]) & (distance <= p.aid_numbers[_N, 1])
    return (distance + p.aid_sigma[_S] * n, 0.0, 0.0), within & (u >= MIN_COSINE)


@kernel
def _expect(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2: the distance, and two masked ones."""
    L, R_BI, inverse_c, c = work.L, load33(flight.R_hat), work.inverse_spread, work.spread
    h, u = ground_range(p, flight.r_hat, R_BI)
    zero, sigma = zero_like(u), p.aid_sigma[_S]
    u = maximum(u, MIN_COSINE)
    z, noise = load3(flight.measurement[_BLOCK]), (sigma * sigma, zero + 1.0, zero + 1.0)
    put_block(work, settings, k, valid, z, (h / u, zero, zero), diagonal(noise))
    z_B = R_BI.T[2]
    for j in range(settings.motion_columns):
        dh = L[R + 2, j] if j <= R + 2 else zero
        a, s = zero, zero
        if j >= 3:  # these columns do not change the attitude
            a = dh / u
        elif by_derivative(settings):
            du = cross(z_B, load_column3(L, E, j))[2]
            a = (dh - h * du / u) / u
        if j < 3 and with_pairs(settings):
            dh, odd, even = c * dh, load33(work.odd[j]) @ z_B, load33(work.even[j]) @ z_B
            U = u + even[2]
            divisor = 1.0 / (U * U - odd[2] * odd[2])
            s = h * (odd[2] * odd[2] - U * even[2]) - u * dh * odd[2]
            s = inverse_c * s * divisor / u
            if not by_derivative(settings):
                a = inverse_c * (dh * U - h * odd[2]) * divisor
        put_column(work, settings, k, j, valid, (a, zero, zero), (s, zero, zero))


@kernel
def _reset(flight, p, work, settings, states, lanes, alone, nu):
    """Reset the height where no other sensor measures it."""
    reset_variance(work.P, R + 2, states, lanes & alone, nu[0] * nu[0])


range_finder_stage = aid_stage(Aid(_S), _measure, _expect, _reset)
