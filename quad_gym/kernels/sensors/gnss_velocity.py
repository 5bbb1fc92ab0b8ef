"""GNSS velocity: of the primary antenna.

It measures `z = v + R^T (w x l_p) + v_noise` in I, with body rates w from the gyro. The lever arm's
share depends on the attitude. Filters with slow errors take this into account (`filter/slow.py`):
where a magnetometer gives the heading, it is off by a few degrees, and the share at 6 rad/s by 0.02
m/s. Where two antennas give the heading to half a degree, this is neglected, so that the model is
linear: dz = dv.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import E, V
from quad_gym.kernels.filter.gate import add_nis, gate_numbers, mask_rejected
from quad_gym.kernels.filter.recovery import inflate_accel_bias, time_of
from quad_gym.kernels.filter.rows import (
    clear_slow_columns,
    columns_of,
    put_noise,
    put_three,
)
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.maths.linalg import (
    add,
    add_to_diagonal,
    apply,
    apply_transposed,
    cross,
    keep3,
    load3,
    load4,
    load33,
    load_column3,
    norm,
    scale,
    sub,
)
from quad_gym.kernels.maths.random import six_normals, stream_of
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import DRAW_VELOCITY, VELOCITY_BLOCK, FilterForm

_EKF = int(FilterForm.EKF)

# ---- simulation ------------------------------------------------------------------------------


@kernel
def measure(flight, p, mask):
    """Measure the antenna's velocity in G, in the lanes `mask`."""
    R_BI, R_IG = quaternion_to_dcm(load4(flight.q)), load33(p.R_IG)
    n, _ = six_normals(stream_of(flight), DRAW_VELOCITY)
    lever_B = cross(load3(flight.w), load3(p.antenna))
    v_I = add(load3(flight.v), apply_transposed(R_BI, lever_B))
    keep3(flight.gnss_velocity, mask, apply_transposed(R_IG, add(v_I, scale(p.velocity_sigma, n))))


# ---- update ----------------------------------------------------------------------------------


@kernel
def _center(flight, p, work, k, valid):
    """Fill the rows of predicted measurement, measurement and noise; return w x l_p."""
    w_B = sub(load3(flight.w_meas), load3(flight.b_g_hat))
    lever_B = cross(w_B, load3(p.antenna))
    lever_I = apply_transposed(load33(flight.R_hat), lever_B)
    put_three(work.z_hat, k, valid, add(load3(flight.v_hat), lever_I))
    put_three(work.z, k, valid, apply(load33(p.R_IG), load3(flight.gnss_velocity)))
    variance = p.velocity_sigma * p.velocity_sigma
    zero = 0.0 * variance
    nothing = (zero, zero, zero)
    put_noise(work, k, valid, add_to_diagonal((nothing, nothing, nothing), variance))
    return lever_B


@kernel
def expect(flight, p, work, settings, k):
    """Fill the rows from k on, if any lane has a velocity; return the next row."""
    valid = flight.block_valid[VELOCITY_BLOCK] > 0.0
    if not any_of(valid):
        return k
    L, last = flight.L, columns_of(settings) - 1
    lever_B = _center(flight, p, work, k, valid)
    clear_slow_columns(work, k, settings)
    R_BI, inverse_c = load33(flight.R_hat), work.inverse_spread
    for j in range(9):
        dv = load_column3(L, V, j)
        bent = scale(0.0, dv)
        if settings.slow_states > 0:
            if (settings.form & _EKF) != 0:
                turned = cross(load_column3(L, E, j), lever_B)
            else:
                turned = scale(inverse_c, apply_transposed(load33(work.odd[j]), lever_B))
                even = scale(inverse_c, apply_transposed(load33(work.even[j]), lever_B))
                bent = apply_transposed(R_BI, even)
            dv = add(dv, apply_transposed(R_BI, turned))
        put_three(work.A[last - j], k, valid, dv)
        put_three(work.E[8 - j], k, valid, bent)
    return k + 3


@kernel
def gate(flight, p, work, settings, k):
    """Store the innovation in the rows from k on, and mask it beyond the gate."""
    if not any_of(flight.block_valid[VELOCITY_BLOCK] > 0.0):
        return k
    valid = (work.taking > 0.0) & (flight.block_valid[VELOCITY_BLOCK] > 0.0)
    block, limit = VELOCITY_BLOCK, p.gate_position
    rejected, nis = gate_numbers(flight, p, work, settings, k, block, block, valid, limit, 3.0)
    add_nis(work, valid & logical_not(work.again > 0.0), nis, 3.0)
    mask_rejected(flight, work, settings, k, VELOCITY_BLOCK, valid, rejected, 3.0)
    return k + 3


# ---- inflation -------------------------------------------------------------------------------


@kernel
def inflate(flight, p, work, settings):
    """Inflate the velocity, accelerometer biases and tilt."""
    nu, alarm, P = load3(flight.innovation[VELOCITY_BLOCK]), work.alarm[VELOCITY_BLOCK], work.P
    for i in range(3):
        P[V + i, V + i] = maximum(P[V + i, V + i], select(alarm > 0.0, nu[i] * nu[i], 0.0))
    inflate_accel_bias(p, P, norm(nu) / time_of(flight, p, VELOCITY_BLOCK), alarm)
