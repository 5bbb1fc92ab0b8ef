"""The error-state EKF with the updates of filterpy, a flight at a time: a library in the loop.

filterpy's `KalmanFilter` holds the errors and their covariance; its update has Joseph's form. The
flights agree with those of `error_state_ekf` within rounding, at some ten times its cost.
"""

import numpy as np
from filterpy.kalman import KalmanFilter

from quad_gym.rotations import euler_to_dcm

from .error_state_ekf import BA, BG, E, ErrorStateEKF, R, V


class FilterpyEKF(ErrorStateEKF):
    def fuse(self, new, d, jacobian, variance):
        s, size = self.state, d.shape[1]
        kalman, H = KalmanFilter(dim_x=15, dim_z=size), np.zeros((len(d), size, 15))
        for part, block in jacobian:
            H[:, :, part] = block
        noise = np.broadcast_to(variance * np.eye(size), (len(d), size, size))
        for k in np.flatnonzero(new):
            kalman.x, kalman.P = np.zeros(15), s.P[k]
            kalman.update(d[k], R=noise[k], H=H[k])
            s.P[k] = (kalman.P + kalman.P.T) / 2.0
            s.r[k] += kalman.x[R]
            s.v[k] += kalman.x[V]
            s.b_a[k] += kalman.x[BA]
            s.b_g[k] += kalman.x[BG]
            s.R[k] = euler_to_dcm(kalman.x[E]) @ s.R[k]
