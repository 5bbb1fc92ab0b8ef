"""Filters to compare with: for one vehicle, the plain NumPy filter of the tests, and filterpy's."""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym import SensorSuite
from quad_gym.estimation import UnscentedKalmanFilter

REFERENCE = Path(__file__).resolve().parents[2] / "tests" / "reference_ukf.py"
"""The plain filter."""


class Estimate(NamedTuple):
    """Position and attitude, true or estimated."""

    position: NDArray[np.float64]
    R_BI: NDArray[np.float64]


class MeasuredTick(NamedTuple):
    """Measurements of one flight at one instant, and its true state."""

    gyro: NDArray[np.float64]
    accel: NDArray[np.float64]
    gnss_position_G: NDArray[np.float64]
    gnss_baseline_G: NDArray[np.float64]
    pixels: NDArray[np.float64]
    truth: Estimate


Run = Callable[[], list[Estimate]]
"""Function that starts a filter, made before, for a flight; the estimates after each update."""


def load_reference() -> ModuleType | None:
    """The module with `PlainUKF`; None outside a checkout."""
    spec = importlib.util.spec_from_file_location("reference_ukf", REFERENCE)
    if spec is None or spec.loader is None or not REFERENCE.exists():
        return None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def peers(sensors: SensorSuite, flight: list[MeasuredTick]) -> dict[str, Run]:
    """Functions that run the filters over a flight, by name, as far as they are available."""
    ours = _cycles(
        UnscentedKalmanFilter, lambda ukf: Estimate(ukf.position, ukf.R_BI), sensors, flight
    )
    found = {"UnscentedKalmanFilter": ours}
    module = load_reference()
    if module is None:
        print(f"  plain NumPy and filterpy: {REFERENCE} is missing", file=sys.stderr)
        return found
    found["plain NumPy"] = _cycles(
        module.PlainUKF, lambda ukf: Estimate(ukf.r, ukf.R), sensors, flight
    )
    try:
        from filterpy import kalman
    except ImportError as error:
        print(f"  filterpy: {error}", file=sys.stderr)
        return found
    found["filterpy"] = _filterpy_cycles(kalman, module, sensors, flight)
    return found


def _cycles(
    kind: Any,
    estimate: Callable[[Any], Estimate],
    sensors: SensorSuite,
    flight: list[MeasuredTick],
) -> Run:
    ukf = kind(sensors)

    def run() -> list[Estimate]:
        found = list[Estimate]()
        ukf.initialize(flight[0].gnss_position_G, flight[0].gnss_baseline_G)
        for now in flight:
            ukf.update(now.gnss_position_G, now.gnss_baseline_G, now.pixels)
            found.append(estimate(ukf))
            ukf.predict(now.gyro, now.accel)
        return found

    return run


def _filterpy_cycles(
    kalman: Any, module: Any, sensors: SensorSuite, flight: list[MeasuredTick]
) -> Run:
    """Cycles of filterpy's filter over a flight.

    It has the same models and the state dimension 15, but adds the noise to the covariance instead
    of augmenting the state, and so has fewer sigma points: 31 instead of 55 and 43 (55 with two
    features). The attitude error is moved into the reference attitude after each half.
    """
    plain: Any = module.PlainUKF(sensors)
    rotation, rates, unit = module.rotation_312, module.euler_rate_matrix, module.unit
    dt, features = plain.dt, len(plain.features)
    choice = sensors.estimator

    def f(x: Any, dt: float, R: Any, gyro: Any, accel: Any) -> Any:
        r, v, e, b_a, b_g = np.split(x, 5)
        a_I = (accel - b_a) @ (rotation(e) @ R) - plain.g_I
        e_next = e + dt * (rates(e) @ (gyro - b_g))
        b_a, b_g = plain.decay["accel"] * b_a, plain.decay["gyro"] * b_g
        return np.concatenate([r + v * dt + a_I * dt**2 / 2, v + a_I * dt, e_next, b_a, b_g])

    def h(x: Any, R: Any) -> Any:
        r, R_BI = x[:3], rotation(x[6:9]) @ R
        parts = [r + plain.l_p @ R_BI, unit(plain.l_b @ R_BI)]
        for X_I in plain.features:
            parts.append(plain.R_CB @ unit(R_BI @ (X_I - r) - plain.l_c))
        return np.concatenate(parts)

    def measurement(now: MeasuredTick, R: Any, r: Any) -> tuple[Any, Any]:
        z = [plain.R_IG @ now.gnss_position_G, unit(plain.R_IG @ now.gnss_baseline_G)]
        direction = unit(R.T @ plain.l_b)
        noise = [plain.R_position, plain._direction_noise(direction, plain.baseline_variance)]
        for k in range(features):
            camera = sensors.camera
            assert camera is not None
            ray = np.array([*now.pixels[k], camera.focal_length])
            variance = camera.pixel_sigma**2 / (ray @ ray)
            z.append(unit(ray))
            across = plain.R_CB @ unit(R @ (plain.features[k] - r) - plain.l_c)
            noise.append(plain._direction_noise(across, variance))
        return np.concatenate(z), module.block_diagonal(*noise)

    points = kalman.MerweScaledSigmaPoints(15, choice.alpha, choice.beta, choice.kappa)
    ukf = kalman.UnscentedKalmanFilter(15, 6 + 3 * features, dt, h, f, points)

    def run() -> list[Estimate]:
        found = list[Estimate]()
        plain.initialize(flight[0].gnss_position_G, flight[0].gnss_baseline_G)
        ukf.x, ukf.P, R = plain._state(), plain.P.copy(), plain.R
        spread = np.zeros((15, 12))  # from the noises (gyro, gyro bias, accel, accel bias)
        spread[0:3, 6:9], spread[3:6, 6:9] = -(dt**2) / 2 * R.T, -dt * R.T
        spread[6:9, 0:3] = -dt * np.eye(3)
        spread[9:12, 9:12] = spread[12:15, 3:6] = np.eye(3)
        ukf.Q = spread @ plain.Q @ spread.T
        for k, now in enumerate(flight):
            if k == 0:  # its update uses the sigma points of a prediction
                ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)
            z, noise = measurement(now, R, ukf.x[:3])
            ukf.update(z, R=noise, hx=lambda x, R=R: h(x, R))
            R, ukf.x[6:9], ukf.P = rotation(ukf.x[6:9]) @ R, 0.0, (ukf.P + ukf.P.T) / 2
            found.append(Estimate(ukf.x[:3].copy(), R))
            ukf.predict(R=R, gyro=now.gyro, accel=now.accel)
            R = rotation(ukf.x[6:9]) @ R
            ukf.sigmas_f[:, 6:9] -= ukf.x[6:9]
            ukf.x[6:9], ukf.P = 0.0, (ukf.P + ukf.P.T) / 2
        return found

    return run
