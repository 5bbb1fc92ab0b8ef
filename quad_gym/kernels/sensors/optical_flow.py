"""Optical flow of the ground below: the angular rate at which it passes.

It measures `z = g (V_x, V_y) + (-w_y, w_x) + n` with white noise n, the velocity V = R_BI v in B,
the body rates w, and g = u / h, one over the distance of the ground along the body z axis: h is the
height, u the cosine of the tilt. The filter takes w from the gyro, whose noise adds to n; the
contribution of the gyro bias's error is neglected.

With a pair of sigma points, R(+-e) R_hat = (I + even +- odd) R_hat, v +- dv, h +- dh:

    V = W + V_e +- V_o,   V_e = even W + odd dV,   V_o = odd W + (I + even) dV,
    g = G + g_e +- g_o,   g_e = (even_u h^2 - odd_u dh h + u dh^2) / (h D),
                          g_o = (odd_u h - (u + even_u) dh) / D,

W = R_hat v, dV = R_hat dv, G = u / h and D = h^2 - dh^2, that is

    odd:   V_o (G + g_e) + (W + V_e) g_o,   even:   V_e (G + g_e) + W g_e + V_o g_o,

and the derivative along an offset is (dV + W x de) G + W (du / h - u dh / h^2).
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import E, R, V, reset_variances
from quad_gym.kernels.filter.measurements import (
    by_derivative,
    put_block,
    put_column,
    with_pairs,
)
from quad_gym.kernels.numbers.elementary import maximum
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    cross,
    diagonal,
    load3,
    load4,
    load33,
    load_column3,
    vector,
)
from quad_gym.kernels.numbers.random import normal_pair, stream_of
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm
from quad_gym.kernels.sensors.common import aid_stage
from quad_gym.kernels.sensors.range_finder import MIN_COSINE, ground_range
from quad_gym.records import AID_BLOCK, AID_NUMBERS, DRAW_AID, Aid

_S = int(Aid["OPTICAL_FLOW"])
_BLOCK, _DRAW = AID_BLOCK[_S], DRAW_AID[_S]
_N = AID_NUMBERS[_S]


@kernel
def _measure(flight, p, i):
    """Two rates, within the limits of height, tilt and rate."""
    n_x, n_y = normal_pair(stream_of(flight), _DRAW)
    R_BI, w = quaternion_to_dcm(load4(flight.q)), load3(flight.w)
    h, u = ground_range(p, flight.r, R_BI)
    within = (h >= p.aid_numbers[_N, 0]) & (u >= MIN_COSINE)
    g, v_B = u / select(within, h, 1.0), R_BI @ load3(flight.v)
    x, y = g * v_B[0] - w[1], g * v_B[1] + w[0]
    most, sigma = p.aid_numbers[_N, 1], p.aid_sigma[_S]
    within = within & (abs(x) <= most) & (abs(y) <= most)
    return (x + sigma * n_x, y + sigma * n_y, 0.0), within


@kernel
def _flow(g, v_B):
    """Contribution of a velocity to the flow; its third number is masked."""
    return (g * v_B[0], g * v_B[1], zero_like(g))


@kernel
def _expect(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2: two rates, and a masked row."""
    L, R_BI, inverse_c, c = work.L, load33(flight.R_hat), work.inverse_spread, work.spread
    h, u = ground_range(p, flight.r_hat, R_BI)
    h, W = maximum(h, 0.5 * p.aid_numbers[_N, 0]), R_BI @ load3(flight.v_hat)
    G, z_B, zero, w = u / h, R_BI.T[2], zero_like(h), load3(flight.w_meas) - load3(flight.b_g_hat)
    z_hat = vector(-w[1], w[0], zero) + _flow(G, W)
    variance = p.aid_sigma[_S] * p.aid_sigma[_S] + p.gyro_noise * p.gyro_noise
    noise = diagonal((variance, variance, zero + 1.0))
    put_block(work, settings, k, valid, load3(flight.measurement[_BLOCK]), z_hat, noise)
    for j in range(settings.motion_columns):
        dV, dh = R_BI @ load_column3(L, V, j), L[R + 2, j] if j <= R + 2 else zero
        a, s = (zero, zero, zero), (zero, zero, zero)
        if by_derivative(settings):
            e = load_column3(L, E, j)
            du = cross(z_B, e)[2]
            a = _flow(G, dV + cross(W, e)) + _flow((du - G * dh) / h, W)
        if with_pairs(settings):
            zeros = diagonal((zero, zero, zero))
            odd, even = zeros, zeros  # columns from the fourth on do not change the attitude
            if j < 3:
                odd, even = load33(work.odd[j]), load33(work.even[j])
            dV, dh = c * dV, c * dh
            V_e = even @ W + odd @ dV
            V_o = dV + odd @ W + even @ dV
            odd_u, even_u = (odd @ z_B)[2], (even @ z_B)[2]
            divisor = 1.0 / (h * h - dh * dh)
            g_e = (even_u * h * h - odd_u * dh * h + u * dh * dh) * divisor / h
            g_o = (odd_u * h - (u + even_u) * dh) * divisor
            if not by_derivative(settings):
                a = inverse_c * (_flow(G + g_e, V_o) + _flow(g_o, W + V_e))
            s = inverse_c * (_flow(G + g_e, V_e) + _flow(g_e, W) + _flow(g_o, V_o))
        put_column(work, settings, k, j, valid, a, s)


@kernel
def _reset(flight, p, work, settings, states, lanes, alone, nu):
    """Reset the velocity."""
    h, _ = ground_range(p, flight.r_hat, load33(flight.R_hat))
    square = h * h * (nu[0] * nu[0] + nu[1] * nu[1])
    reset_variances(work.P, V, states, lanes & alone, (square, square, square))


optical_flow_stage = aid_stage(Aid(_S), _measure, _expect, _reset)
