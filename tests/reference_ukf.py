"""A plain augmented unscented Kalman filter, written from the equations: the truth for the package.

It uses no structure: the noise is part of the state, every sigma point is evaluated, and the
weights are the textbook's, near -1e6. Their cancellation costs about ten digits, so that neither
float64 nor an 80-bit long double (off by 1e-9 m) can serve as truth. With `number=decimal.Decimal`,
the filter computes in as many digits as the decimal context has. In float64, it is the plain NumPy
filter in comparisons of speed. `PlainEKF` differentiates the same models numerically.

The state is (r, v, e, b_a, b_g) with R_BI = R(e) Rbar_BI and e = 0 after each step. The prediction
noise is (v_g, v_g2, v_a, v_a2). If GNSS positions drift, the slow error d follows b_g in the state,
and its driving noise is the last part of the noise.
"""

from decimal import Decimal

import numpy as np

WGS84_A, WGS84_INVERSE_FLATTENING = 6378137, "298.257223563"


TOLERANCES = {"position": 1e-9, "velocity": 1e-8, "R_BI": 1e-9, "accel_bias": 1e-7}
TOLERANCES |= {"gyro_bias": 1e-10}
"""Tolerances of filters in floats against these filters in 45 digits."""


def array_of(number, values):
    """`values` as an array of the number type: np.float64, np.longdouble or Decimal."""
    convert = np.frompyfunc(number, 1, 1)
    return np.asarray(convert(np.asarray(values)), object if number is Decimal else number)


def eye_of(number, n=3):
    return array_of(number, np.eye(n))


def cos_sin(x):
    """Cosine and sine, by their series for types without NumPy functions."""
    if x.dtype != object:
        return np.cos(x), np.sin(x)
    terms, cosine, sine, order = 1 + 0 * x, 0 * x, 0 * x, 0
    while order < 4 or abs(terms).max() > Decimal("1e-45"):
        if order % 2 == 0:
            cosine = cosine + terms if order % 4 == 0 else cosine - terms
        else:
            sine = sine + terms if order % 4 == 1 else sine - terms
        order += 1
        terms = terms * x / order
    return cosine, sine


def rotation_312(e):
    """R(e) of 3-1-2 Euler angles (..., 3) = (phi, theta, psi): R_y(theta) R_x(phi) R_z(psi)."""
    (cf, ct, cp), (sf, st, sp) = (np.moveaxis(values, -1, 0) for values in cos_sin(e))
    rows = [
        [cp * ct - sf * sp * st, ct * sp + cp * sf * st, -cf * st],
        [-cf * sp, cf * cp, sf],
        [cp * st + ct * sf * sp, sp * st - cp * ct * sf, cf * ct],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def euler_rate_matrix(e):
    """S(phi, theta) of de/dt = S w_B, (..., 3, 3)."""
    (cf, ct, _), (sf, st, _) = (np.moveaxis(values, -1, 0) for values in cos_sin(e))
    nought = 0 * cf
    rows = [[cf * ct, nought, cf * st], [sf * st, cf, -ct * sf], [-st, nought, ct]]
    S = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return S / cf[..., np.newaxis, np.newaxis]


def turn_by(vector):
    """exp(-[vector x]) by Rodrigues' formula: the attitude after a turn by `vector`."""
    x, y, z = vector
    cross = np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]])
    angle = np.sqrt(vector @ vector)
    eye = np.eye(3).astype(int) + 0 * cross
    if angle == 0:
        return eye
    (cosine,), (sine,) = cos_sin(np.array([angle]))
    return eye - sine / angle * cross + (1 - cosine) / angle**2 * (cross @ cross)


def inverse33(M):
    """The inverse of a 3 x 3 matrix of any number type, by cross products."""
    a, b, c = M.T
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)]) / (a @ np.cross(b, c))


def east_north_up(r_G, number=np.float64):
    """R_IG at a point in ECEF: rows east, north, up at its geodetic latitude and longitude."""
    x, y, z = array_of(number, r_G)
    f = 1 / number(WGS84_INVERSE_FLATTENING)
    e2 = f * (2 - f)
    p = np.sqrt(x * x + y * y)
    tangent = z / p / (1 - e2)
    for _ in range(60):
        sin_lat = tangent / np.sqrt(1 + tangent**2)
        N = WGS84_A / np.sqrt(1 - e2 * sin_lat**2)
        tangent = (z + e2 * N * sin_lat) / p
    up = unit(np.array([x, y, tangent * p]))
    east = unit(np.array([-y, x, 0 * x]))
    return np.stack([east, np.cross(up, east), up])


def unit(v):
    """Vectors (..., 3) scaled to length one."""
    return v / np.sqrt((v * v).sum(axis=-1, keepdims=True))


