"""Closed-form flights with constant attitude, for filters that start level. The vehicle swings
level, r = A (sin wt, (1 - cos wt)/2, 0); filters do not model the dynamics of a quadrotor."""

import math

import numpy as np

import quad_gym
from quad_gym.analysis.metrics import nees, state_error
from quad_gym.frames import ecef_to_enu
from quad_gym.rotations import euler_to_dcm

MAGNETIC = (
    quad_gym.sensor_suite("rtk")
    .simplified()
    .replace(
        camera=None,
        magnetometer=quad_gym.MagnetometerParams(),
        barometer=quad_gym.BarometerParams(),
    )
)
R_IG = ecef_to_enu(MAGNETIC.gnss.reference_antenna_G)
GRAVITY = MAGNETIC.estimator.gravity


class LevelFlight:
    """Random flight, with an initial state from the filter's initial distribution."""

    def __init__(self, suite, rng, *, amplitude=3.0, omega=1.5, velocity=(0.0, 0.0, 0.0)):
        self.suite, self.rng, imu = suite, rng, suite.imu
        self.amplitude, self.omega, self.drift = amplitude, omega, np.array(velocity)
        self.yaw = rng.uniform(-math.pi, math.pi)
        tilt = suite.estimator.initial_tilt_sigma
        self.R = euler_to_dcm([*rng.normal(0.0, tilt, 2), self.yaw])
        self.b_a = rng.normal(0.0, imu.accel_bias_sigma, 3)
        self.b_g = rng.normal(0.0, imu.gyro_bias_sigma, 3)
        self.speed = rng.normal(0.0, math.sqrt(suite.estimator.initial_velocity_variance), 3)
        self.iron = np.zeros(3)
        self.turn = 0.0
        if suite.magnetometer is not None:
            self.iron = rng.normal(0.0, suite.magnetometer.hard_iron_sigma, 3)
            self.turn = rng.normal(0.0, suite.magnetometer.declination_sigma)

    def truth(self, t):
        a, w = self.amplitude, self.omega
        s, c = math.sin(w * t), math.cos(w * t)
        start = self.speed + self.drift
        # the swing begins with the velocity a w to the east, which is subtracted
        r = np.array([a * (s - w * t), 0.5 * a * (1.0 - c), 0.0]) + start * t
        v = np.array([a * w * (c - 1.0), 0.5 * a * w * s, 0.0]) + start
        return {
            "position": r,
            "velocity": v,
            "R_BI": self.R,
            "accel_bias": self.b_a,
            "gyro_bias": self.b_g,
        }

    def sample(self, t, dt):
        """Means of gyro and accelerometer over (t, t + dt)."""
        imu, rng = self.suite.imu, self.rng
        dv = self.truth(t + dt)["velocity"] - self.truth(t)["velocity"]
        force = self.R @ (dv / dt + np.array([0.0, 0.0, GRAVITY]))
        gyro = self.b_g + rng.normal(0.0, imu.gyro_noise_density / math.sqrt(dt), 3)
        accel = self.b_a + rng.normal(0.0, imu.accel_noise_density / math.sqrt(dt), 3)
        return gyro, force + accel

    def gnss(self, t):
        """Position and velocity of the antenna, in G."""
        gnss, rng, truth = self.suite.gnss, self.rng, self.truth(t)
        antenna = truth["position"] + self.R.T @ np.array(gnss.primary_antenna_B)
        position = antenna + rng.normal(0.0, 1.0, 3) * gnss.position_sigma_I
        velocity = truth["velocity"] + rng.normal(0.0, gnss.velocity_sigma, 3)
        return R_IG.T @ position, R_IG.T @ velocity

    def field(self):
        """The magnetic field in B."""
        m = self.suite.magnetometer
        c, s = math.cos(self.turn), math.sin(self.turn)
        e, n, u = m.field_I
        field_I = np.array([c * e + s * n, c * n - s * e, u])
        return self.R @ field_I + self.iron + self.rng.normal(0.0, m.noise_sigma, 3)

    def error(self, ukf, t):
        """Errors (15,) of a filter."""
        estimate = {name: getattr(ukf, name) for name in self.truth(t)}
        return state_error(self.truth(t), estimate)

    def nees(self, ukf, t):
        return nees(self.error(ukf, t), ukf.covariance)
