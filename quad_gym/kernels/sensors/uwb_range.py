"""Ranges to anchors of known places.

The range to the anchor a is `z = |d| + v` with white noise v and the vector d = r + R^T l - a from
the anchor to the antenna, l in B. With a pair of sigma points it becomes d + e +- o, where R^T l
has the even part e and an odd one that adds to the odd part of r in o. With D = |d| and D+- =
|d + e +- o|, without the differences of nearly equal numbers,

    odd:   a = 2 (d + e) . o / (D+ + D-),
    even:  ((2 d + e) . e + o . o) (P + M) / (2 P M) - 2 a (d + e) . o / (P M),

P = D+ + D and M = D- + D; the derivative along an offset is d . (dr + d(R^T l)) / D.

A detour of the signal, which the filter does not model, lengthens some ranges.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import R, reset_variances
from quad_gym.kernels.filter.measurements import (
    by_derivative,
    lever_column,
    put_block,
    put_column,
    with_pairs,
)
from quad_gym.kernels.numbers.elementary import maximum
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import diagonal, dot, load3, load4, load33, load_column3, norm
from quad_gym.kernels.numbers.random import normal_pair, stream_of, uniform_pair
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm
from quad_gym.kernels.sensors.common import aid_stage
from quad_gym.records import AID_BLOCK, AID_NUMBERS, DRAW_AID, Aid

_S = int(Aid["UWB_RANGE"])
_BLOCK, _DRAW, _TAG = AID_BLOCK[_S], DRAW_AID[_S], AID_NUMBERS[_S]
_LIMITS, _ANCHORS = _TAG + 1, _TAG + 2
_NEAR = 1e-3  #: distance of an anchor within which its direction is not defined [m]


@kernel
def _to_antenna(p, i, r_I, R_BI):
    """Vector from anchor i to the antenna, in I."""
    return r_I + R_BI.T @ load3(p.aid_numbers[_TAG]) - load3(p.aid_numbers[_ANCHORS + i])


@kernel
def _measure(flight, p, i):
    """The range to anchor i, longer by a detour with a small probability."""
    stream, (longest, share, size) = stream_of(flight), load3(p.aid_numbers[_LIMITS])
    n, _ = normal_pair(stream, _DRAW + 2 * i)
    u, w = uniform_pair(stream, _DRAW + 2 * i + 1)
    distance = norm(_to_antenna(p, i, load3(flight.r), quaternion_to_dcm(load4(flight.q))))
    detour = select(u < share, size * w, 0.0)
    return (distance + p.aid_sigma[_S] * n + detour, 0.0, 0.0), distance <= longest


@kernel
def _expect(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2: the range to anchor i, and two masked ones."""
    L, R_BI, c, inverse_c = work.L, load33(flight.R_hat), work.spread, work.inverse_spread
    d, l_B = _to_antenna(p, i, load3(flight.r_hat), R_BI), load3(p.aid_numbers[_TAG])
    D, zero, sigma = maximum(norm(d), _NEAR), zero_like(c), p.aid_sigma[_S]
    noise, z = (sigma * sigma, zero + 1.0, zero + 1.0), load3(flight.measurement[_BLOCK + i])
    put_block(work, settings, k, valid, z, (D, zero, zero), diagonal(noise))
    for j in range(settings.motion_columns):
        o, e = lever_column(work, settings, j, R_BI, l_B)
        o = o + load_column3(L, R, j)
        a, s = dot(d, o) / D, zero
        if with_pairs(settings):
            o, e = c * o, c * e
            center = d + e
            plus, minus = norm(center + o), norm(center - o)
            along, P, M = dot(center, o), plus + D, minus + D
            half = 2.0 * along / (plus + minus)
            s = 0.5 * (dot(center + d, e) + dot(o, o)) * (P + M) - 2.0 * half * along
            s = inverse_c * s / (P * M)
            if not by_derivative(settings):
                a = inverse_c * half
        put_column(work, settings, k, j, valid, (a, zero, zero), (s, zero, zero))


@kernel
def _reset(flight, p, work, settings, states, lanes, alone, nu):
    """Reset the position where no other sensor measures it."""
    square = nu[0] * nu[0]
    reset_variances(work.P, R, states, lanes & alone, (square, square, square))


uwb_range_stage = aid_stage(Aid(_S), _measure, _expect, _reset)
