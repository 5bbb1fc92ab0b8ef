"""GNSS velocity: of the primary antenna.

It measures `z = v + R^T (w x l_p) + v_noise` in I, with body rates w from the gyro. The lever arm's
share depends on the attitude. Filters with slow errors take this into account (`filter/slow.py`):
where a magnetometer gives the heading, it is off by a few degrees, and the share at 6 rad/s by 0.02
m/s. Where two antennas give the heading to half a degree, this is neglected, so that the model is
linear: dz = dv.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.covariance_resets import reset_variances
from quad_gym.kernels.filter.error_state import V
from quad_gym.kernels.filter.rows import lever_column, put_block, put_column
from quad_gym.kernels.maths.linalg import cross, diagonal, keep, load3, load4, load33
from quad_gym.kernels.maths.matrices import load_column3
from quad_gym.kernels.maths.random import six_normals, stream_of
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.lanes import zero_like
from quad_gym.records import DRAW_VELOCITY


@kernel
def measure(flight, p, mask):
    """Measure the antenna's velocity in G, in the lanes `mask`."""
    R_BI, R_IG = quaternion_to_dcm(load4(flight.q)), load33(p.R_IG)
    n, _ = six_normals(stream_of(flight), DRAW_VELOCITY)
    v_I = load3(flight.v) + R_BI.T @ cross(load3(flight.w), load3(p.antenna))
    keep(flight.gnss_velocity, mask, R_IG.T @ (p.velocity_sigma * n + v_I))


@kernel
def expect(flight, p, work, settings, k, valid):
    """Fill rows k to k + 2."""
    R_BI, variance = load33(flight.R_hat), p.velocity_sigma * p.velocity_sigma
    lever_B = cross(load3(flight.w_meas) - load3(flight.b_g_hat), load3(p.antenna))
    z, z_hat = load33(p.R_IG) @ load3(flight.gnss_velocity), load3(flight.v_hat) + R_BI.T @ lever_B
    put_block(work, settings, k, valid, z, z_hat, diagonal((variance, variance, variance)))
    for j in range(9):
        dv = load_column3(flight.L, V, j)
        s = zero_like(dv)
        if settings.slow_states > 0:
            a, s = lever_column(flight, work, settings, j, R_BI, lever_B)
            dv = dv + a
        put_column(work, settings, k, j, valid, dv, s)


@kernel
def reset(work, states, lanes, nu):
    """Reset the velocity."""
    squares = (nu[0] * nu[0], nu[1] * nu[1], nu[2] * nu[2])
    reset_variances(work.P, V, states, lanes, squares)
