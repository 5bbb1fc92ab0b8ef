"""`Measurements` of many flights that arrive at an instant, and the `Start` of episodes."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.memory import FlightMemory
from quad_gym.params.aid_table import AID_PARAMS
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    AID_BLOCK,
    AID_MOST,
    AID_ROW,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    WIDTH,
    Aid,
    Sensor,
    field_of_flights,
)
from quad_gym.records.reading import SensorReading

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]


def _record(name: str, meaning: str) -> "cached_property[Floats]":
    """Make a property of a field of the flights' records."""

    def read(self: "Measurements") -> Floats:
        return self._batch.record(name)

    read.__doc__ = meaning
    return cached_property(read)


class Measurements:
    """IMU sample of a tick, and the measurements that arrive at its end.

    Arrays have one row per flight, and are read when first used. Measurements are raw: with biases,
    noise, latency and faults. A sensor that the suite lacks is None. Each sensor of
    `quad_gym.params.aid_table` is an attribute with its name.

    Attributes:
        count: Number of flights, n.
        dt: Duration of a tick [s].
        sensors: The suite that an estimator may assume.
        vehicle: The vehicle that it may assume.
        ground_height: Height of the ground in I, for optical flow and range finder [m].
    """

    def __init__(self, batch: FlightMemory, sample: NDArray[Any]) -> None:
        self._batch, self._sample = batch, sample
        self.count, self.dt = batch.count, batch.sensors.imu.dt
        self.sensors: SensorSuite = batch.sensors
        self.vehicle: VehicleParams = batch.vehicle
        self.ground_height = batch.world.ground_height

    @cached_property
    def gyro(self) -> Floats:
        """Angular rate in B, (n, 3) [rad/s]: the sample with which to predict over the tick.

        It is taken at the start of the tick or, with `ImuParams.samples="average"`, the mean.
        """
        return field_of_flights(self._sample, "gyro", self.count)

    @cached_property
    def accel(self) -> Floats:
        """Specific force in B, (n, 3) [m/s^2], of the same sample."""
        return field_of_flights(self._sample, "accel", self.count)

    @cached_property
    def time(self) -> Floats:
        """Time since the start of the episode, (n,) [s]."""
        return self._batch.record("tick") * self.dt

    @cached_property
    def gyro_now(self) -> Floats:
        """Angular rate that the gyro measures at this instant, the end of the tick, (n, 3)."""
        return field_of_flights(self._batch._exchange, "w_meas", self.count)

    action = _record("action", "Action of the control period, in [-1, 1], (n, 4).")

    @cached_property
    def features(self) -> Floats:
        """Features of the camera on the map, (n, features, 3) in I [m]."""
        return self._batch.feature_places()

    # ---- readings -----------------------------------------------------------------------------

    @cached_property
    def gnss_position(self) -> SensorReading | None:
        """Primary antenna, (n, 3) in I [m]."""
        return self._gnss("gnss_position", POSITION_BLOCK, self.sensors.gnss is not None)

    @cached_property
    def gnss_baseline(self) -> SensorReading | None:
        """Vector from the primary to the secondary antenna, (n, 3) in I [m]."""
        gnss = self.sensors.gnss
        return self._gnss("gnss_baseline", BASELINE_BLOCK, gnss is not None and gnss.has_baseline)

    @cached_property
    def gnss_velocity(self) -> SensorReading | None:
        """Velocity of the primary antenna, (n, 3) in I [m/s]."""
        gnss = self.sensors.gnss
        has = gnss is not None and gnss.velocity_sigma is not None
        return self._gnss("gnss_velocity", VELOCITY_BLOCK, has)

    @cached_property
    def pixels(self) -> SensorReading | None:
        """Projections of the features, from the center of the image, (n, features, 2) [pixels]."""
        if self.sensors.camera is None:
            return None
        count = len(self.sensors.camera.features_I)
        new = self._new(FEATURE_BLOCKS, count)
        return self._reading("pixels", new, Sensor.CAMERA, slice(None), slice(count))

    def __getattr__(self, name: str) -> SensorReading | None:
        """Measurement of a sensor of `AID_PARAMS` by its name, (n, ...)."""
        if name not in AID_PARAMS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        params = getattr(self.sensors, name)
        found = None
        if params is not None:
            aid = Aid[name.upper()]
            new, row = self._new(AID_BLOCK[aid], params.blocks), AID_ROW[aid]
            found = self._reading(
                "aid_measurement",
                new,
                Sensor[aid.name],
                slice(None),
                slice(row, row + params.blocks),
            )
            numbers = found.value[..., : params.length].reshape(self.count, *params.shape)
            found = found._replace(value=numbers, new=new[:, 0] if AID_MOST[aid] == 1 else new)
        self.__dict__[name] = found
        return found

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *AID_PARAMS]

    def _gnss(self, name: str, block: int, has: bool) -> SensorReading | None:
        if not has:
            return None
        found = self._reading(name, self._new(block, 1)[:, 0], Sensor.GNSS)
        x, y, z = found.value.T[:, :, np.newaxis]
        R = self._batch.R_IG
        return found._replace(value=x * R[:, 0] + y * R[:, 1] + z * R[:, 2])  # as in any batch

    def _new(self, first: int, count: int) -> Truths:
        """True where one of some blocks arrives, (n, count)."""
        valid = self._batch._blocks["block_valid"][:, first : first + count]
        rows = valid.transpose(0, 2, 1).reshape(len(valid) * WIDTH, count)
        return np.asarray(rows[: self.count] > 0.0)

    def _reading(
        self, field: str, new: Truths, sensor: Sensor, *part: int | slice
    ) -> SensorReading:
        age = float(self._batch._settings["sensor_delay"][0, sensor] * self.dt)
        values = self._batch.record(field)[part or slice(None)]
        values[~new] = np.nan
        return SensorReading(values, new, age)


class StartView(Measurements):
    """Start of episodes as the built-in filter has it, and the measurements at that instant.

    A cold filter has its first fix: the position from the antenna, or from the mark from which the
    vehicle starts; the heading from the baseline, the magnetometer, or the mark; a level attitude;
    velocity and biases of zero. With `filter_start="warm"` it has converged. The first fix is not
    among the measurements, except with `FilterParams.reuse_first_fix`. `gyro` and `accel` are the
    sample of the first instant; they have no meaning with `ImuParams.samples="average"`.
    """

    def __init__(self, batch: FlightMemory, sample: NDArray[Any], mask: Truths) -> None:
        super().__init__(batch, sample)
        self._mask = mask

    def _new(self, first: int, count: int) -> Truths:
        return super()._new(first, count) & self._mask[:, np.newaxis]

    position = _record("r_hat", "Position, (n, 3) in I [m].")
    velocity = _record("v_hat", "Velocity, (n, 3) in I [m/s].")
    R_BI = _record("R_hat", "Attitude, (n, 3, 3).")
    accel_bias = _record("b_a_hat", "Accelerometer bias, (n, 3) in B [m/s^2].")
    gyro_bias = _record("b_g_hat", "Gyro bias, (n, 3) in B [rad/s].")

    @cached_property
    def covariance(self) -> Floats:
        """Covariance in the order of estimates, (n, 15, 15)."""
        return self._batch.covariance()
