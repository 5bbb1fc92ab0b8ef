"""The Crazyflie's own state estimator, for flights in which a simulated one flies on it.

Structure and noise are the defaults of Bitcraze's firmware (crazyflie-firmware, 2025:
`estimator_kalman.c`, `kalman_core.c`; M. W. Mueller, M. Hamer, R. D'Andrea, ICRA 2015). In flight,
thrust is the only force that it assumes besides weight, so that drag looks like an error of
velocity and attitude. No code is copied.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import quad_gym
from quad_gym.rotations import euler_to_dcm

Floats = NDArray[np.float64]

PERIOD = 0.01  #: time between predictions, with the mean of the IMU's samples [s]
LOOP = 1e-3  #: time between additions of noise [s]
ACCEL = (0.5, 0.5, 1.0)  #: noise of accelerations in B, added to velocities [m/s^2]
GYRO = 0.1  #: noise of the gyro, added to the attitude [rad/s]
POSITION = 0.01  #: standard deviation of a position by motion capture [m]
R, V, E = (slice(k, k + 3) for k in (0, 3, 6))
_EYE = np.eye(3)


class OnboardFilter(quad_gym.Estimator):
    """Kalman filter of position, velocity and attitude by gyro, vertical force and positions."""

    state: Any = {  # noqa: RUF012
        "r": np.zeros(3),
        "v": np.zeros(3),
        "R": _EYE,
        "P": 1e-4 * np.eye(9),
        "sum": np.zeros(4),  # of gyro and specific force along z
        "ticks": 0.0,
    }

    def reset(self, view: Any, mask: Any) -> None:
        """Begin with the estimate at the start."""
        self.state.r, self.state.v, self.state.R = view.position, view.velocity, view.R_BI

    def update(self, measurements: Any) -> dict[str, Floats]:
        """Predict every 10 ms, and update with each position."""
        s, m = self.state, measurements
        s.sum += np.column_stack([m.gyro, m.accel[:, 2]])
        s.ticks += 1.0
        every = round(PERIOD / m.dt)
        if s.ticks[0] >= every:
            mean = s.sum / every
            s.sum, s.ticks = np.zeros_like(s.sum), np.zeros_like(s.ticks)
            self._predict(mean[:, :3], mean[:, 3], m.vehicle.gravity)
        fix = m.gnss_position
        if fix.new.any():
            lever_I = np.array(m.sensors.gnss.primary_antenna_B) @ s.R
            self._correct(np.where(fix.new[:, np.newaxis], fix.value - s.r - lever_I, 0.0), fix.new)
        return {"position": s.r, "velocity": s.v, "R_BI": s.R}

    def _predict(self, gyro: Floats, thrust: Floats, gravity: float) -> None:
        """Predict with rates (n, 3) and the thrust over the mass (n,)."""
        s, dt = self.state, PERIOD
        R_IB = s.R.swapaxes(1, 2)
        accel = R_IB[:, :, 2] * thrust[:, np.newaxis] - (0.0, 0.0, gravity)
        s.r += dt * s.v + 0.5 * dt**2 * accel
        s.v += dt * accel
        turn = euler_to_dcm(dt * gyro)
        F = np.tile(np.eye(9), (len(gyro), 1, 1))
        F[:, R, V], F[:, E, E] = dt * _EYE, turn
        speed = dt * thrust[:, np.newaxis]
        F[:, V, 6], F[:, V, 7] = -speed * R_IB[:, :, 1], speed * R_IB[:, :, 0]
        P = F @ s.P @ F.swapaxes(1, 2)
        P[:, V, V] += R_IB @ (dt * LOOP * np.square(ACCEL)[:, np.newaxis] * s.R)
        P[:, E, E] += dt * LOOP * GYRO**2 * _EYE
        s.P, s.R = P, turn @ s.R

    def _correct(self, residual: Floats, new: Any) -> None:
        """Update flights in `new` (n,) with the residual (n, 3) of a position."""
        s = self.state
        K = np.linalg.solve(s.P[:, R, R] + POSITION**2 * _EYE, s.P[:, R]).swapaxes(1, 2)
        K = np.where(new[:, np.newaxis, np.newaxis], K, 0.0)
        P = s.P - K @ s.P[:, R]
        s.P = 0.5 * (P + P.swapaxes(1, 2))
        change = (K @ residual[:, :, np.newaxis])[:, :, 0]
        s.r, s.v = s.r + change[:, R], s.v + change[:, V]
        s.R = euler_to_dcm(change[:, E]) @ s.R
