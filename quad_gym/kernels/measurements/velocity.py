"""GNSS velocity: of the primary antenna.

It measures `z = v + R^T (w x l_p) + v_noise` in I, with body rates w from the gyro. The lever arm's
share turns with the error angles. Only filters with slow errors count that (`filter/slow.py`): one
whose heading comes from a magnetometer errs by some degrees, and a vehicle that turns by 6 rad/s by
0.02 m/s then. Where two antennas tell the heading to half a degree it is neglected, so that the
model is linear: dz = dv.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import E, V
from quad_gym.kernels.filter.recovery import doubt_acceleration, suspect_group, time_of
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
from quad_gym.kernels.measurements.gate import judge_triple, leave_out
from quad_gym.kernels.measurements.rows import (
    clear_slow_columns,
    columns_of,
    put_noise,
    put_three,
)
from quad_gym.kernels.measurements.triples import triple_functions
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import DRAW_VELOCITY, VELOCITY_BLOCK, FilterForm, Sensor

SENSOR = Sensor.GNSS
_EKF = int(FilterForm.EKF)

count, mark_failed, set_aside, exchange, keep_valid, choose = triple_functions(
    "velocity", VELOCITY_BLOCK
)

# ---- simulation ------------------------------------------------------------------------------


@kernel
def measure(flight, p, mask):
    """Measure the antenna's velocity in G, where `mask`."""
    R_BI, R_IG = quaternion_to_dcm(load4(flight.q)), load33(p.R_IG)
    n, _ = six_normals(stream_of(flight), DRAW_VELOCITY)
    lever_B = cross(load3(flight.w), load3(p.antenna))
    v_I = add(load3(flight.v), apply_transposed(R_BI, lever_B))
    keep3(flight.gnss_velocity, mask, apply_transposed(R_IG, add(v_I, scale(p.velocity_sigma, n))))


# ---- update ----------------------------------------------------------------------------------


@kernel
def _center(flight, p, work, k, has):
    """Fill the rows of what is expected, of what was measured, and of the noise."""
    w_B = sub(load3(flight.w_meas), load3(flight.b_g_hat))
    lever_B = cross(w_B, load3(p.antenna))
    lever_I = apply_transposed(load33(flight.R_hat), lever_B)
    put_three(work.h, k, has, add(load3(flight.v_hat), lever_I))
    put_three(work.z, k, has, apply(load33(p.R_IG), load3(flight.gnss_velocity)))
    variance = p.velocity_sigma * p.velocity_sigma
    zero = 0.0 * variance
    nothing = (zero, zero, zero)
    put_noise(work, k, has, add_to_diagonal((nothing, nothing, nothing), variance))
    return lever_B


@kernel
def expect(flight, p, work, settings, slow, k):
    """Fill the rows from k on, if any lane has a velocity; return the row behind them."""
    if not any_of(flight.velocity_valid > 0.0):
        return k
    L, last, has = flight.L, columns_of(slow) - 1, flight.velocity_valid > 0.0
    lever_B = _center(flight, p, work, k, has)
    clear_slow_columns(work, k, slow)
    R_BI, inverse_c = load33(flight.R_hat), work.inverse_spread
    for j in range(9):
        dv = load_column3(L, V, j)
        bent = scale(0.0, dv)
        if slow is not None:
            if (settings.form & _EKF) != 0:
                turned = cross(load_column3(L, E, j), lever_B)
            else:
                turned = scale(inverse_c, apply_transposed(load33(work.odd[j]), lever_B))
                even = scale(inverse_c, apply_transposed(load33(work.even[j]), lever_B))
                bent = apply_transposed(R_BI, even)
            dv = add(dv, apply_transposed(R_BI, turned))
        put_three(work.A[last - j], k, has, dv)
        put_three(work.E[8 - j], k, has, bent)
    return k + 3


@kernel
def judge(flight, p, work, settings, slow, k):
    """Keep the innovation in the rows from k on, and mask it beyond the gate."""
    if not any_of(flight.velocity_valid > 0.0):
        return k
    has, columns = (work.taking > 0.0) & (flight.velocity_valid > 0.0), columns_of(slow)
    rejected, nis = judge_triple(flight, p, work, settings, k, VELOCITY_BLOCK, has, columns)
    work.judged_nis = work.judged_nis + nis
    work.judged_freedoms = work.judged_freedoms + select(has, 3.0, 0.0)
    leave_out(flight, work, settings, k, VELOCITY_BLOCK, has, rejected, columns, 3.0)
    return k + 3


# ---- doubts ----------------------------------------------------------------------------------


@kernel
def suspect(flight, p, work, settings, slow, k):
    """Note whether velocities make the filter doubt itself."""
    suspect_group(flight, p, work, VELOCITY_BLOCK, work.taking > 0.0)
    return k


@kernel
def doubt(flight, p, work, settings, slow, k):
    """Raise the variances of what may be wrong, where velocities are doubted.

    That is the velocity; accelerometer and tilt may have led there.
    """
    nu, doubted, P = load3(flight.innovation[VELOCITY_BLOCK]), work.doubted[VELOCITY_BLOCK], work.P
    for i in range(3):
        P[V + i, V + i] = maximum(P[V + i, V + i], select(doubted > 0.0, nu[i] * nu[i], 0.0))
    doubt_acceleration(p, P, norm(nu) / time_of(flight, p, VELOCITY_BLOCK), doubted)
    return k
