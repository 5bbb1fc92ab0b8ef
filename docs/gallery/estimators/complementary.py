"""A complementary filter with constant gains, as many hobby vehicles have it: no covariance.

The IMU is integrated. Each GNSS fix pulls position and velocity toward itself; as a tilt error e
adds R_IB (e x f) to the acceleration, it corrects the tilt, too, and the accelerometer's bias along
the thrust. The heading follows the baseline or the magnetometer. It does not use the camera, so
that suites without GNSS are refused.
"""

import numpy as np

import quad_gym
from quad_gym.rotations import euler_to_dcm


def apply(A, x):
    """A x of stacked matrices (..., 3, 3) and vectors (..., 3)."""
    return (A @ x[..., np.newaxis])[..., 0]


class Complementary(quad_gym.Estimator):
    state = {
        "r": np.zeros(3),
        "v": np.zeros(3),
        "R": np.eye(3),
        "b_a": np.zeros(3),
        "b_g": np.zeros(3),
    }

    def __init__(self, bandwidth=1.0, heading=0.3):
        self.bandwidth, self.heading = bandwidth, heading  # both in rad/s

    def reset(self, view, mask):
        if view.sensors.gnss is None:
            raise ValueError("Complementary needs sensors with GNSS, got a suite without")
        self.state.r, self.state.v, self.state.R = view.position, view.velocity, view.R_BI

    def update(self, m):
        s, gnss, k = self.state, m.sensors.gnss, self.bandwidth
        s.R = euler_to_dcm(m.dt * (m.gyro - s.b_g)) @ s.R
        R_IB, f = s.R.transpose(0, 2, 1), m.accel - s.b_a
        s.r += m.dt * s.v
        s.v += m.dt * (apply(R_IB, f) - (0.0, 0.0, m.vehicle.gravity))
        e = np.zeros((m.count, 3))  # rotation from the estimated to the true body frame
        if m.gnss_position.new.any():
            antenna = s.r + R_IB @ gnss.primary_antenna_B
            error = np.where(m.gnss_position.new[:, None], m.gnss_position.value - antenna, 0.0)
            error /= gnss.rate
            s.r += 3.0 * k * error
            s.v += 3.0 * k**2 * error
            u = k**3 * apply(s.R, error) / (f**2).sum(axis=1, keepdims=True)
            e += np.cross(f, u)
            s.b_a -= f * (f * u).sum(axis=1, keepdims=True)
        if m.gnss_baseline is not None:
            baseline_I = R_IB @ (np.array(gnss.secondary_antenna_B) - gnss.primary_antenna_B)
            e += self.turn(m.gnss_baseline.new, baseline_I, m.gnss_baseline.value, gnss.rate)
        elif m.magnetometer is not None:
            magnetometer, field_I = m.sensors.magnetometer, apply(R_IB, m.magnetometer.value)
            e += self.turn(m.magnetometer.new, field_I, magnetometer.field_I, magnetometer.rate)
        s.b_g -= 0.1 * k * e
        s.R = euler_to_dcm(e) @ s.R
        return {
            "position": s.r,
            "velocity": s.v,
            "R_BI": s.R,
            "accel_bias": s.b_a,
            "gyro_bias": s.b_g,
        }

    def turn(self, new, estimated_I, true_I, rate):
        """Correction of the attitude about the vertical, from one direction to the other."""
        (x, y), (x_true, y_true) = np.moveaxis(estimated_I, -1, 0)[:2], np.transpose(true_I)[:2]
        sine = (x * y_true - y * x_true) / np.hypot(x, y) / np.hypot(x_true, y_true)
        sine = np.where(new, sine, 0.0)
        return self.heading / rate * sine[:, np.newaxis] * self.state.R[:, :, 2]
