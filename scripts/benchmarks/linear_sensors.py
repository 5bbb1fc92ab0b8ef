"""Linear models of a vehicle and its sensors, with the errors of the sensors as states.

Errors are truth minus estimate, in the order and the frames of the filter's covariance: position,
velocity, attitude, and the biases of the IMU; then the scale and alignment of the accelerometer,
and the errors of the other sensors in the suite.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.analysis.consistency import PARTS
from quad_gym.estimation.engine import Engine
from quad_gym.kernels.entries import run_stage
from quad_gym.kernels.stages import Stage
from quad_gym.params.camera import CameraParams
from quad_gym.params.suites import SensorSuite
from quad_gym.records import (
    AID_BLOCK,
    AID_FREEDOMS,
    BASELINE_BLOCK,
    FEATURE_SLICE,
    MAX_BLOCKS,
    MAX_STATES,
    OWN_ERRORS,
    POSITION_BLOCK,
    WIDTH,
    Act,
    Aid,
    Sensor,
    shown_rows,
)
from quad_gym.rotations import euler_to_dcm

Floats = NDArray[np.float64]
R, V, E, BA, BG = (PARTS[name] for name in list(PARTS)[1:])
EYE = np.eye(3)
MOVING = 24  #: number of states of the vehicle and its IMU


class Truth(NamedTuple):
    """True state at an instant."""

    r: Floats
    v: Floats
    R_BI: Floats
    w: Floats


class SuiteModel:
    """Linear models of a suite, with the errors of its sensors as states.

    Barometer and magnetometer have models here. Other aiding sensors have the derivatives and the
    noise of their kernels.

    Raises:
        ValueError: If another sensor has a time-correlated error, which is not modeled.
    """

    def __init__(self, sensors: SensorSuite) -> None:
        self._others = tuple(set(sensors.aids) - {Aid["BAROMETER"], Aid["MAGNETOMETER"]})
        for aid in self._others:
            if OWN_ERRORS[aid]:
                name = aid.name.lower()
                raise ValueError(f"sensors must be a suite without {name} for the bound")
        self._engine = Engine(sensors, "ekf")
        self.sensors, imu, gnss = sensors, sensors.imu, sensors.gnss
        barometer, magnetometer = sensors.barometer, sensors.magnetometer
        scale, misalignment = imu.accel_scale_sigma, imu.accel_misalignment_sigma
        errors = [(imu.accel_bias_sigma, imu.accel_bias_tau)] * 3
        errors += [(imu.gyro_bias_sigma, imu.gyro_bias_tau)] * 3
        self.parts: dict[str, slice] = {}

        def add(name: str, *more: tuple[float, float]) -> None:
            self.parts[name] = slice(9 + len(errors), 9 + len(errors) + len(more))
            errors.extend(more)

        matrix = np.where(np.eye(3, dtype=bool), scale, misalignment)
        add("accel", *((float(sigma), np.inf) for sigma in matrix.flat))
        if gnss is not None:
            add("drift", *((sigma, gnss.drift_tau) for sigma in gnss.drift_sigma_I))
            add("heading", (gnss.heading_error_sigma, np.inf))
        if barometer is not None:
            add("barometer", (barometer.bias_sigma, barometer.bias_tau))
        if magnetometer is not None:
            add("iron", *[(magnetometer.hard_iron_sigma, magnetometer.hard_iron_tau)] * 3)
            add("declination", (magnetometer.declination_sigma, np.inf))
        self.sigma, self.tau = np.array(errors).T
        self.decay = np.exp(-imu.dt / self.tau)
        self.size = 9 + len(errors)

    def start(self, covariances: Floats) -> Floats:
        """Initial covariances (n, k, k) from the filters' (n, 15, 15); the drift begins at zero."""
        P = np.zeros((len(covariances), self.size, self.size))
        variance = np.concatenate([np.zeros(9), self.sigma**2])
        if "drift" in self.parts:
            variance[self.parts["drift"]] = 0.0
        P[:] = np.diag(variance)
        P[:, :15, :15] = covariances
        return P

    def transition(self, before: Truth, now: Truth, gravity: float) -> tuple[Floats, Floats]:
        """F and Q of a tick, (n, k, k) each."""
        imu, dt = self.sensors.imu, self.sensors.imu.dt
        R_IB, g_I = transposed(before.R_BI), np.array([0.0, 0.0, gravity])
        f = apply(before.R_BI, (now.v - before.v) / dt + g_I)
        F = np.tile(np.eye(self.size), (len(f), 1, 1))
        F[:, range(9, self.size), range(9, self.size)] = self.decay
        F[:, R, V], F[:, V, BA], F[:, E, BG] = dt * EYE, -dt * R_IB, -dt * EYE
        F[:, V, E], F[:, E, E] = -dt * R_IB @ cross(f), now.R_BI @ R_IB
        d = f - g_I
        F[:, V, self.parts["accel"]] = -dt * np.einsum("nik,nj->nikj", R_IB, d).reshape(-1, 3, 9)
        F[:, R, 6:] = 0.5 * dt * F[:, V, 6:]
        Q = np.zeros_like(F)
        B = F[:, :9, 9:15]
        noise = np.repeat([imu.accel_noise**2, imu.gyro_noise**2], 3)
        Q[:, :9, :9] = B * noise @ transposed(B)
        Q[:, range(9, self.size), range(9, self.size)] = self.sigma**2 * (1.0 - self.decay**2)
        return F, Q

    def measurements(
        self, valid: NDArray[np.bool_], at: Callable[[Sensor], Truth], features: Floats
    ) -> Iterator[tuple[NDArray[np.intp], Floats, Any, Sensor]]:
        """Flights that have measured, Jacobians, variances, and the sensor.

        Args:
            valid: Blocks that have arrived, (n, blocks).
            at: Function that returns the `Truth` at the time stamp of a sensor.
            features: Features of the map, (n, m, 3).
        """
        gnss, camera, parts = self.sensors.gnss, self.sensors.camera, self.parts

        def jacobian(rows: Any, size: int, **blocks: Any) -> Floats:
            H = np.zeros((len(rows), size, self.size))
            for name, block in blocks.items():
                H[:, :, {"r": R, "v": V, "e": E, **parts}[name]] = block
            return H

        def seen(block: int) -> NDArray[np.intp]:
            return np.flatnonzero(valid[:, block])

        if gnss is not None and (rows := seen(POSITION_BLOCK)).size:
            R_IB, w = transposed(at(Sensor["GNSS"]).R_BI[rows]), at(Sensor["GNSS"]).w[rows]
            lever = np.array(gnss.primary_antenna_B)
            H = jacobian(rows, 3, r=EYE, e=-R_IB @ cross(lever), drift=EYE)
            yield rows, H, np.square(gnss.position_sigma_I), Sensor["GNSS"]
            if gnss.velocity_sigma is not None:
                H = jacobian(rows, 3, v=EYE, e=-R_IB @ cross(np.cross(w, lever)))
                yield rows, H, [gnss.velocity_sigma**2] * 3, Sensor["GNSS"]
        if gnss is not None and gnss.has_baseline and (rows := seen(BASELINE_BLOCK)).size:
            R_IB = transposed(at(Sensor["GNSS"]).R_BI[rows])
            b = gnss.baseline_B / np.linalg.norm(gnss.baseline_B)
            heading = (R_IB @ np.cross([0.0, 0.0, 1.0], b))[..., np.newaxis]
            H = jacobian(rows, 3, e=-R_IB @ cross(b), heading=heading)
            yield rows, H, [gnss.baseline_sigma**2] * 3, Sensor["GNSS"]
        barometer, magnetometer = self.sensors.barometer, self.sensors.magnetometer
        if barometer is not None and (rows := seen(AID_BLOCK[Aid["BAROMETER"]])).size:
            H = jacobian(rows, 1, r=EYE[2:], barometer=1.0)
            yield rows, H, [barometer.noise_sigma**2], Sensor["BAROMETER"]
        if magnetometer is not None and (rows := seen(AID_BLOCK[Aid["MAGNETOMETER"]])).size:
            R_BI, m_I = at(Sensor["MAGNETOMETER"]).R_BI[rows], np.array(magnetometer.field_I)
            turned = (R_BI @ np.cross([0.0, 0.0, 1.0], m_I))[..., np.newaxis]
            H = jacobian(rows, 3, e=cross(R_BI @ m_I), iron=EYE, declination=turned)
            yield rows, H, [magnetometer.noise_sigma**2] * 3, Sensor["MAGNETOMETER"]
        for aid in self._others:
            new = valid[:, AID_BLOCK[aid] : AID_BLOCK[aid] + self.sensors.aids[aid].blocks]
            if (rows := np.flatnonzero(new.any(axis=1))).size:
                truth = Truth(*(part[rows] for part in at(Sensor[aid.name])))
                moving, variance = self._derivatives(aid, truth)
                variance = np.where(new[rows].repeat(AID_FREEDOMS[aid], axis=1), variance, np.inf)
                H = jacobian(rows, moving.shape[1])
                H[:, :, :9] = moving
                yield rows, H, variance, Sensor[aid.name]
        new = valid[:, FEATURE_SLICE]
        if camera is not None and (rows := np.flatnonzero(new.any(axis=1))).size:
            truth, X_I = at(Sensor["CAMERA"]), features[rows]
            R_BI = truth.R_BI[rows][:, np.newaxis]
            X_B = apply(R_BI, X_I - truth.r[rows][:, np.newaxis])
            J = projection(camera, X_B)
            by_row = (len(rows), -1, 3)
            r, e = (-J @ R_BI).reshape(by_row), (J @ cross(X_B)).reshape(by_row)
            blur = camera.blur * np.linalg.norm(truth.w[rows], axis=1)[:, np.newaxis]
            variance = camera.pixel_sigma**2 + blur**2
            variance = np.where(new[rows][:, : X_I.shape[1]], variance, np.inf)
            H = jacobian(rows, 2 * X_I.shape[1], r=r, e=e)
            yield rows, H, np.repeat(variance, 2, axis=1), Sensor["CAMERA"]

    def _derivatives(self, aid: Aid, truth: Truth) -> tuple[Floats, Floats]:
        """Derivatives (n, m, 9) of all blocks of a sensor, and variances (n, m), of its kernel."""
        engine, count = self._engine, len(truth.r)
        engine.allocate(count)
        for name, values in zip(("r_hat", "v_hat", "R_hat", "w_meas"), truth, strict=True):
            padded = np.resize(values, (engine.lanes, *values.shape[1:]))
            engine.write(name, padded)
        engine.fill("block_valid", np.ones(MAX_BLOCKS))
        motion, blocks = int(engine.settings["motion_columns"][0]), []
        last, places = motion + engine.slow_states - 1, np.argsort(shown_rows(15))[:motion]
        used = np.arange(3 * self.sensors.aids[aid].blocks)
        used = used[used % 3 < AID_FREEDOMS[aid]]
        work, table = engine._work, engine._table()
        work["L"] = np.eye(MAX_STATES)[..., np.newaxis]
        arguments = (engine.params, engine.params, engine.settings, work, table, int(Act.EXPECT))
        for block in np.split(engine.blocks, len(engine.blocks)):
            run_stage(block.ctypes.data, 0, 1, int(Stage[aid.name]), *arguments)
            columns = np.zeros((9, len(used), WIDTH))
            columns[places] = work["A"][0, last - np.arange(motion)][:, used]
            blocks.append((columns.T, work["Rz"][0, used, used].T))
        H, variance = (np.concatenate(parts)[:count] for parts in zip(*blocks, strict=True))
        return H, variance


def projection(camera: CameraParams, X_B: Floats) -> Floats:
    """Derivatives (..., 2, 3) of the pixels of places X_B (..., 3) in B."""
    R_CB = euler_to_dcm(np.array(camera.attitude))
    x, y, z = np.moveaxis(apply(R_CB, X_B - np.array(camera.position_B)), -1, 0)
    z = np.maximum(z, 0.1)
    one, none = np.ones_like(z), np.zeros_like(z)
    J = np.array([[one, none, -x / z], [none, one, -y / z]]) * camera.focal_length / z
    return np.asarray(np.moveaxis(J, (0, 1), (-2, -1)) @ R_CB)


def transposed(A: Floats) -> Floats:
    """Matrices with rows and columns exchanged."""
    return A.swapaxes(-1, -2)


def apply(A: Floats, x: Floats) -> Floats:
    """A x of matrices and vectors, (..., n)."""
    return np.asarray((A @ x[..., np.newaxis])[..., 0])


def cross(x: ArrayLike) -> Floats:
    """[x x], (..., 3, 3)."""
    return transposed(np.cross(np.asarray(x)[..., np.newaxis, :], EYE))
