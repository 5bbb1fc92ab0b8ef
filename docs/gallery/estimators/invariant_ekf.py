"""An invariant extended Kalman filter on SE_2(3), with the biases of the IMU ("imperfect IEKF").

Attitude, velocity and position are one element X = (R_IB, v, r) of the group SE_2(3), with the
right-invariant error X = exp(xi) X_hat, xi = (xi_r, xi_v, xi_R) in I. Without biases it obeys a
linear equation that does not depend on the trajectory, however large it is,

    d/dt (xi_r, xi_v, xi_R) = (xi_v, g x xi_R, 0),

and a feature of the map has a Jacobian that depends on the attitude only. The same property serves
delayed measurements: X = Y_0 Y, where Y is a trajectory by the same IMU samples that is never
corrected; Y_0 at a time stamp follows from the present one without the samples between them.

Sources: A. Barrau and S. Bonnabel, IEEE Trans. Automatic Control 62(4), 2017; R. Hartley, M.
Ghaffari, R. M. Eustice and J. W. Grizzle, Int. J. Robotics Research 39(4), 2020 (the biases).
"""

import numpy as np

import quad_gym
from quad_gym.rotations import euler_to_dcm

R, V, E, BA, BG = (slice(k, k + 3) for k in range(0, 15, 3))
EYE, STAMPS, GATE = np.eye(3), 41, 5.0  # ticks that are remembered; standard deviations
GNSS = ("gnss_position", "gnss_velocity", "gnss_baseline")


def apply(A, x):
    """A x of stacked matrices (..., 3, 3) and vectors (..., 3)."""
    return (A @ x[..., np.newaxis])[..., 0]


def transposed(A):
    return A.swapaxes(-1, -2)


def cross(x):
    """[x x], (..., 3, 3)."""
    return transposed(np.cross(x[..., np.newaxis, :], EYE))


def exponential(x):
    """The rotation by a vector, and its left Jacobian, (..., 3, 3)."""
    X, angle = cross(x), np.linalg.norm(x, axis=-1)[..., np.newaxis, np.newaxis]
    a, b = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    c = np.where(angle > 1e-3, (1.0 - a) / np.maximum(angle, 1e-3) ** 2, 1.0 / 6.0)
    return EYE + a * X + b * X @ X, EYE + b * X + c * X @ X