def cholesky(P):
    """Lower Cholesky factor; `numpy.linalg` supports only float64."""
    if P.dtype == np.float64:
        return np.linalg.cholesky(P)
    L = 0 * P
    for j in range(len(P)):
        pivot = P[j, j] - L[j, :j] @ L[j, :j]
        if not pivot > 0:
            raise np.linalg.LinAlgError("matrix is not positive definite")
        L[j, j] = np.sqrt(pivot)
        L[j + 1 :, j] = (P[j + 1 :, j] - L[j + 1 :, :j] @ L[j, :j]) / L[j, j]
    return L


def root(P):
    """Root of P with the columns of sigma points: the lower factor with the error angles first."""
    order = [*range(6, 9), *range(6), *range(9, len(P))]
    found = 0 * P
    found[order] = cholesky(P[np.ix_(order, order)])
    return found


def solve_positive_definite(P, B):
    """P^-1 B."""
    if P.dtype == np.float64:
        return np.linalg.solve(P, B)
    L, X = cholesky(P), B.copy()
    for i in range(len(P)):
        X[i] = (X[i] - L[i, :i] @ X[:i]) / L[i, i]
    for i in reversed(range(len(P))):
        X[i] = (X[i] - L[i + 1 :, i] @ X[i + 1 :]) / L[i, i]
    return X


def block_diagonal(*blocks):
    n, k = sum(len(block) for block in blocks), 0
    whole = np.zeros((n, n), blocks[0].dtype)
    for block in blocks:
        whole[k : k + len(block), k : k + len(block)] = block
        k += len(block)
    return whole


def attitude_from_two_pairs(u_B, v_B, u_I, v_I):
    """Solve Wahba's problem for two pairs of equal weight: their sums and differences align."""

    def triad(u, v):
        s, d = unit(u + v), unit(u - v)
        return np.stack([s, d, np.cross(s, d)], axis=-1)

    return triad(u_B, v_B) @ triad(u_I, v_I).T


