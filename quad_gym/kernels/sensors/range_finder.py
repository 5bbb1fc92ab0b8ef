"""The range finder: distance to the ground along the body z axis.

It measures `z = h / u + v` with white noise v, the height h = r_z - ground and u, the cosine of the
tilt: the vertical component of the body z axis. With a pair of sigma points, R(+-e) R_hat = (I +
even +- odd) R_hat, h +- dh and u + even_u +- odd_u, that is

    odd:   (dh U - h odd_u) / D,   even:   (h (odd_u^2 - U even_u) - u dh odd_u) / (u D),

U = u + even_u and D = U^2 - odd_u^2; the derivative along an offset is dh / u - h du / u^2.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import E, R
from quad_gym.kernels.filter.rows import clear_slow_columns, columns_of, put_noise, put_three
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.maths.linalg import apply, cross, load4, load33, load_column3
from quad_gym.kernels.maths.random import normal_pair, stream_of
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.sensors.aid import aid_due, begin_aid, deliver, gate_aid
from quad_gym.kernels.sensors.stage import sensor_stage
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import AID_BLOCKS, AID_GROUPS, DRAW_AID, Aid, FilterForm, Sensor

_S = int(Aid.RANGE_FINDER)
_BLOCK, _EKF = AID_BLOCKS + _S, int(FilterForm.EKF)
LEAST_COSINE = 0.5
"""Cosine of the tilt below which it does not measure: 60 degrees."""


@kernel
def ground_range(p, r, R_BI):
    """Height above the ground, and cosine of the tilt."""
    return r[2] - p.ground_height, R_BI[2][2]


@kernel
def _begin(flight, p, settings, mask):
    begin_aid(flight, p, settings, _S, mask)


@kernel
def _sample(flight, p, settings, work, stages, mask, starting):
    """Measure when due and within range."""
    due = aid_due(flight, p, settings, _S, mask, starting)
    n, _ = normal_pair(stream_of(flight), DRAW_AID + 2 * _S)
    h, u = ground_range(p, flight.r, quaternion_to_dcm(load4(flight.q)))
    steep = u < LEAST_COSINE
    distance = h / select(steep, 1.0, u)
    within = (distance >= p.aid_numbers[_S, 0]) & (distance <= p.aid_numbers[_S, 1])
    due = due & within & (u >= LEAST_COSINE)
    zero = 0.0 * distance
    values = (distance + p.aid_sigma[_S] * n, zero, zero)
    deliver(flight, work, settings, _S, mask, due, values)


@kernel
def _expect(flight, p, work, settings, k):
    """Fill rows k to k + 2: the distance, and two masked ones."""
    valid, last = flight.block_valid[_BLOCK] > 0.0, columns_of(settings) - 1
    L, R_BI, inverse_c, c = flight.L, load33(flight.R_hat), work.inverse_spread, work.spread
    h, u = ground_range(p, flight.r_hat, R_BI)
    zero, one = 0.0 * u, 1.0 + 0.0 * u
    u = maximum(u, LEAST_COSINE)
    put_three(work.z_hat, k, valid, (h / u, zero, zero))
    put_three(work.z, k, valid, (flight.aid_measurement[_S, 0], zero, zero))
    variance = p.aid_sigma[_S] * p.aid_sigma[_S]
    put_noise(work, k, valid, ((variance, zero, zero), (zero, one, zero), (zero, zero, one)))
    clear_slow_columns(work, k, settings)
    z_B = (R_BI[0][2], R_BI[1][2], R_BI[2][2])
    for j in range(9):
        dh = L[R + 2, j] if j <= R + 2 else zero
        if (settings.form & _EKF) != 0:
            du = cross(z_B, load_column3(L, E, j))[2]
            straight, bent = (dh - h * du / u) / u, zero
        else:
            dh, odd, even = (
                c * dh,
                apply(load33(work.odd[j]), z_B),
                apply(load33(work.even[j]), z_B),
            )
            whole = u + even[2]
            divisor = 1.0 / (whole * whole - odd[2] * odd[2])
            straight = inverse_c * (dh * whole - h * odd[2]) * divisor
            bent = h * (odd[2] * odd[2] - whole * even[2]) - u * dh * odd[2]
            bent = inverse_c * bent * divisor / u
        put_three(work.A[last - j], k, valid, (straight, zero, zero))
        put_three(work.E[8 - j], k, valid, (bent, zero, zero))


@kernel
def _gate(flight, p, work, settings, k):
    gate_aid(flight, p, work, settings, _S, k, 1.0)


@kernel
def _inflate(flight, p, work, settings):
    """Inflate the height to the square of a rejected innovation."""
    nu = flight.innovation[_BLOCK, 0]
    square = select(work.alarm[AID_GROUPS + _S] > 0.0, nu * nu, 0.0)
    work.P[R + 2, R + 2] = maximum(work.P[R + 2, R + 2], square)


range_finder_stage = sensor_stage(Sensor.RANGE_FINDER, _begin, _sample, _expect, _gate, _inflate)
