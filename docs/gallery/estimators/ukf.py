"""The report's unscented Kalman filter in plain NumPy, for all flights at once.

State x = (r, v, e, b_a, b_g), where e are the angles of the attitude's error, R_BI = R(e) R_hat.
A sigma point is at a distance of c times a column of the Cholesky factor of P, c^2 = alpha^2 (n +
kappa), with the noises among the n states. With half the difference a_j and the half sum s_j of a
model at the two points of column j, s_j minus its value f_0 at the mean, the moments are

    mean = f_0 + mu,  mu = sum s_j / c^2
    covariance = sum (a_j a_j^T + s_j s_j^T) / c^2 + (beta - alpha^2) mu mu^T + noise

This is the textbook's transform without its weights near -1e6, which would cancel ten digits. The
differences of points at 0.005 standard deviations cancel four more, so the models are evaluated in
extended precision, where the machine has it. Noise enters both models linearly where e = 0, so its
columns contribute exactly "noise".
"""

import numpy as np

import quad_gym
from quad_gym.rotations import euler_to_dcm

R, V, E, BA, BG = (slice(k, k + 3) for k in range(0, 15, 3))


def apply(A, x):
    """A x of stacked matrices (..., 3, 3) and vectors (..., 3)."""
    return (A @ x[..., np.newaxis])[..., 0]


def unit(x):
    """Vectors scaled to length one."""
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def across(u):
    """I - u u^T, (..., 3, 3)."""
    return np.eye(3) - u[..., :, np.newaxis] * u[..., np.newaxis, :]


