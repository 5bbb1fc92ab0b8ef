"""Sensor measurements on a circle around the origin, in closed form and with NumPy only.

The vehicle heaves and swings its heading, so that features leave the image and return.
"""

from dataclasses import dataclass

import numpy as np

from tests.reference_ukf import east_north_up, rotation_312, unit

RADIUS, OMEGA, HEIGHT = 2.5, 2 * np.pi / 10, 1.0


def _positions(t, phase):
    turn = OMEGA * t + phase
    xy = RADIUS * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return np.concatenate([xy, (HEIGHT + 0.3 * np.sin(1.3 * t))[:, np.newaxis]], axis=1)


def _derivatives(t, phase):
    turn = OMEGA * t + phase
    v = RADIUS * OMEGA * np.stack([-np.sin(turn), np.cos(turn), 0 * turn], axis=-1)
    a = -RADIUS * OMEGA**2 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    v[:, 2] = 0.39 * np.cos(1.3 * t)
    a[:, 2] = -0.507 * np.sin(1.3 * t)
    return v, a


def _attitudes(t, phase, swing, gravity):
    """R_BI with body z along the specific force and body x as near the heading as possible."""
    _, a = _derivatives(t, phase)
    heading = OMEGA * t + phase + np.pi + swing * np.sin(0.9 * t)
    toward = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=-1)
    z = unit(a + np.array([0.0, 0.0, gravity]))
    y = unit(np.cross(z, toward))
    return np.stack([np.cross(y, z), y, z], axis=1)


@dataclass
class Recording:
    """Truth and measurements at every tick; features out of view are NaN."""

    r: np.ndarray
    v: np.ndarray
    R_BI: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    gnss_position: np.ndarray
    gnss_baseline: np.ndarray
    pixels: np.ndarray


def record_circle(sensors, ticks, seed, *, swing=1.2):
    """Record a flight; `swing` [rad] is the largest angle of the heading from the origin."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2 * np.pi)
    dt, n = sensors.imu.dt, ticks
    t, gravity = dt * np.arange(n), sensors.estimator.gravity
    r, (v, a) = _positions(t, phase), _derivatives(t, phase)
    R_BI = _attitudes(t, phase, swing, gravity)
    step = 1e-4
    dR = _attitudes(t + step, phase, swing, gravity) - _attitudes(t - step, phase, swing, gravity)
    w_cross = -dR / (2 * step) @ R_BI.transpose(0, 2, 1)  # dR/dt = -[w x] R
    w_B = np.stack([w_cross[:, 2, 1], w_cross[:, 0, 2], w_cross[:, 1, 0]], axis=-1)

    def biases(sigma, tau):
        decay, b = np.exp(-dt / tau), np.empty((n, 3))
        b[0] = rng.normal(0.0, sigma, 3)
        drive = rng.normal(0.0, sigma * np.sqrt(1 - decay**2), (n, 3))
        for k in range(1, n):
            b[k] = decay * b[k - 1] + drive[k]
        return b

    imu = sensors.imu
    f_B = np.einsum("nij,nj->ni", R_BI, a + np.array([0.0, 0.0, gravity]))
    accel = f_B + biases(imu.accel_bias_sigma, imu.accel_bias_tau)
    gyro = w_B + biases(imu.gyro_bias_sigma, imu.gyro_bias_tau)
    accel += rng.normal(0.0, imu.accel_noise_density / np.sqrt(dt), (n, 3))
    gyro += rng.normal(0.0, imu.gyro_noise_density / np.sqrt(dt), (n, 3))
    position, baseline = _gnss(sensors.gnss, r, R_BI, rng)
    return Recording(r, v, R_BI, gyro, accel, position, baseline, _image(sensors, r, R_BI, rng))


def _gnss(gnss, r, R_BI, rng):
    R_IG = east_north_up(gnss.reference_antenna_G)
    l_p, l_s = np.array(gnss.primary_antenna_B), np.array(gnss.secondary_antenna_B)
    antenna = r + l_p @ R_BI + rng.normal(0.0, gnss.position_sigma_I, r.shape)
    baseline = (l_s - l_p) @ R_BI
    length = np.linalg.norm(l_s - l_p)
    noise = rng.normal(0.0, length * gnss.baseline_sigma, r.shape)
    u = baseline / length
    noise -= (noise * u).sum(axis=1, keepdims=True) * u
    return antenna @ R_IG, length * unit(baseline + noise) @ R_IG


def _image(sensors, r, R_BI, rng):
    camera = sensors.camera
    if camera is None:
        return np.empty((len(r), 0, 2))
    R_CB = rotation_312(np.array(camera.attitude))
    to_feature = np.array(camera.features_I) - r[:, np.newaxis]
    v_B = np.einsum("nij,nkj->nki", R_BI, to_feature) - camera.position_B
    v_C = v_B @ R_CB.T
    with np.errstate(divide="ignore"):
        pixels = camera.focal_length * v_C[..., :2] / v_C[..., 2:]
    half = np.array(camera.image_size) / 2
    seen = (v_C[..., 2] > 0.0) & (abs(pixels) <= half).all(axis=-1)
    pixels += rng.normal(0.0, camera.pixel_sigma, pixels.shape)
    return np.where(seen[..., np.newaxis], pixels, np.nan)
