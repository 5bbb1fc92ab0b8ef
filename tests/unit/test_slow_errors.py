"""Slow errors of sensors between measurements, `predict_slow` in `quad_gym.kernels.filter.slow`."""

import math

import numpy as np
import pytest

from quad_gym.records import Aid
from tests.lane_rules import LaneRules
from tests.level_flights import GRAVITY, MAGNETIC

GNSS = MAGNETIC.gnss.replace(
    secondary_antenna_B=None, drift_sigma_I=(0.5, 0.6, 0.7), drift_tau=0.02
)
SHORT = MAGNETIC.replace(
    gnss=GNSS,
    barometer=MAGNETIC.barometer.replace(bias_tau=0.03),
    magnetometer=MAGNETIC.magnetometer.replace(hard_iron_tau=0.05),
)
"""A suite in which all of them change within a few ticks, except for the declination's."""


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_slow_errors_and_their_covariances_decay_and_are_driven(kind):
    """By a = exp(-dt / tau), those with other errors by both factors; s^2 (1 - a^2) is added.

    Covariances with position and velocity follow these: r <- r + dt (v + v') / 2, and v' has the
    attitude's error times gravity and the bias, for a vehicle at rest that is level.
    """
    rng, dt = np.random.default_rng(0), SHORT.imu.dt
    estimator = SHORT.estimator.replace(kind=kind, integration="midpoint")
    rules = LaneRules(SHORT.replace(estimator=estimator))
    assert rules.slow == 9
    iron, turn, height = (
        int(rules.settings[name][0, aid])
        for name, aid in (
            ("aid_vector", Aid.MAGNETOMETER),
            ("aid_scalar", Aid.MAGNETOMETER),
            ("aid_scalar", Aid.BAROMETER),
        )
    )
    tau, sigma = np.full(9, math.inf), np.zeros(9)
    tau[:3], sigma[:3] = 0.02, GNSS.drift_sigma_I
    tau[iron : iron + 3], sigma[iron : iron + 3] = 0.05, SHORT.magnetometer.hard_iron_sigma
    tau[height], sigma[height] = 0.03, SHORT.barometer.bias_sigma
    scale = np.repeat([0.3, 0.2, 0.01, 0.05, 0.002], 3)
    own = np.where(sigma > 0.0, sigma, 1.0)
    own[turn] = SHORT.magnetometer.declination_sigma
    mixed = rng.normal(size=(24, 60)) / math.sqrt(60)
    P = mixed @ mixed.T * np.outer(np.append(scale, own), np.append(scale, own))
    rules.set_covariance(P)
    hat = rng.normal(size=9) * own
    slow_hat = np.zeros(rules.get("slow_hat").shape[1:])
    slow_hat[:9] = hat
    rules.set(slow_hat=slow_hat, gyro=0.0, accel=[0.0, 0.0, GRAVITY], v_hat=0.0)
    rules.predict()
    decay = np.exp(-dt / tau)
    np.testing.assert_allclose(rules.get("slow_hat")[0, :9], decay * hat, rtol=1e-9, atol=1e-15)
    biases = np.repeat(
        np.exp(-dt / np.array([SHORT.imu.accel_bias_tau, SHORT.imu.gyro_bias_tau])), 3
    )
    F = np.eye(24)
    # R = R(e) R_hat: the force that is seen turns by e, and the attitude by the bias of the gyro
    F[6:9, 12:15] = -dt * np.eye(3)
    lean = GRAVITY * np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    F[3:6, 6:9], F[3:6, 9:12], F[3:6, 12:15] = dt * lean, -dt * np.eye(3), -(dt**2) / 2.0 * lean
    F[:3, 3:] = dt / 2.0 * (np.eye(24)[3:6, 3:] + F[3:6, 3:])
    F[range(9, 24), range(9, 24)] = np.concatenate([biases, decay])
    expected = (F @ P @ F.T)[15:]
    expected[:, 15:] += np.diag(sigma**2 * (1.0 - decay**2))
    scaled = np.outer(own, np.append(scale, own))
    for found in rules.covariance()[:, 15:]:
        np.testing.assert_allclose(found / scaled, expected / scaled, atol=2e-6)
