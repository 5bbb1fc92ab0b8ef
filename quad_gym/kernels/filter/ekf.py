"""The error-state extended Kalman filter: the derivatives of the motion in place of sigma points.

It shares everything else with the UKF: state, error angles, models, noise, and the factor L of the
covariance. Where the UKF puts the half-differences of a pair of sigma points into a column, the EKF
puts the derivative of the model times the column of L; the half-sums minus the center, which carry
the second order, are zero. With `R(e) = I - [e x] + ...`:

* `a = R_hat^T R(e)^T (f - b_a) - g e3`:  da = R_hat^T (de x f - db_a)
* `e+ = e + dt S(e) (w - b_g)`:  de+ = de + dt ((de_th w_z, -de_phi w_z, -de_th w_x) - db_g)

The derivatives of measurements are in the files of these, in `kernels/sensors/`.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BG, E
from quad_gym.kernels.maths.linalg import cross
from quad_gym.kernels.maths.matrices import load_column3


@kernel
def acceleration_column(L, j, R_BI, f_B, df_B):
    """Derivative of the acceleration in I along column j, whose share of biases in f is df_B."""
    return R_BI.T @ (cross(load_column3(L, E, j), f_B) - df_B)


@kernel
def angle_column(L, j, w_B, dt):
    """Derivative of the Euler step e + dt S(e) (w - b_g) along column j."""
    d, dg = load_column3(L, E, j), load_column3(L, BG, j)
    rate = (d[1] * w_B[2] - dg[0], -d[0] * w_B[2] - dg[1], -d[1] * w_B[0] - dg[2])
    return d + dt * rate
