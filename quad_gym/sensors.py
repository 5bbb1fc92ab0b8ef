"""Sensors of one vehicle: each converts a true state to one measurement."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import entries
from quad_gym.packing import params_record
from quad_gym.params import checks as check
from quad_gym.params.camera import CameraParams
from quad_gym.params.gnss import GnssParams
from quad_gym.params.imu import ImuParams
from quad_gym.params.suites import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import BASELINE_BLOCK, FEATURE_SLICE, FLIGHT, POSITION_BLOCK
from quad_gym.rotations import dcm_to_quaternion
from quad_gym.vehicle import State, checked_state


class _Sensor:
    """A scalar flight record that is set to a true state and measured."""

    def __init__(
        self, suite: SensorSuite, rng: np.random.Generator, vehicle: VehicleParams | None = None
    ) -> None:
        if not isinstance(rng, np.random.Generator):
            raise ValueError(f"rng must be a numpy.random.Generator, got {type(rng).__name__}")
        self._params = params_record(VehicleParams() if vehicle is None else vehicle, suite)
        self._flight = np.zeros(1, FLIGHT)
        self._flight["key"] = rng.integers(0, 2**64, size=2, dtype=np.uint64)

    def _place(self, position: ArrayLike, R_BI: ArrayLike) -> None:
        place = check.array("position", position, (3,))
        attitude = check.array("R_BI", R_BI, (3, 3))
        self._flight["r"], self._flight["q"] = place, dcm_to_quaternion(attitude)
        self._flight["instant"] += 1


class GnssReceiver(_Sensor):
    """GNSS: noisy position of an antenna and, with two antennas, a noisy baseline of exact length.

    Args:
        params: Geometry, noise, time-correlated and constant errors. `latency` is ignored: the
            caller has to delay measurements.
        rng: Seeds the sensor's random stream.

    Source: report sections 2.1 and 3.1.
    """

    def __init__(self, params: GnssParams, rng: np.random.Generator) -> None:
        imu = ImuParams(rate=params.rate)
        super().__init__(SensorSuite(imu=imu, gnss=params, camera=None), rng)
        self._drifts, self._paired = params.drifts, params.has_baseline
        self._turns = params.heading_errs
        if self._turns:
            entries.draw_sensor_errors(self._flight, self._params)

    def measure(
        self, position: ArrayLike, R_BI: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Take one measurement.

        Args:
            position: (3,) true position of the center of mass in I [m].
            R_BI: (3, 3) true attitude.

        Returns:
            (3,) primary antenna relative to the reference antenna and (3,) baseline, both in G [m];
            NaN without a second antenna.

        Raises:
            ValueError: If an argument has another shape or is not finite.
        """
        self._place(position, R_BI)
        if self._drifts:
            entries.step_gnss_drift(self._flight, self._params)
        entries.sense_gnss(self._flight, self._params, self._paired)
        if self._turns:
            entries.turn_gnss_baseline(self._flight, self._params)
        measured = self._flight["measurement"][0].copy()
        baseline = measured[BASELINE_BLOCK]
        return measured[POSITION_BLOCK], baseline if self._paired else baseline * np.nan


class Camera(_Sensor):
    """A pinhole camera that projects known features, with pixel noise, blur and a limited range.

    Args:
        params: Geometry, noise, limits and features. `latency` is ignored: the caller has to delay
            images. With `ground_hides`, the ground is at the height of `WorldParams()`.
        rng: Seeds the sensor's random stream.

    Source: report sections 2.2 and 3.2.
    """

    def __init__(self, params: CameraParams, rng: np.random.Generator) -> None:
        imu, gnss = ImuParams(rate=params.rate), GnssParams(rate=params.rate)
        super().__init__(SensorSuite(imu=imu, gnss=gnss, camera=params), rng)
        self._features, self._hides = len(params.features_I), params.ground_hides
        self._blurs = params.blur > 0.0
        self._limited = self._hides or self._blurs or math.isfinite(params.max_range)

    def measure(
        self, position: ArrayLike, R_BI: ArrayLike, body_rates: ArrayLike = (0.0, 0.0, 0.0)
    ) -> NDArray[np.float64]:
        """Take one image.

        Args:
            position: (3,) true position of the center of mass in I [m].
            R_BI: (3, 3) true attitude.
            body_rates: (3,) true angular rate in B, which blurs images if `exposure` is above 0
                [rad/s].

        Returns:
            (n_features, 2) pixels from the image's center; NaN for a feature that is behind the
            camera, too far, hidden by the ground, or whose noiseless projection lies outside the
            image.

        Raises:
            ValueError: If an argument has another shape or is not finite.
        """
        rates = check.array("body_rates", body_rates, (3,))
        self._place(position, R_BI)
        self._flight["w"] = rates
        entries.sense_features(self._flight, self._params, self._features)
        if self._limited:
            limits = (self._blurs, self._hides, self._features)
            entries.limit_features(self._flight, self._params, *limits)
        seen = self._flight["block_valid"][0, FEATURE_SLICE][: self._features] > 0.0
        pixels = self._flight["measurement"][0, FEATURE_SLICE, :2][: self._features]
        return np.where(seen[:, np.newaxis], pixels, np.nan)