def rotation(e):
    """R(e) of 3-1-2 angles, (..., 3, 3), in the precision of e."""
    (cf, ct, cp), (sf, st, sp) = np.moveaxis(np.cos(e), -1, 0), np.moveaxis(np.sin(e), -1, 0)
    rows = [
        [cp * ct - sf * sp * st, ct * sp + cp * sf * st, -cf * st],
        [-cf * sp, cf * cp, sf],
        [cp * st + ct * sf * sp, sp * st - cp * ct * sf, cf * ct],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def euler_rates(e, w):
    """de/dt of 3-1-2 angles e for body rates w."""
    (phi, theta, _), (p, q, r) = np.moveaxis(e, -1, 0), np.moveaxis(w, -1, 0)
    turn = p * np.sin(theta) - r * np.cos(theta)
    rates = p * np.cos(theta) + r * np.sin(theta), q + np.tan(phi) * turn, -turn / np.cos(phi)
    return np.stack(rates, axis=-1)


class PlainUKF(quad_gym.Estimator):
    """The filter of the suites "lab" and "standard", with Euler integration of the prediction."""

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
        self.correct(view)
        return self.estimate()

    def update(self, measurements):
        self.predict(measurements)
        self.correct(measurements)
        return self.estimate()

    def estimate(self):
        s = self.state
        return {
            "position": s.r,
            "velocity": s.v,
            "R_BI": s.R,
            "accel_bias": s.b_a,
            "gyro_bias": s.b_g,
            "covariance": s.P,
        }

    def move(self, dx, P):
        """Add dx to the state; the error angles return to zero."""
        s = self.state
        s.r, s.v, s.b_a, s.b_g = (
            s.r + dx[:, R],
            s.v + dx[:, V],
            s.b_a + dx[:, BA],
            s.b_g + dx[:, BG],
        )
        s.R, s.P = rotation(dx[:, E]) @ s.R, (P + P.transpose(0, 2, 1)) / 2.0

    def transform(self, model, count, choice):
        """mu (n, k), covariance without noise, and the half differences a (n, 15, k), L and c."""
        # a lower factor in which the error angles come first: only three columns are nonlinear
        order = [*range(6, 9), *range(6), *range(9, 15)]
        L = np.empty_like(self.state.P)
        L[:, order] = np.linalg.cholesky(self.state.P[:, order][:, :, order])
        c = choice.alpha * np.sqrt(choice.kappa + count)[:, np.newaxis, np.newaxis]
        step = (c * L.transpose(0, 2, 1)).astype(np.longdouble)
        plus, minus, center = model(step), model(-step), model(0.0 * step[:, :1])
        a, s = (plus - minus) / (2.0 * c), ((plus + minus) / 2.0 - center) / c
        a, s, center = (np.float64(values) for values in (a, s, center))
        mu = s.sum(axis=1) / c[:, 0]
        P = a.transpose(0, 2, 1) @ a + s.transpose(0, 2, 1) @ s
        P += (choice.beta - choice.alpha**2) * mu[:, :, np.newaxis] * mu[:, np.newaxis]
        return center[:, 0] + mu, P, a, L

    def predict(self, m):
        """Predict over a tick with the IMU sample at its start."""
        s, imu, dt = self.state, m.sensors.imu, m.dt
        decay_a, decay_g = (np.exp(-dt / tau) for tau in (imu.accel_bias_tau, imu.gyro_bias_tau))
        force, rate = (m.accel - s.b_a)[:, np.newaxis], (m.gyro - s.b_g)[:, np.newaxis]
        g_I, R_hat = np.array([0.0, 0.0, m.vehicle.gravity]), s.R[:, np.newaxis]

        def model(x):  # the change of (r, v), e, and the change of (b_a, b_g)
            R_BI = rotation(x[..., E]) @ R_hat
            a_I = apply(R_BI.swapaxes(-1, -2), force - x[..., BA]) - g_I
            r = x[..., R] + dt * (v_hat + x[..., V]) + dt**2 / 2.0 * a_I
            e = x[..., E] + dt * euler_rates(x[..., E], rate - x[..., BG])
            b_a = decay_a * x[..., BA] - (1.0 - decay_a) * s.b_a[:, np.newaxis]
            b_g = decay_g * x[..., BG] - (1.0 - decay_g) * s.b_g[:, np.newaxis]
            return np.concatenate([r, x[..., V] + dt * a_I, e, b_a, b_g], axis=-1)

        v_hat = s.v[:, np.newaxis]
        dx, P, _, _ = self.transform(model, np.full(m.count, 27.0), m.sensors.estimator)
        accel, gyro = imu.accel_noise_density**2 * dt, imu.gyro_noise_density**2 * dt
        P[:, R, R] += accel * dt**2 / 4.0 * np.eye(3)
        P[:, R, V] += accel * dt / 2.0 * np.eye(3)
        P[:, V, R] += accel * dt / 2.0 * np.eye(3)
        P[:, V, V] += accel * np.eye(3)
        P[:, E, E] += gyro * np.eye(3)
        P[:, BA, BA] += imu.accel_bias_sigma**2 * (1.0 - decay_a**2) * np.eye(3)
        P[:, BG, BG] += imu.gyro_bias_sigma**2 * (1.0 - decay_g**2) * np.eye(3)
        self.move(dx, P)

    def correct(self, m):
        """Update with position, baseline and features; a flight lacks the rows of the others."""
        s, gnss, camera = self.state, m.sensors.gnss, m.sensors.camera
        choice, blocks = m.sensors.estimator, []  # valid, measured, model, noise

        def noise_of(u, variance):
            """Noise of directions u (n, 3), with a floor along them that rounding cannot use up."""
            floor = np.maximum(choice.direction_variance_floor, 1e-5 * variance)
            return variance * across(u) + floor * np.eye(3)

        if gnss is not None:
            position, baseline = m.gnss_position, m.gnss_baseline
            l_p = np.array(gnss.primary_antenna_B)
            l_b = unit(np.array(gnss.secondary_antenna_B) - l_p)
            noise = np.diag(gnss.position_sigma_I) ** 2 + np.zeros((m.count, 3, 3))
            blocks.append((position.new, position.value, lambda r, R_IB: r + R_IB @ l_p, noise))
            noise = noise_of(s.R.swapaxes(1, 2) @ l_b, gnss.baseline_sigma**2)
            blocks.append((baseline.new, unit(baseline.value), lambda r, R_IB: R_IB @ l_b, noise))
        if camera is not None:
            R_CB, l_c = euler_to_dcm(np.array(camera.attitude)), np.array(camera.position_B)
            for k in range(len(camera.features_I)):
                X_I = m.features[:, np.newaxis, k]

                def direction(r, R_IB, X_I=X_I):
                    X_B = apply(R_IB.swapaxes(-1, -2), X_I - r) - l_c
                    return unit(X_B @ R_CB.T)

                new, pixel = m.pixels.new[:, k], m.pixels.value[:, k]
                ray = np.append(pixel, np.full((m.count, 1), camera.focal_length), axis=1)
                variance = camera.pixel_sigma**2 / (ray**2).sum(axis=1)
                u = unit(ray)
                if choice.bearing_noise_at == "predicted":
                    u = direction(s.r[:, np.newaxis], s.R.swapaxes(1, 2)[:, np.newaxis])[:, 0]
                noise = noise_of(u, variance[:, np.newaxis, np.newaxis])
                blocks.append((new, unit(ray), direction, noise))
        blocks = [block for block in blocks if block[0].any()]
        if blocks:
            self.condition(blocks, choice)

    def condition(self, blocks, choice):
        """Update with blocks of three numbers."""
        s, count, size = self.state, len(blocks[0][0]), 3 * len(blocks)
        new = np.stack([block[0] for block in blocks], axis=1)
        rows = np.repeat(new, 3, axis=1)
        W = np.zeros((count, size, size))  # W noise W^T = I: noises of directions differ 1e4-fold
        for k, (valid, _, _, noise) in enumerate(blocks):
            part = slice(3 * k, 3 * k + 3)
            noise = np.where(valid[:, None, None], noise, np.eye(3))
            W[:, part, part] = np.linalg.inv(np.linalg.cholesky(noise))
        z = np.where(rows, np.concatenate([block[1] for block in blocks], axis=1), 0.0)

        def model(x):
            r, R_BI = s.r[:, np.newaxis] + x[..., R], rotation(x[..., E]) @ s.R[:, np.newaxis]
            z_hat = [block[2](r, R_BI.swapaxes(-1, -2)) for block in blocks]
            z_hat = np.where(rows[:, np.newaxis], np.concatenate(z_hat, axis=-1), 0.0)
            return apply(W[:, np.newaxis], z_hat)

        z_hat, P_zz, a, L = self.transform(model, 15.0 + rows.sum(axis=1), choice)
        P_zz, P_xz, z = P_zz + np.eye(size), L @ a, apply(W, z)
        K = np.linalg.solve(P_zz, P_xz.transpose(0, 2, 1)).transpose(0, 2, 1)
        P = s.P - K @ P_zz @ K.transpose(0, 2, 1)
        measured = new.any(axis=1)
        self.move(
            np.where(measured[:, np.newaxis], apply(K, z - z_hat), 0.0),
            np.where(measured[:, np.newaxis, np.newaxis], P, s.P),
        )
