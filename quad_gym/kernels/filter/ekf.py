"""The error-state extended Kalman filter: the derivatives of the models in place of sigma points.

It shares everything else with the UKF of `ukf.py` and `ukf_update.py`: state, error angles, models,
noise, and the factor L of the covariance. Where the UKF puts the half-differences of a pair of
sigma points into a column, the EKF puts the derivative of the model times the column of L; the
half-sums less the center, which carry the second order, are zero. With `R(e) = I - [e x] + ...`:

* `a = R_hat^T R(e)^T (f - b_a) - g e3`:  da = R_hat^T (de x f - db_a)
* `e+ = e + dt S(e) (w - b_g)`:  de+ = de + dt ((de_th w_z, -de_phi w_z, -de_th w_x) - db_g)
* position:  dz = dr + R_hat^T (de x l_p);  baseline:  dz = R_hat^T (de x u_B);
  velocity:  dz = dv
* feature at X_B, seen at distance s along u_B:  dz = (I - u u^T) (X_B x de - R_hat dr) / s
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BG, E, R, V
from quad_gym.kernels.maths.linalg import (
    add,
    apply,
    apply_transposed,
    cross,
    dot,
    load3,
    load33,
    load_column3,
    scale,
    select3,
    store3,
    sub,
)
from quad_gym.kernels.simd.lanes import any_of


@kernel
def acceleration_column(L, j, R_BI, f_B, df_B):
    """Derivative of the acceleration in I along column j, whose share of biases in f is df_B."""
    return apply_transposed(R_BI, sub(cross(load_column3(L, E, j), f_B), df_B))


@kernel
def angle_column(L, j, w_B, dt):
    """Derivative of the Euler step e + dt S(e) (w - b_g) along column j."""
    d, dg = load_column3(L, E, j), load_column3(L, BG, j)
    rate = (d[1] * w_B[2] - dg[0], -d[0] * w_B[2] - dg[1], -d[1] * w_B[0] - dg[2])
    return add(d, scale(dt, rate))


@kernel
def _put(row, k, has, values):
    """Write three numbers of a column, zero where a lane lacks the measurement."""
    zero = 0.0 * values[0]
    store3(row[k : k + 3], select3(has, values, (zero, zero, zero)))


@kernel
def measure_columns(
    flight, p, work, n, feature_count, use_position, use_baseline, use_velocity, last
):
    """Fill work.A with the derivatives of the measurement along the nine columns of L that matter.

    Column j of L is row `last - j`; work.E becomes zero. Reads work.X_B, work.inverse_distance and
    work.h, the measurement predicted at the center.
    """
    L = flight.L
    R_BI = load33(flight.R_hat)
    antenna, unit_baseline = load3(p.antenna), scale(1.0 / p.baseline_length, load3(p.baseline))
    for j in range(9):
        A, S = work.A[last - j], work.E[8 - j]
        d, dr = load_column3(L, E, j), load_column3(L, R, j)
        for k in range(n):
            S[k] = 0.0 * dr[0]
        k = 0
        if use_position:
            has = flight.position_valid > 0.0
            _put(A, k, has, add(dr, apply_transposed(R_BI, cross(d, antenna))))
            k += 3
        if use_baseline:
            has = flight.baseline_valid > 0.0
            _put(A, k, has, apply_transposed(R_BI, cross(d, unit_baseline)))
            k += 3
        if use_velocity:
            _put(A, k, flight.velocity_valid > 0.0, load_column3(L, V, j))
            k += 3
        dr_B = apply(R_BI, dr)
        for i in range(feature_count):
            has = flight.feature_valid[i] > 0.0
            if any_of(has):
                X_B, u_B = load3(work.X_B[i]), load3(work.h[k : k + 3])
                v = scale(work.inverse_distance[i], sub(cross(X_B, d), dr_B))
                _put(A, k, has, sub(v, scale(dot(u_B, v), u_B)))
                k += 3