class Imu(_Sensor):
    """Accelerometer and gyro with white noise and Gauss-Markov biases that drift between samples.

    Args:
        params: Lever arm, noise, biases, errors of scale and alignment, and vibration, which grows
            with the rotor speeds.
        rng: Seeds the sensor's random stream.
        vehicle: The vehicle whose specific force the accelerometer measures.

    Source: report sections 2.3 and 3.3.
    """

    def __init__(
        self, params: ImuParams, rng: np.random.Generator, vehicle: VehicleParams | None = None
    ) -> None:
        gnss = GnssParams(rate=params.rate)
        super().__init__(SensorSuite(imu=params, gnss=gnss, camera=None), rng, vehicle)
        self._averages, self._start = params.samples == "average", np.zeros(1, FLIGHT)
        self._flight["b_a"] = rng.normal(0.0, params.accel_bias_sigma, 3)
        self._flight["b_g"] = rng.normal(0.0, params.gyro_bias_sigma, 3)
        self._disturbed = params.errs or params.vibrates
        if params.errs:
            entries.draw_sensor_errors(self._flight, self._params)

    @property
    def accel_bias(self) -> NDArray[np.float64]:
        """Present true accelerometer bias (3,) in B [m/s^2]."""
        return self._flight["b_a"][0].copy()

    @property
    def gyro_bias(self) -> NDArray[np.float64]:
        """Present true gyro bias (3,) in B [rad/s]."""
        return self._flight["b_g"][0].copy()

    def measure(
        self,
        state: State,
        disturbance_I: ArrayLike = (0.0, 0.0, 0.0),
        *,
        since: State | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Take one sample; the biases change by one tick after it.

        Args:
            state: The true state at present, see `quad_gym.vehicle.STATE_SHAPES`.
            disturbance_I: (3,) external force in I [N]; where samples are averages, the change of
                the state already includes it.
            since: The true state one tick ago; required where samples are averages, and only there.

        Returns:
            (3,) angular rate in B [rad/s] and (3,) specific force in B [m/s^2].

        Raises:
            ValueError: If a state is missing, incomplete, has other shapes or is not finite.
        """
        s = checked_state(state)
        force = check.array("disturbance_I", disturbance_I, (3,))
        if self._averages is (since is None):
            raise ValueError(
                "since must be the state one tick ago if ImuParams.samples is 'average', and only "
                "then"
            )
        if since is not None:
            self._set(self._start, checked_state(since, "since"))
        f = self._flight
        f["instant"] += 1
        self._set(f, s)
        f["disturbance"] = force
        if self._averages:
            entries.sense_imu_average(f, self._params, self._start)
        else:
            entries.sense_imu(f, self._params)
        if self._disturbed:
            entries.disturb_imu(f, self._params)
        gyro, accel = f["gyro"][0].copy(), f["accel"][0].copy()
        entries.step_biases(f, self._params)
        return gyro, accel

    @staticmethod
    def _set(flight: NDArray[Any], state: dict[str, NDArray[np.float64]]) -> None:
        """Write a checked state into a record."""
        flight["r"], flight["q"] = state["position"], dcm_to_quaternion(state["R_BI"])
        flight["v"], flight["w"] = state["velocity"], state["body_rates"]
        flight["rotor_speeds"] = state["rotor_speeds"]
