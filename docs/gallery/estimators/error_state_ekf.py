"""An error-state extended Kalman filter: the form of PX4's EKF2 and of most flight controllers.

The nominal state (r, v, R_BI, b_a, b_g) is integrated. The covariance is the error's, (r, v, e,
b_a, b_g) with R_BI = (1 - [e x]) R_hat. Each sensor updates with the Jacobian of its model; its
time-correlated errors are not estimated, but added to the noise, and latency is ignored.
"""

import numpy as np

import quad_gym
from quad_gym.rotations import euler_to_dcm

R, V, E, BA, BG = (slice(k, k + 3) for k in range(0, 15, 3))
EYE = np.eye(3)


def apply(A, x):
    """A x of stacked matrices (..., 3, 3) and vectors (..., 3)."""
    return (A @ x[..., np.newaxis])[..., 0]


def cross(x):
    """[x x], (..., 3, 3)."""
    return np.cross(x[..., np.newaxis, :], EYE).swapaxes(-1, -2)


class ErrorStateEKF(quad_gym.Estimator):
    state = {
        "r": np.zeros(3),
        "v": np.zeros(3),
        "R": np.eye(3),
        "b_a": np.zeros(3),
        "b_g": np.zeros(3),
        "P": np.eye(15),
    }

    def reset(self, view, mask):
        s = self.state
        s.r, s.v, s.R, s.P = view.position, view.velocity, view.R_BI, view.covariance
        s.b_a, s.b_g = view.accel_bias, view.gyro_bias

    def update(self, m):
        self.predict(m)
        self.correct(m)
        s = self.state
        return {
            "position": s.r,
            "velocity": s.v,
            "R_BI": s.R,
            "accel_bias": s.b_a,
            "gyro_bias": s.b_g,
            "covariance": s.P,
        }

    def predict(self, m):
        s, imu, dt = self.state, m.sensors.imu, m.dt
        decay_a, decay_g = np.exp(-dt / imu.accel_bias_tau), np.exp(-dt / imu.gyro_bias_tau)
        f, turn = m.accel - s.b_a, euler_to_dcm(dt * (m.gyro - s.b_g))
        half = euler_to_dcm(dt / 2.0 * (m.gyro - s.b_g)) @ s.R  # attitude amid the tick
        R_IB = (half if imu.samples == "average" else s.R).transpose(0, 2, 1)
        a_I = apply(R_IB, f) - (0.0, 0.0, m.vehicle.gravity)
        s.r += dt * s.v + dt**2 / 2.0 * a_I
        s.v += dt * a_I
        s.R = turn @ s.R
        s.b_a *= decay_a
        s.b_g *= decay_g
        F = np.tile(np.eye(15), (m.count, 1, 1))
        F[:, R, V] = dt * EYE
        F[:, V, E], F[:, V, BA] = -dt * R_IB @ cross(f), -dt * R_IB
        F[:, R, E], F[:, R, BA] = dt / 2.0 * F[:, V, E], dt / 2.0 * F[:, V, BA]
        F[:, E, E], F[:, E, BG] = turn, -dt * EYE
        F[:, BA, BA], F[:, BG, BG] = decay_a * EYE, decay_g * EYE
        noise = np.repeat(
            [
                0.0,
                imu.accel_noise_density**2 * dt,
                imu.gyro_noise_density**2 * dt,
                imu.accel_bias_sigma**2 * (1.0 - decay_a**2),
                imu.gyro_bias_sigma**2 * (1.0 - decay_g**2),
            ],
            3,
        )
        s.P = F @ s.P @ F.transpose(0, 2, 1) + np.diag(noise)

    def correct(self, m):
        s, gnss = self.state, m.sensors.gnss
        R_IB = s.R.transpose(0, 2, 1)
        if gnss is not None and m.gnss_position.new.any():
            lever, w = np.array(gnss.primary_antenna_B), m.gyro_now - s.b_g
            variance = np.square(gnss.position_sigma_I) + np.square(gnss.drift_sigma_I)
            d = m.gnss_position.value - s.r - R_IB @ lever
            self.fuse(m.gnss_position.new, d, [(R, EYE), (E, -R_IB @ cross(lever))], variance)
            if m.gnss_velocity is not None:
                v_B = np.cross(w, lever)
                d = m.gnss_velocity.value - s.v - apply(R_IB, v_B)
                variance = gnss.velocity_sigma**2
                self.fuse(m.gnss_velocity.new, d, [(V, EYE), (E, -R_IB @ cross(v_B))], variance)
            if m.gnss_baseline is not None:
                u_B = np.array(gnss.secondary_antenna_B) - lever
                u_B /= np.linalg.norm(u_B)
                d = m.gnss_baseline.value
                d = d / np.linalg.norm(d, axis=1, keepdims=True) - R_IB @ u_B
                variance = gnss.baseline_sigma**2
                self.fuse(m.gnss_baseline.new, d, [(E, -R_IB @ cross(u_B))], variance)
        if m.magnetometer is not None and m.magnetometer.new.any():
            sensor = m.sensors.magnetometer
            variance = sensor.noise_sigma**2 + sensor.hard_iron_sigma**2
            m_B = s.R @ np.array(sensor.field_I)
            d = m.magnetometer.value - m_B
            self.fuse(m.magnetometer.new, d, [(E, cross(m_B))], variance)
        if m.barometer is not None and m.barometer.new.any():
            sensor = m.sensors.barometer
            d, H = m.barometer.value[:, None] - s.r[:, 2:], [(R, EYE[2:])]
            variance = sensor.noise_sigma**2 + sensor.bias_sigma**2
            self.fuse(m.barometer.new, d, H, variance)
        if m.pixels is not None and m.pixels.new.any():
            self.correct_by_camera(m)

    def correct_by_camera(self, m):
        """Update with the features one by one."""
        camera = m.sensors.camera
        R_CB, l_c = euler_to_dcm(np.array(camera.attitude)), np.array(camera.position_B)
        blur = camera.blur * np.linalg.norm(m.gyro_now - self.state.b_g, axis=1)
        variance = (camera.pixel_sigma**2 + blur**2)[:, None, None]
        for k in range(m.features.shape[1]):
            new = m.pixels.new[:, k]
            if new.any():
                X_B = apply(self.state.R, m.features[:, k] - self.state.r)
                x, y, z = np.moveaxis((X_B - l_c) @ R_CB.T, -1, 0)
                z = np.maximum(z, 0.1)
                one, none = np.ones_like(z), np.zeros_like(z)
                J = np.array([[one, none, -x / z], [none, one, -y / z]]) * camera.focal_length / z
                J = np.moveaxis(J, -1, 0) @ R_CB
                d = m.pixels.value[:, k] - camera.focal_length * np.stack([x / z, y / z], axis=1)
                jacobian = [(R, -J @ self.state.R), (E, J @ cross(X_B))]
                self.fuse(new, d, jacobian, variance)

    def fuse(self, new, d, jacobian, variance):
        """Update flights in `new` with residuals d (n, k), by the blocks of the Jacobian."""
        s, (count, size) = self.state, d.shape
        H = np.zeros((count, size, 15))
        for part, block in jacobian:
            H[:, :, part] = block
        H[~new], d = 0.0, np.where(new[:, None], d, 0.0)
        P_xz = s.P @ H.transpose(0, 2, 1)
        P_zz = H @ P_xz + variance * np.eye(size)
        K = np.linalg.solve(P_zz, P_xz.transpose(0, 2, 1)).transpose(0, 2, 1)
        P, dx = s.P - K @ P_xz.transpose(0, 2, 1), apply(K, d)
        s.P = (P + P.transpose(0, 2, 1)) / 2.0
        s.r, s.v, s.b_a, s.b_g = (
            s.r + dx[:, R],
            s.v + dx[:, V],
            s.b_a + dx[:, BA],
            s.b_g + dx[:, BG],
        )
        s.R = euler_to_dcm(dx[:, E]) @ s.R
