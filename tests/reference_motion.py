"""A plain Kalman filter of velocity, heading and error of leveling in complex numbers, by equations
(35) and (36) of docs/filter-heading.md, with full matrices."""

import numpy as np


class PlainMotion:
    """The states v, u and d of `quad_gym.kernels.filter.motion`, and their covariance."""

    def __init__(self, velocity, variance, tilt_variance):
        self.x = np.array([velocity, 0.0, 0.0], dtype=complex)
        self.P = np.diag([variance, 1.0, tilt_variance]).astype(complex)

    def predict(self, A, T):
        """Predict over the time T with the sum A of the force."""
        k, tilt = np.exp(-T / 5.0), 0.3
        F = np.array([[1.0, A, T], [0.0, 1.0, 0.0], [0.0, 0.0, k]])
        Q = 2.0 * np.diag([0.05**2 * T, 0.01**2 * T, tilt**2 * (1.0 - k**2)])
        self.x, self.P = F @ self.x, F @ self.P @ F.conj().T + Q

    def update(self, z, variance):
        """Update with a velocity, whose noise has this variance (of both axes together)."""
        S = self.P[0, 0] + variance
        K, nu = self.P[:, 0] / S, z - self.x[0]
        self.x = self.x + K * nu
        self.P = self.P - np.outer(K, self.P[0])

    def nis(self, z, variance):
        """Normalized innovation squared of a velocity, with two degrees of freedom."""
        return 2.0 * abs(z - self.x[0]) ** 2 / (self.P[0, 0].real + variance)
