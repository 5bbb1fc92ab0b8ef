"""Sensors of one vehicle: each converts a true state to one measurement.

They run the stages of flights on a block of their own, in which all lanes are equal.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import entries
from quad_gym.kernels.stages import STAGES_OF, Stage, needed_stages
from quad_gym.packing import RecordsOfOneForm, params_block, params_record, sensor_settings
from quad_gym.params import checks as check
from quad_gym.params.camera import CameraParams
from quad_gym.params.gnss import GnssParams
from quad_gym.params.imu import ImuParams
from quad_gym.params.suites import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    BLOCKS_OF,
    FLIGHT_BLOCK,
    WORK_BLOCK,
    Act,
    aligned_zeros,
    field_of_flights,
)
from quad_gym.rotations import dcm_to_quaternion
from quad_gym.vehicle import State, checked_state


class _Sensor(RecordsOfOneForm):
    """A sensor, and the record of a flight, which is set to a true state and measured.

    Args:
        name: Name of the sensor in a suite.
        suite: A suite with the sensor, which measures at every tick.
        rng: Seeds the random stream.
        vehicle: The vehicle; None: the laboratory's.
    """

    def __init__(
        self,
        name: str,
        suite: SensorSuite,
        rng: np.random.Generator,
        vehicle: VehicleParams | None = None,
    ) -> None:
        if not isinstance(rng, np.random.Generator):
            raise ValueError(f"rng must be a numpy.random.Generator, got {type(rng).__name__}")
        self._name = name
        record = params_record(VehicleParams() if vehicle is None else vehicle, suite)
        self._params, self._settings = params_block(record), sensor_settings(suite)
        self._flight, self._work = aligned_zeros(1, FLIGHT_BLOCK), aligned_zeros(1, WORK_BLOCK)
        self._work["mask"] = 1.0
        self._write(key=rng.integers(0, 2**64, size=2, dtype=np.uint64))
        self._choose_stages()

    def _choose_stages(self) -> None:
        needed = needed_stages(self._settings[0])
        self._stages = {stage: needed[stage] for stage in STAGES_OF[self._name] if stage in needed}

    def _without_process(self) -> dict[str, Any]:
        return {}

    def _write(self, **values: ArrayLike) -> None:
        """Write fields of the record."""
        for name, value in values.items():
            self._flight[name] = np.asarray(value)[..., np.newaxis]

    def _read(self, name: str) -> NDArray[np.float64]:
        """Return a copy of a field of the record."""
        return np.asarray(field_of_flights(self._flight, name, 1)[0])

    def _run(self, stage: Stage, flag: int = 0) -> None:
        """Run a stage, if this sensor needs it."""
        if stage in self._stages:
            table = entries.linked_table(self._stages, (entries.run_stage.name,))
            others = (self._params, self._params, self._settings, self._work, table, flag)
            entries.run_stage(self._flight.ctypes.data, 0, 1, int(stage), *others)


class _Aiding(_Sensor):
    """A sensor other than the IMU."""

    def __init__(self, name: str, suite: SensorSuite, rng: np.random.Generator) -> None:
        prompt = getattr(suite, name).replace(phase=0.0, latency=0.0)
        super().__init__(name, suite.replace(**{name: prompt}), rng)
        self._run(Stage[name.upper()], Act.BEGIN)

    def _measure(self, position: ArrayLike, R_BI: ArrayLike) -> None:
        """Measure at a new instant, from a true position and attitude."""
        place = check.array("position", position, (3,))
        attitude = dcm_to_quaternion(check.array("R_BI", R_BI, (3, 3)))
        self._write(r=place, q=attitude)
        self._flight["instant"] += 1
        self._flight["tick"] += 1
        self._run(Stage[self._name.upper()], Act.SAMPLE)

    def _found(self, reading: str) -> NDArray[np.float64]:
        """Return the blocks of a reading, (n, 3); NaN where it has not been measured."""
        blocks = BLOCKS_OF[reading]
        valid = self._read("block_valid")[blocks, np.newaxis] > 0.0
        return np.where(valid, self._read("measurement")[blocks], np.nan)


class GnssReceiver(_Aiding):
    """GNSS: noisy position of an antenna and, with two antennas, a noisy baseline of exact length.

    Args:
        params: Geometry, noise, time-correlated and constant errors. `latency` is ignored: the
            caller has to delay measurements.
        rng: Seeds the sensor's random stream.

    Source: report sections 2.1 and 3.1.
    """

    def __init__(self, params: GnssParams, rng: np.random.Generator) -> None:
        imu = ImuParams(rate=params.rate)
        super().__init__("gnss", SensorSuite(imu=imu, gnss=params, camera=None), rng)

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
        self._measure(position, R_BI)
        return self._found("gnss_position")[0], self._found("gnss_baseline")[0]


class Camera(_Aiding):
    """A pinhole camera that projects known features, with pixel noise, blur and a limited range.

    Args:
        params: Geometry, noise, limits and features. `latency` is ignored: the caller has to delay
            images. With `ground_hides`, the ground is at the height of `WorldParams()`.
        rng: Seeds the sensor's random stream.

    Source: report sections 2.2 and 3.2.
    """

    def __init__(self, params: CameraParams, rng: np.random.Generator) -> None:
        imu, gnss = ImuParams(rate=params.rate), GnssParams(rate=params.rate)
        super().__init__("camera", SensorSuite(imu=imu, gnss=gnss, camera=params), rng)
        self._features = len(params.features_I)

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
        self._write(w=check.array("body_rates", body_rates, (3,)))
        self._measure(position, R_BI)
        return self._found("pixels")[: self._features, :2]


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
        super().__init__("imu", SensorSuite(imu=params, gnss=gnss, camera=None), rng, vehicle)
        self._averages = params.samples == "average"
        self._write(b_a=rng.normal(0.0, params.accel_bias_sigma, 3))
        self._write(b_g=rng.normal(0.0, params.gyro_bias_sigma, 3))
        self._run(Stage.BEGIN_IMPERFECT)

    @property
    def accel_bias(self) -> NDArray[np.float64]:
        """Present true accelerometer bias (3,) in B [m/s^2]."""
        return self._read("b_a")

    @property
    def gyro_bias(self) -> NDArray[np.float64]:
        """Present true gyro bias (3,) in B [rad/s]."""
        return self._read("b_g")

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
            self._place(checked_state(since, "since"))
            self._run(Stage.KEEP_START)
        self._flight["instant"] += 1
        self._place(s)
        self._write(disturbance=force)
        self._run(Stage.AVERAGE_IMU if self._averages else Stage.SAMPLE)
        gyro, accel = self._read("gyro"), self._read("accel")
        self._run(Stage.DRIFT_BIASES)
        return gyro, accel

    def _place(self, state: dict[str, NDArray[np.float64]]) -> None:
        """Write a checked state into the record."""
        self._write(r=state["position"], q=dcm_to_quaternion(state["R_BI"]))
        self._write(v=state["velocity"], w=state["body_rates"], rotor_speeds=state["rotor_speeds"])