class PlainUKF:
    """Filter with the methods of `quad_gym.estimation.UnscentedKalmanFilter`, in any float type."""

    def __init__(self, sensors, number=np.float64):
        self.number, self.sensors = number, sensors
        self.zeros, eye, array = array_of(number, np.zeros(12)), eye_of(number), self._array
        imu, gnss, choice = sensors.imu, sensors.gnss, sensors.estimator
        self.alpha, self.beta, self.kappa = (
            number(choice.alpha),
            number(choice.beta),
            number(choice.kappa),
        )
        self.g_I = array([0.0, 0.0, choice.gravity])
        self.floor = number(choice.direction_variance_floor)
        self.R_IG = east_north_up(gnss.reference_antenna_G, number)
        self.l_p = array(gnss.primary_antenna_B)
        self.l_b = array(gnss.secondary_antenna_B) - self.l_p
        self.R_position = eye * array(gnss.position_sigma_I) ** 2
        self.drifts, self.states = any(gnss.drift_sigma_I), 18 if any(gnss.drift_sigma_I) else 15
        self.d = self.zeros[: self.states - 15]
        self.baseline_variance = number(gnss.baseline_sigma) ** 2
        self.features = array(np.zeros((0, 3)))
        if sensors.camera is not None:
            self.features = array(sensors.camera.features_I)
            self.l_c = array(sensors.camera.position_B)
            self.R_CB = rotation_312(array(sensors.camera.attitude))

        self.dt = 1 / number(imu.rate)
        self.decay, drive = {}, {}
        for kind in ("accel", "gyro"):
            decay = np.exp(-self.dt / number(getattr(imu, f"{kind}_bias_tau")))
            sigma = number(getattr(imu, f"{kind}_bias_sigma"))
            self.decay[kind], drive[kind] = decay, sigma**2 * (1 - decay**2) * eye
        Q_a = number(imu.accel_noise_density) ** 2 / self.dt * eye
        Q_g = number(imu.gyro_noise_density) ** 2 / self.dt * eye
        self.Q = block_diagonal(Q_g, drive["gyro"], Q_a, drive["accel"])
        if self.drifts:
            self.zeros = array_of(number, np.zeros(15))
            self.decay["drift"] = np.exp(-self.dt / number(gnss.drift_tau))
            variance = array(gnss.drift_sigma_I) ** 2 * (1 - self.decay["drift"] ** 2)
            self.Q = block_diagonal(self.Q, eye_of(number) * variance)

    def _array(self, values):
        return array_of(self.number, values)

    # ---- the unscented transform ----

    def _sigma_points(self, x, P):
        """Points (2n + 1, n), and the weights of mean and covariance."""
        n = len(x)
        lam = self.alpha**2 * (self.kappa + n) - n
        offsets = np.sqrt(n + lam) * root(P).T
        points = np.concatenate([x[np.newaxis], x + offsets, x - offsets])
        weights = array_of(self.number, np.ones(2 * n + 1)) / (2 * (n + lam))
        weights[0] = lam / (n + lam)
        covariance_weights = weights.copy()
        covariance_weights[0] += 1 - self.alpha**2 + self.beta
        return points, weights, covariance_weights

    def _inject(self, x, P):
        self.r, self.v, e, self.b_a, self.b_g = x[:3], x[3:6], x[6:9], x[9:12], x[12:15]
        self.d = x[15:]
        self.R = rotation_312(e) @ self.R
        self.P = (P + P.T) / 2
        if self.sensors.estimator.attitude_reset:
            turn = self._turn(e)
            self.P = turn @ self.P @ turn.T

    def _turn(self, e):
        turn = eye_of(self.number, self.states)
        turn[6:9, 6:9] = inverse33(euler_rate_matrix(e[np.newaxis])[0])
        return turn

    def _state(self):
        return np.concatenate([self.r, self.v, self.zeros[:3], self.b_a, self.b_g, self.d])

    # ---- the cycle ----

    def initialize(self, gnss_position_G, gnss_baseline_G):
        up = self._array([0.0, 0.0, 1.0])
        baseline_I = unit(self.R_IG @ self._array(gnss_baseline_G))
        self.R = attitude_from_two_pairs(unit(self.l_b), up, baseline_I, up)
        self.r = self.R_IG @ self._array(gnss_position_G) - self.R.T @ self.l_p
        self.v, self.b_a, self.b_g = (self.zeros[:3] for _ in range(3))
        eye, choice, imu = eye_of(self.number), self.sensors.estimator, self.sensors.imu
        scale = self.number(choice.initial_covariance_scale)
        self.P = block_diagonal(
            scale * self.R_position,
            self.number(choice.initial_velocity_variance) * eye,
            scale * self.baseline_variance * eye,
            self.number(imu.accel_bias_sigma) ** 2 * eye,
            self.number(imu.gyro_bias_sigma) ** 2 * eye,
        )
        self.d = self.zeros[: self.states - 15]
        if self.drifts:  # zero, with a variance that keeps P positive definite
            self.P = block_diagonal(self.P, self.number(1e-30) * eye)

    def predict(self, gyro, accel):
        w_B, f_B = self._array(gyro), self._array(accel)
        x0 = np.concatenate([self._state(), self.zeros])
        mean, P = self._transform(
            lambda points: self._process(points, w_B, f_B), x0, block_diagonal(self.P, self.Q)
        )
        if self.sensors.estimator.integration == "midpoint":
            self.R = turn_by(self.dt * (w_B - self.b_g)) @ self.R
        self._inject(mean, P)

    def _transform(self, function, x0, P0):
        """Mean and covariance of a function of a random vector."""
        points, w_mean, w_cov = self._sigma_points(x0, P0)
        after = function(points)
        mean = w_mean @ after
        deviations = after - mean
        return mean, (w_cov * deviations.T) @ deviations

    def _process(self, points, w_B, f_B):
        """States (n, 15 or 18) after a tick, from states with noise before it."""
        r, v, e, b_a, b_g = np.split(points[:, :15], 5, axis=1)
        noise = points[:, self.states :]
        v_g, v_g2, v_a, v_a2 = np.split(noise[:, :12], 4, axis=1)
        dt, R_BI = self.dt, rotation_312(e) @ self.R
        force = f_B - b_a - v_a
        if self.sensors.estimator.integration == "midpoint":
            half = turn_by(dt / 2 * (w_B - self.b_g))
            error = b_g - self.b_g + v_g
            force = (force - dt / 2 * np.cross(error, f_B - self.b_a)) @ half
            e_after = (e @ half.T - dt * error) @ half.T
        else:
            rate = (euler_rate_matrix(e) @ (w_B - b_g - v_g)[:, :, np.newaxis])[:, :, 0]
            e_after = e + dt * rate
        a_I = (force[:, np.newaxis] @ R_BI)[:, 0] - self.g_I
        drift = [self.decay["drift"] * points[:, 15:18] + noise[:, 12:]] if self.drifts else []
        return np.concatenate(
            [
                r + v * dt + a_I * dt**2 / 2,
                v + a_I * dt,
                e_after,
                self.decay["accel"] * b_a + v_a2,
                self.decay["gyro"] * b_g + v_g2,
                *drift,
            ],
            axis=1,
        )

    def update(self, gnss_position_G=None, gnss_baseline_G=None, pixels=None):
        measured, noises, models = [], [], []
        if gnss_position_G is not None:
            measured.append(self.R_IG @ self._array(gnss_position_G))
            noises.append(self.R_position)
            models.append(lambda r, R, d: r + self.l_p @ R + d)
        if gnss_baseline_G is not None:
            measured.append(unit(self.R_IG @ self._array(gnss_baseline_G)))
            models.append(lambda r, R, d: unit(self.l_b @ R))
            noises.append(self._direction_noise(unit(self.R.T @ self.l_b), self.baseline_variance))
        for X_I, pixel in zip(self.features, [] if pixels is None else pixels, strict=False):
            if np.isfinite(pixel).all():
                self._add_feature(X_I, pixel, measured, noises, models)
        if not measured:
            return
        self._condition(np.concatenate(measured), block_diagonal(*noises), models)

    def _predicted(self, models, points):
        """Predicted measurements (n, n_z) of states (n, 15 or more)."""
        r, R_BI = points[:, :3], rotation_312(points[:, 6:9]) @ self.R
        d = points[:, 15:18] if self.drifts else 0 * r
        return np.concatenate([model(r, R_BI, d) for model in models], axis=1)

    def _condition(self, z, noise, models):
        x0 = np.concatenate([self._state(), self._array(np.zeros(len(z)))])
        points, w_mean, w_cov = self._sigma_points(x0, block_diagonal(self.P, noise))
        Z = self._predicted(models, points) + points[:, self.states :]
        z_mean = w_mean @ Z
        states = points[:, : self.states]
        x_mean = w_mean @ states
        dX, dZ = states - x_mean, Z - z_mean
        P_zz, P_xz = (w_cov * dZ.T) @ dZ, (w_cov * dX.T) @ dZ
        self.innovation, self.innovation_covariance, self.prediction = z - z_mean, P_zz, Z[0]
        K = solve_positive_definite(P_zz, np.ascontiguousarray(P_xz.T)).T
        self._inject(x_mean + K @ (z - z_mean), self.P - K @ P_zz @ K.T)

    def _add_feature(self, X_I, pixel, measured, noises, models):
        camera = self.sensors.camera
        v = self._array([pixel[0], pixel[1], self.number(camera.focal_length)])

        def direction(r, R, d):
            to_feature = X_I - r - self.l_c @ R
            return unit((R @ to_feature[..., np.newaxis])[..., 0] @ self.R_CB.T)

        variance = self.number(camera.pixel_sigma) ** 2 / (v @ v)
        across = unit(v)
        if self.sensors.estimator.bearing_noise_at != "measured":
            across = direction(self.r, self.R, self.d)
        noise = self._direction_noise(across, variance)
        if self.sensors.estimator.bearing_noise_at == "pinhole":
            projector = eye_of(self.number) - np.outer(across, across)
            in_image = self._array(np.diag([1.0, 1.0, 0.0]))
            noise = variance * projector @ in_image @ projector + self._floor(variance)
        measured.append(unit(v))
        noises.append(noise)
        models.append(direction)

    def _direction_noise(self, u, variance):
        return variance * (eye_of(self.number) - np.outer(u, u)) + self._floor(variance)

    def _floor(self, variance):
        """Noise along a direction."""
        return max(self.floor, self.number(1e-5) * variance) * eye_of(self.number)

    # ---- the estimate ----

    position = property(lambda self: self.r)
    velocity = property(lambda self: self.v)
    R_BI = property(lambda self: self.R)
    accel_bias = property(lambda self: self.b_a)
    gyro_bias = property(lambda self: self.b_g)
    covariance = property(lambda self: self.P[:15, :15])
    gnss_drift = property(lambda self: self.d)


class PlainEKF(PlainUKF):
    """The error-state extended filter with the same models, in the textbook's form."""

    def _differences(self, function, x0):
        """Value and Jacobian of a function of points (n, k), by central differences."""
        h = self.number("1e-13") if self.number is Decimal else self.number(1e-6)
        steps = h * eye_of(self.number, len(x0))
        center = function(x0[np.newaxis])[0]
        return center, ((function(x0 + steps) - function(x0 - steps)) / (2 * h)).T

    def _transform(self, function, x0, P0):
        center, J = self._differences(function, x0)
        return center, J @ P0 @ J.T

    def _condition(self, z, noise, models):
        x0 = self._state()
        center, H = self._differences(lambda points: self._predicted(models, points), x0)
        P_zz = H @ self.P @ H.T + noise
        K = solve_positive_definite(P_zz, H @ self.P).T
        self._inject(x0 + K @ (z - center), self.P - K @ P_zz @ K.T)
