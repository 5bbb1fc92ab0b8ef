"""The barometer: altitude by static pressure.

It measures `z = r_z + b + v` with white noise v and a slow error b, as the pressure on the ground
and the sensor's temperature change: a first-order Gauss-Markov process, which is a state of the
filter (`filter/slow.py`). The model is linear, so sigma points and derivatives agree.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.columns import columns_of
from quad_gym.kernels.filter.error_state import D, R, reset_variance
from quad_gym.kernels.filter.measurements import put_block, put_three
from quad_gym.kernels.numbers.elementary import maximum
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import diagonal, load3
from quad_gym.kernels.numbers.random import normal_pair, stream_of
from quad_gym.kernels.sensors.common import aid_stage
from quad_gym.records import AID_BLOCK, DRAW_AID, Aid

_S = int(Aid["BAROMETER"])
_BLOCK, _DRAW = AID_BLOCK[_S], DRAW_AID[_S]


@kernel
def _measure(flight, p, i):
    """Three numbers, of which the first is the altitude [m], and True: each lane measures."""
    n, _ = normal_pair(stream_of(flight), _DRAW)
    return (flight.r[2] + flight.aid_scalar[_S] + p.aid_sigma[_S] * n, 0.0, 0.0), True


@kernel
def _expect(flight, p, work, settings, i, k, valid):
    """Fill rows k to k + 2: the altitude, and two masked ones."""
    first, sigma, last = settings.aid_scalar[_S], p.aid_sigma[_S], columns_of(settings) - 1
    altitude, zero = flight.r_hat[2] + flight.slow_hat[first], zero_like(sigma)
    noise = diagonal((sigma * sigma, zero + 1.0, zero + 1.0))
    z = load3(flight.measurement[_BLOCK])
    put_block(work, settings, k, valid, z, (altitude, zero, zero), noise)
    for j in range(last + 1):
        value = work.L[settings.motion_columns + first, j]
        if j <= R + 2:  # the factor is a lower triangle
            value = value + work.L[R + 2, j]
        put_three(work.A[last - j], k, valid, (value, zero, zero))
    for j in range(settings.motion_columns):
        put_three(work.E[j], k, valid, (zero, zero, zero))


@kernel
def _reset(flight, p, work, settings, states, lanes, alone, nu):
    """Reset the slow error; where no other sensor measures it, the height, too."""
    first, own = D + settings.aid_scalar[_S], p.slow_sigma[settings.aid_scalar[_S]]
    square = maximum(select(alone, 0.0, nu[0] * nu[0]), own * own)
    reset_variance(work.P, first, states, lanes, square)
    reset_variance(work.P, R + 2, states, lanes & alone, nu[0] * nu[0] + own * own)


barometer_stage = aid_stage(Aid(_S), _measure, _expect, _reset)
