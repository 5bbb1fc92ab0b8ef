"""The plain filters of `reference_ukf.py` with a barometer and a magnetometer. Slow errors follow
b_g in the state: the drift of GNSS positions, if there is one; hard iron b (three); the barometer's
bias; and the error of the declination. If the covariance turns with the attitude, hard iron turns,
too, so that the error of the predicted field does not change. Constant states have a driving noise
that is negligible in 45 digits. UKF and, by numerical derivatives, EKF, in any number type."""

import math

import numpy as np

from tests.reference_ukf import PlainEKF, PlainUKF, array_of, block_diagonal, rotation_312

NOTHING = "1e-44"


def cross_matrix(v):
    """[v x], such that [v x] e = v x e."""
    x, y, z = v
    return np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]])


class Aided:
    """Barometer and magnetometer for the two plain filters."""

    def __init__(self, sensors, number=np.float64):
        super().__init__(sensors, number)
        barometer, magnetometer = sensors.barometer, sensors.magnetometer
        tail = []  # standard deviation and correlation time of each
        if self.drifts:
            tail += [(sigma, sensors.gnss.drift_tau) for sigma in sensors.gnss.drift_sigma_I]
        self.hard_iron = self.altitude_bias = self.declination = None
        if magnetometer is not None:
            self.hard_iron = slice(15 + len(tail), 18 + len(tail))
            tail += [(magnetometer.hard_iron_sigma, math.inf)] * 3
        if barometer is not None:
            self.altitude_bias = 15 + len(tail)
            tail.append((barometer.bias_sigma, barometer.bias_tau))
        if magnetometer is not None:
            self.declination = 15 + len(tail)
            tail.append((magnetometer.declination_sigma, math.inf))
            level = number(magnetometer.strength) * number(math.cos(magnetometer.inclination))
            up = -number(magnetometer.strength) * number(math.sin(magnetometer.inclination))
            angle = magnetometer.declination
            east, north = level * number(math.sin(angle)), level * number(math.cos(angle))
            self.field = np.array([east, north, up])
            self.field_turned = np.array([north, -east, 0 * up])
        self.states = 15 + len(tail)
        sigmas = array_of(number, [sigma for sigma, _ in tail])
        times = [number(tau) if tau < math.inf else None for _, tau in tail]
        one = number(1)
        self.tail_decay = np.array([one if t is None else np.exp(-self.dt / t) for t in times])
        driven = sigmas**2 * (1 - self.tail_decay**2)
        driven = np.where(driven == 0, number(NOTHING), driven)
        eye = array_of(number, np.eye(len(tail)))
        self.Q = block_diagonal(self.Q[:12, :12], eye * driven)
        self.tail_start = eye * sigmas**2
        if self.drifts:
            self.tail_start[:3, :3] = number("1e-30") * eye[:3, :3]
        self.zeros = array_of(number, np.zeros(12 + len(tail)))
        self.pending, self.field_before = [], None

    def initialize(self, gnss_position_G, gnss_baseline_G):
        super().initialize(gnss_position_G, gnss_baseline_G)
        self.d = self.zeros[: self.states - 15]
        self.P = block_diagonal(self.P[:15, :15], self.tail_start)

    def _process(self, points, w_B, f_B):
        noise = points[:, self.states :]
        drifts, self.drifts = self.drifts, False
        after = super()._process(points, w_B, f_B)
        self.drifts = drifts
        tail = self.tail_decay * points[:, 15 : self.states] + noise[:, 12:]
        return np.concatenate([after, tail], axis=1)

    def update(self, barometer=None, magnetometer=None, **others):
        eye = array_of(self.number, np.eye(3))
        if barometer is not None:
            variance = self.number(self.sensors.barometer.noise_sigma) ** 2
            z = self._array([barometer])
            self.pending.append((z, variance * eye[:1, :1], self._altitude))
        if magnetometer is not None:
            variance = self.number(self.sensors.magnetometer.noise_sigma) ** 2
            self.pending.append((self._array(magnetometer), variance * eye, self._field_B))
        super().update(**others)
        if self.pending:
            nothing = array_of(self.number, np.zeros((0, 0)))
            self._condition(nothing[0:0].reshape(0), nothing, [])

    def _altitude(self, points):
        return points[:, 2:3] + points[:, self.altitude_bias, np.newaxis]

    def _field_B(self, points):
        delta = points[:, self.declination, np.newaxis]
        field_I = self.field + delta * self.field_turned
        R_BI = rotation_312(points[:, 6:9]) @ self.R
        return (R_BI @ field_I[..., np.newaxis])[..., 0] + points[:, self.hard_iron]

    def _condition(self, z, noise, models):
        pending, self.pending = self.pending, []
        self.aiding = [model for _, _, model in pending]
        z = np.concatenate([z, *(value for value, _, _ in pending)])
        noise = block_diagonal(noise, *(block for _, block, _ in pending)) if pending else noise
        if self.hard_iron is not None:
            delta = self.d[self.declination - 15]
            self.field_before = self.R @ (self.field + delta * self.field_turned)
        super()._condition(z, noise, models)

    def _turn(self, e):
        turn = super()._turn(e)
        if self.field_before is not None:
            after = cross_matrix(rotation_312(e) @ self.field_before)
            before = cross_matrix(self.field_before)
            turn[self.hard_iron, 6:9] = before - after @ turn[6:9, 6:9]
            self.field_before = None
        return turn

    def _predicted(self, models, points):
        others = [super()._predicted(models, points)] if models else []
        aided = [model(points) for model in self.aiding]
        return np.concatenate([*others, *aided], axis=1)


class AidedUKF(Aided, PlainUKF):
    """The plain unscented filter."""


class AidedEKF(Aided, PlainEKF):
    """The plain extended filter."""