class InvariantEKF(quad_gym.Estimator):
    state = {
        "R": EYE,
        "v": np.zeros(3),
        "r": np.zeros(3),
        "b_a": np.zeros(3),
        "b_g": np.zeros(3),
        "P": np.eye(15),
        "Y_R": np.zeros((STAMPS, 3, 3)),
        "Y_v": np.zeros((STAMPS, 3)),
        "Y_r": np.zeros((STAMPS, 3)),
        "w": np.zeros((STAMPS, 3)),  # w: body rates
    }

    def reset(self, view, mask):
        s = self.state
        s.R, s.v, s.r = transposed(view.R_BI), view.velocity, view.position
        s.b_a, s.b_g = view.accel_bias, view.gyro_bias
        to_xi = np.linalg.inv(self.from_xi())
        s.P = to_xi @ view.covariance @ transposed(to_xi)
        s.Y_R, s.Y_v, s.Y_r = s.R[:, None], s.v[:, None], s.r[:, None]
        s.w = (view.gyro_now - s.b_g)[:, None]

    def update(self, m):
        self.predict(m)
        for name in (*GNSS, "magnetometer", "barometer", "pixels"):
            self.correct(m, name)
        s, T = self.state, self.from_xi()
        found = {"position": s.r, "velocity": s.v, "R_BI": transposed(s.R)}
        found |= {"accel_bias": s.b_a, "gyro_bias": s.b_g}
        return found | {"covariance": T @ s.P @ transposed(T)}

    def from_xi(self):
        """Matrices from xi and the biases to the errors of the estimate, (n, 15, 15)."""
        s = self.state
        T = np.tile(np.eye(15), (len(s.r), 1, 1))
        T[:, R, E], T[:, V, E], T[:, E, E] = -cross(s.r), -cross(s.v), transposed(s.R)
        return T

    def predict(self, m):
        s, imu, dt = self.state, m.sensors.imu, m.dt
        self.g = g = np.array([0.0, 0.0, -m.vehicle.gravity])
        f, turn = m.accel - s.b_a, exponential(dt * (m.gyro - s.b_g))[0]
        half = exponential(dt / 2.0 * (m.gyro - s.b_g))[0] if imu.samples == "average" else EYE

        def moved(R_IB, v, r):
            a = apply(R_IB @ half, f) + g
            return R_IB @ turn, v + dt * a, r + dt * v + dt**2 / 2.0 * a

        (now, _), (before, _) = self.slot(m, 0.0), self.slot(m, dt)
        s.R, s.v, s.r = moved(s.R, s.v, s.r)
        s.Y_R[now], s.Y_v[now], s.Y_r[now] = moved(s.Y_R[before], s.Y_v[before], s.Y_r[before])
        s.w[now] = m.gyro_now - s.b_g
        decay_a, decay_g = np.exp(-dt / imu.accel_bias_tau), np.exp(-dt / imu.gyro_bias_tau)
        s.b_a, s.b_g = decay_a * s.b_a, decay_g * s.b_g
        F = self.transition(np.full(m.count, dt), s.R, s.v, s.r)
        B = F[:, :9, 9:]  # samples have errors like biases: noise, vibration, scale and alignment
        variance = np.tile(np.repeat([imu.accel_noise**2, imu.gyro_noise**2], 3), (m.count, 1, 1))
        variance[..., :3] += imu.accel_error_noise**2 * ((f + g) ** 2).sum(axis=1)[:, None, None]
        samples = B * variance @ transposed(B)
        F[:, BA, BA], F[:, BG, BG] = decay_a * EYE, decay_g * EYE
        s.P = F @ s.P @ transposed(F)
        s.P[:, :9, :9] += samples
        s.P[:, BA, BA] += imu.accel_bias_sigma**2 * (1.0 - decay_a**2) * EYE
        s.P[:, BG, BG] += imu.gyro_bias_sigma**2 * (1.0 - decay_g**2) * EYE

    def transition(self, T, R_IB, v, r):
        """The transition of xi and the biases over times T (n,), (n, 15, 15)."""
        F, T = np.tile(np.eye(15), (len(T), 1, 1)), T[:, None, None]
        F[:, R, V], F[:, V, E], F[:, R, E] = T * EYE, T * cross(self.g), T**2 / 2.0 * cross(self.g)
        F[:, R, BA], F[:, V, BA], F[:, E, BG] = -(T**2) / 2.0 * R_IB, -T * R_IB, -T * R_IB
        F[:, R, BG], F[:, V, BG] = -T * cross(r) @ R_IB, -T * cross(v) @ R_IB
        return F

    def slot(self, m, age, rows=slice(None)):
        """Place of an earlier instant in the memory of flights, and the time since then [s]."""
        ticks = np.rint(m.time[rows] / m.dt).astype(int)
        back = np.minimum(round(age / m.dt), ticks)
        return (np.arange(m.count)[rows], (ticks - back) % STAMPS), back * m.dt

    def at_stamp(self, m, age, rows):
        """R_IB, v, r and body rates at the time stamp, and the transition of xi back to it."""
        s, (now, _), (then, T) = self.state, self.slot(m, 0.0, rows), self.slot(m, age, rows)
        R_IB, v, r = s.R[rows], s.v[rows], s.r[rows]
        back, T = self.transition(-T, R_IB, v, r), T[:, None]
        R_0 = R_IB @ transposed(s.Y_R[now])
        v_0, r_0 = v - apply(R_0, s.Y_v[now]), r - apply(R_0, s.Y_r[now])
        g_0 = self.g - apply(R_0, self.g)  # d/dt (r_0, v_0) = (v_0, g_0)
        r = r_0 - T * v_0 + T**2 / 2.0 * g_0 + apply(R_0, s.Y_r[then])
        return R_0 @ s.Y_R[then], v_0 - T * g_0 + apply(R_0, s.Y_v[then]), r, s.w[then], back

    # Models of the sensors: prediction, its Jacobian by the parts of xi, and variance of the noise

    def gnss_position(self, suite, R_IB, v, r, w, X_I):
        gnss = suite.gnss
        r = r + R_IB @ gnss.primary_antenna_B
        variance = np.square(gnss.position_sigma_I) + np.square(gnss.drift_sigma_I)
        return r, [(R, EYE), (E, -cross(r))], variance

    def gnss_velocity(self, suite, R_IB, v, r, w, X_I):
        gnss = suite.gnss
        v = v + apply(R_IB, np.cross(w, gnss.primary_antenna_B))
        return v, [(V, EYE), (E, -cross(v))], gnss.velocity_sigma**2

    def gnss_baseline(self, suite, R_IB, v, r, w, X_I):
        gnss = suite.gnss
        b_I, length = R_IB @ gnss.baseline_B, np.linalg.norm(gnss.baseline_B)
        return b_I, [(E, -cross(b_I))], (length * gnss.baseline_noise) ** 2

    def magnetometer(self, suite, R_IB, v, r, w, X_I):
        sensor, R_BI = suite.magnetometer, transposed(R_IB)
        m_I = np.array(sensor.field_I)
        variance = sensor.noise_sigma**2 + sensor.hard_iron_sigma**2
        return R_BI @ m_I, [(E, R_BI @ cross(m_I))], variance

    def barometer(self, suite, R_IB, v, r, w, X_I):
        variance = suite.barometer.noise_sigma**2 + suite.barometer.bias_sigma**2
        return r[:, 2:], [(R, EYE[2:]), (E, -cross(r)[:, 2:])], variance

    def pixels(self, suite, R_IB, v, r, w, X_I):
        camera = suite.camera
        R_CI = euler_to_dcm(np.array(camera.attitude)) @ transposed(R_IB)
        center_I = (r + R_IB @ camera.position_B)[:, None]
        x, y, z = np.moveaxis((X_I - center_I) @ transposed(R_CI), -1, 0)
        z = np.maximum(z, 0.1)
        one, none = np.ones_like(z), np.zeros_like(z)
        J = np.array([[one, none, -x / z], [none, one, -y / z]]) * camera.focal_length / z
        J = np.moveaxis(J, (0, 1), (2, 3)) @ R_CI[:, None]
        blur = camera.blur**2 * (w**2).sum(axis=1)[:, None]
        pixels = camera.focal_length * np.stack([x / z, y / z], axis=-1)
        return pixels, [(R, -J), (E, J @ cross(X_I))], camera.pixel_sigma**2 + blur

    def correct(self, m, name):
        """Update the flights for which a sensor has measured, without outliers."""
        reading, s = getattr(m, name), self.state
        if reading is None or not reading.new.any():
            return
        rows = np.flatnonzero(reading.new.reshape(m.count, -1).any(axis=1))
        *then, back = self.at_stamp(m, reading.age, rows)
        predicted, jacobian, variance = getattr(self, name)(m.sensors, *then, m.features[rows])
        d = reading.value[rows].reshape(len(rows), -1) - predicted.reshape(len(rows), -1)
        H, size, P = np.zeros((*d.shape, 15)), d.shape[1], s.P[rows]
        for part, block in jacobian:
            H[..., part] = block.reshape(-1, size, 3)
        H = H @ back
        sigma = np.sqrt((H @ P * H).sum(axis=-1) + variance)
        fits = (np.abs(d) < GATE * sigma).reshape(len(rows), reading.new[0].size, -1).all(axis=2)
        valid = np.repeat(fits, size // fits.shape[1], axis=1)  # neither missing nor an outlier
        H, d = np.where(valid[..., None], H, 0.0), np.where(valid, d, 0.0)
        P_xz = P @ transposed(H)
        P_zz = H @ P_xz + np.eye(size) * np.broadcast_to(variance, d.shape)[..., None]
        K = transposed(np.linalg.solve(P_zz, transposed(P_xz)))
        P, dx = P - K @ transposed(P_xz), apply(K, d)
        turn, J = exponential(dx[:, E])
        s.R[rows], s.P[rows] = turn @ s.R[rows], (P + transposed(P)) / 2.0
        s.v[rows] = apply(turn, s.v[rows]) + apply(J, dx[:, V])
        s.r[rows] = apply(turn, s.r[rows]) + apply(J, dx[:, R])
        s.b_a[rows] += dx[:, BA]
        s.b_g[rows] += dx[:, BG]
