"""State estimation for one vehicle: Wahba's problem, an unscented and an extended Kalman filter."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import single
from quad_gym.kernels.compiling.linked import linked_table
from quad_gym.kernels.compiling.stages import Stage
from quad_gym.packing.flight import form_of, params_block, params_record
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    FEATURE_BLOCKS,
    FLIGHT_BLOCK,
    SETTINGS,
    WORK_BLOCK,
    FilterForm,
    FilterStatus,
    aligned_zeros,
)

_STATE = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat")

FARTHEST_FIX = 1e6
"""From the reference antenna [m]; positions from the center of the Earth are farther."""


def solve_wahba(weights: ArrayLike, v_I: ArrayLike, v_B: ArrayLike) -> NDArray[np.float64]:
    """The rotation that best turns vectors in I into the same vectors seen in B.

    Minimises `sum_i a_i |v_B,i - R_BI v_I,i|^2`.

    Args:
        weights: (n,) weights a_i, none negative and not all zero.
        v_I: (n, 3) vectors in I.
        v_B: (n, 3) the same vectors in B.

    Returns:
        (3, 3) R_BI, a proper rotation.

    Raises:
        ValueError: If the shapes do not fit, a value is not finite, or the vectors leave the
            rotation open (all parallel, for example).

    Source: report section 4.1; F. L. Markley, J. Astronautical Sciences 36(3), 1988.
    """
    a = check.array("weights", weights, (None,))
    vectors_I = check.array("v_I", v_I, (len(a), 3))
    vectors_B = check.array("v_B", v_B, (len(a), 3))
    if (a < 0.0).any() or not (a > 0.0).any():
        raise ValueError(f"weights must be at least 0 and not all zero, got {a}")
    R_BI = np.empty((3, 3))
    uniqueness = single.wahba_of_vectors(a, vectors_I, vectors_B, R_BI)
    if not uniqueness > 1e-10:
        raise ValueError(
            "v_I and v_B must determine a rotation: two directions at least must differ"
        )
    return R_BI


def _require_relative(position_G: NDArray[np.float64]) -> None:
    """Refuse a first fix that is no place near the reference antenna."""
    if np.abs(position_G).max() > FARTHEST_FIX:
        raise ValueError(
            "gnss_position_G must be relative to the reference antenna "
            f"(GnssParams.reference_antenna_G), within {FARTHEST_FIX:g} m of it, got "
            f"{position_G}; from an absolute position in ECEF subtract that of the antenna"
        )


class _KalmanFilter:
    """What the filters have in common: their interface, and all but the kind of their kernels.

    They run the stages of flights on one block, all of whose lanes hold the same flight.
    """

    _kind: str

    def __init__(self, sensors: SensorSuite) -> None:
        if not isinstance(sensors, SensorSuite):
            raise ValueError(f"sensors must be a SensorSuite, got {type(sensors).__name__}")
        sensors.require_filter()
        self.sensors = sensors
        self._features = 0 if sensors.camera is None else len(sensors.camera.features_I)
        params = params_record(VehicleParams(), sensors)
        params["gravity"] = sensors.estimator.gravity
        self._params = params_block(params)
        lever_arm = FilterForm.LEVER_SAMPLES if any(sensors.imu.lever_arm_B) else FilterForm(0)
        estimator = sensors.estimator.replace(kind=self._kind)
        form = form_of(estimator, innovations=True, lever_arm=lever_arm)
        self._settings = np.zeros(1, SETTINGS)
        self._settings["form"], self._settings["feature_count"] = int(form), self._features
        self._flight = aligned_zeros(1, FLIGHT_BLOCK)
        self._work = aligned_zeros(1, WORK_BLOCK)
        self._work["mask"] = 1.0
        self._running = False

    # ---- the cycle ----------------------------------------------------------------------------

    def initialize(
        self,
        gnss_position_G: ArrayLike,
        gnss_baseline_G: ArrayLike,
        heading: float | None = None,
    ) -> None:
        """Start from a first fix: attitude by Wahba's problem, the body z axis taken as vertical.

        A baseline within 12 degrees of the vertical hardly tells the heading; then `heading` does,
        with the deviation `placement.heading_sigma` of the suite.

        Args:
            gnss_position_G: (3,) primary antenna relative to the reference antenna, in G [m].
            gnss_baseline_G: (3,) primary to secondary antenna, in G [m].
            heading: Of the body x axis, from east toward north, for a steep baseline [rad]; None:
                not known. The filter of a steep baseline then takes it for anything, and as it
                linearizes, it may be lost.

        Raises:
            ValueError: If an argument has another shape or is not finite, the position is farther
                than FARTHEST_FIX from the reference antenna, or the baseline is zero; or the suite
                has no GNSS.
        """
        self._require_gnss("initialize: start with set_state() instead")
        position = check.array("gnss_position_G", gnss_position_G, (3,))
        _require_relative(position)
        baseline = self._checked_baseline(gnss_baseline_G)
        x_I = np.zeros(3)
        if heading is not None:
            angle = check.number("heading", heading)
            x_I[:2] = np.cos(angle), np.sin(angle)
        self._set("gnss_position", position)
        self._set("gnss_baseline", baseline)
        self._start(x_I)
        self._running = True

    def set_state(
        self,
        *,
        position: ArrayLike,
        velocity: ArrayLike,
        R_BI: ArrayLike,
        accel_bias: ArrayLike,
        gyro_bias: ArrayLike,
        covariance: ArrayLike,
    ) -> None:
        """Start from a given estimate.

        Args:
            position: (3,) in I [m].
            velocity: (3,) in I [m/s].
            R_BI: (3, 3) attitude, a rotation.
            accel_bias: (3,) in B [m/s^2].
            gyro_bias: (3,) in B [rad/s].
            covariance: (15, 15) in the order r, v, e, b_a, b_g; symmetric positive definite.

        Raises:
            ValueError: If an argument has another shape, is not finite, R_BI is no rotation, or the
                covariance is not symmetric positive definite.
        """
        rotation = check.array("R_BI", R_BI, (3, 3))
        if abs(rotation @ rotation.T - np.eye(3)).max() > 1e-9 or np.linalg.det(rotation) < 0.0:
            raise ValueError("R_BI must be a rotation matrix")
        P = check.array("covariance", covariance, (15, 15))
        if not np.allclose(P, P.T, rtol=1e-9, atol=0.0):
            raise ValueError("covariance must be symmetric")
        try:
            L = np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            raise ValueError("covariance must be positive definite") from None
        values = (
            check.array("position", position, (3,)),
            check.array("velocity", velocity, (3,)),
            rotation,
            check.array("accel_bias", accel_bias, (3,)),
            check.array("gyro_bias", gyro_bias, (3,)),
        )
        self._start(np.zeros(3))  # what the filter remembers begins anew; the estimate is given
        for name, value in zip((*_STATE, "L"), (*values, L), strict=True):
            self._set(name, value)
        self._running = True

    def _start(self, x_I: NDArray[np.float64]) -> None:
        """Start from the fix in the record, with clocks at zero and nothing remembered."""
        self._table()
        self._flight["tick"], self._flight["w_before"] = 0.0, np.nan
        single.start_filter(self._flight, self._params, self._settings, self._work, x_I)

    def _table(self) -> NDArray[Any]:
        """The table of the stages that the filter runs."""
        drifts = self.sensors.drifts
        stages = single.DRIFT_FILTER_STAGES if drifts else single.FILTER_STAGES
        return linked_table(stages, single.FILTER_ENTRIES)

    def _run(self, stage: Stage, with_drift: Stage) -> None:
        """Run a stage, or the one of a filter that estimates the slow error of GNSS; warn of news.

        News are what goes wrong in it.
        """
        chosen = with_drift if self.sensors.drifts else stage
        before, p = self.status, self._params
        others = (p, p, self._settings, self._work, self._table(), self._features)
        single.run_stage(self._flight.ctypes.data, 0, 1, int(chosen), *others)
        news = self.status & ~before
        if news:
            warnings.warn(
                f"The filter kept its last good state: {news.name}", RuntimeWarning, stacklevel=3
            )

    def _set(self, name: str, value: NDArray[Any]) -> None:
        """Write a field of the flight."""
        self._flight[name][0] = value[..., np.newaxis]

    def update(
        self,
        gnss_position_G: ArrayLike | None = None,
        gnss_baseline_G: ArrayLike | None = None,
        pixels: ArrayLike | None = None,
        gnss_velocity_G: ArrayLike | None = None,
    ) -> None:
        """Condition the estimate on measurements of one instant; None: not measured.

        Args:
            gnss_position_G: (3,) primary antenna relative to the reference antenna, in G [m].
            gnss_baseline_G: (3,) primary to secondary antenna, in G [m].
            pixels: (n_features, 2) feature projections [pixels]; a row with a NaN is a feature not
                seen.
            gnss_velocity_G: (3,) velocity of the primary antenna, in G [m/s]; for suites whose GNSS
                measures it. Its lever arm is turned with the last `gyro` predicted with.

        Raises:
            ValueError: If an argument has another shape or is not finite, or the suite has no GNSS
                but its measurement is given; the estimate is unchanged then.
            RuntimeError: Before `initialize` or `set_state`.
        """
        self._require_start()
        f = self._flight
        if gnss_position_G is not None or gnss_baseline_G is not None:
            self._require_gnss("update")
        position = baseline = velocity = image = None
        if gnss_position_G is not None:
            position = check.array("gnss_position_G", gnss_position_G, (3,))
        if gnss_baseline_G is not None:
            baseline = self._checked_baseline(gnss_baseline_G)
        if pixels is not None:
            image = check.array("pixels", pixels, (self._features, 2), allow_nan=True)

        if gnss_velocity_G is not None:
            if self.sensors.gnss is None or self.sensors.gnss.velocity_sigma is None:
                raise ValueError("the sensor suite has no GNSS velocity to update with")
            velocity = check.array("gnss_velocity_G", gnss_velocity_G, (3,))

        f["position_valid"], f["baseline_valid"] = position is not None, baseline is not None
        f["velocity_valid"] = velocity is not None
        f["feature_valid"] = 0.0
        if position is not None:
            self._set("gnss_position", position)
        if baseline is not None:
            self._set("gnss_baseline", baseline)
        if velocity is not None:
            self._set("gnss_velocity", velocity)
        if image is not None:
            seen = np.asarray(~np.isnan(image).any(axis=1))[:, np.newaxis]
            f["feature_valid"][0, : self._features] = seen
            f["pixels"][0, : self._features] = np.where(seen, image, 0.0)[..., np.newaxis]
        self._run(Stage.UPDATE, Stage.UPDATE_WITH_DRIFT)

    def predict(self, gyro: ArrayLike, accel: ArrayLike) -> None:
        """Carry the estimate over one tick.

        Args:
            gyro: (3,) angular rate measured at the start of the tick, or its mean over it (see
                `ImuParams.samples`), in B [rad/s].
            accel: (3,) specific force, likewise, in B [m/s^2].

        Raises:
            ValueError: If an argument has another shape or is not finite; the estimate is unchanged
                then.
            RuntimeError: Before `initialize` or `set_state`.
        """
        self._require_start()
        rates = check.array("gyro", gyro, (3,))
        force = check.array("accel", accel, (3,))
        f = self._flight
        known = np.isfinite(f["w_before"]).all()
        self._set("gyro", rates)
        self._set("accel", force)
        f["tick"] += 1.0
        # they turn the lever arms of a velocity and of the accelerometer
        f["w_before"] = f["w_meas"] if known else f["gyro"]
        f["w_meas"] = f["gyro"]
        self._run(Stage.PREDICT, Stage.PREDICT_WITH_DRIFT)

    # ---- the estimate -------------------------------------------------------------------------

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) estimated position of the center of mass in I [m]."""
        return self._read("r_hat")

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(3,) estimated velocity in I [m/s]."""
        return self._read("v_hat")

    @property
    def R_BI(self) -> NDArray[np.float64]:
        """(3, 3) estimated attitude."""
        return self._read("R_hat")

    @property
    def accel_bias(self) -> NDArray[np.float64]:
        """(3,) estimated accelerometer bias in B [m/s^2]."""
        return self._read("b_a_hat")

    @property
    def gyro_bias(self) -> NDArray[np.float64]:
        """(3,) estimated gyro bias in B [rad/s]."""
        return self._read("b_g_hat")

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(15, 15) covariance of the errors, in the order r, v, e, b_a, b_g."""
        L = self._read("L")
        return L @ L.T

    @property
    def gnss_drift(self) -> NDArray[np.float64]:
        """(3,) estimated slow error of GNSS positions in I [m], zero for suites without one.

        It is zero at the start: positions count from where the receiver has the vehicle then.
        """
        return self._read("gnss_drift_hat")

    @property
    def gnss_drift_covariance(self) -> NDArray[np.float64]:
        """(3, 3) covariance of its error [m^2]."""
        L = self._read("L_drift")
        return L @ L.T

    @property
    def status(self) -> FilterStatus:
        """What has gone wrong since the start; `FilterStatus(0)` when nothing has."""
        return FilterStatus(int(self._flight["filter_status"][0, 0]))

    @property
    def nis(self) -> tuple[float, int]:
        """Normalized innovation squared of the last update, and how many measurements it had."""
        return float(self._flight["nis"][0, 0]), int(self._flight["nis_dimension"][0, 0])

    @property
    def block_nis(self) -> NDArray[np.float64]:
        """(n,) normalized innovation squared of the last position, baseline, velocity and features.

        In a filter that is right they are chi-square with 3, 2, 3 and 2 degrees of freedom; NaN:
        not measured yet.
        """
        return self._read("block_nis")[: FEATURE_BLOCKS + self._features]

    @property
    def gate_decisions(self) -> NDArray[np.int64]:
        """(n,) what became of each of these, see `quad_gym.records.Gate`."""
        return self._read("gate")[: FEATURE_BLOCKS + self._features].astype(np.int64)

    def _read(self, name: str) -> NDArray[Any]:
        self._require_start()
        return np.array(self._flight[name][0, ..., 0])

    def _require_start(self) -> None:
        if not self._running:
            raise RuntimeError("call initialize() or set_state() before using the filter")

    def _require_gnss(self, what: str) -> None:
        if self.sensors.gnss is None:
            raise ValueError(f"the sensor suite has no GNSS to {what}")

    def _checked_baseline(self, gnss_baseline_G: ArrayLike) -> NDArray[np.float64]:
        baseline = check.array("gnss_baseline_G", gnss_baseline_G, (3,))
        largest = np.abs(baseline).max()
        if largest == 0.0:
            raise ValueError("gnss_baseline_G must have a direction, got zeros")
        # its length does not count: by a power of two it comes near one, exactly
        return np.ldexp(baseline, -int(np.frexp(largest)[1]))


class UnscentedKalmanFilter(_KalmanFilter):
    """The report's UKF for one vehicle: position, velocity, attitude and IMU biases.

    One cycle is: `update` with what was measured at t_k, read the estimate, then `predict` to t_k+1
    with the IMU sample of that tick. The measurement model is that of the report's section 3.4,
    with antenna position, baseline direction and feature directions; any of them may be missing at
    any time. `FilterParams` tells where the filter may differ from the report's.

    A cycle whose result is not finite, or whose covariance would not be positive definite, leaves
    the estimate as it was, sets `status`, and warns.

    Args:
        sensors: The sensor suite whose geometry and noise the filter believes in.

    Raises:
        ValueError: If `sensors` is not a sensor suite, or its filter takes the samples of the IMU
            for something else, see `SensorSuite.require_filter`.
    """

    _kind = "ukf"


class ExtendedKalmanFilter(_KalmanFilter):
    """An error-state EKF for one vehicle: the state, models, noise and use of the UKF.

    Its covariance follows from analytic derivatives of the models at the estimate, which cost less
    than sigma points and leave out the second order; see `quad_gym.kernels.filter.ekf`.

    Args:
        sensors: The sensor suite whose geometry and noise the filter believes in.

    Raises:
        ValueError: If `sensors` is not a sensor suite, or its filter takes the samples of the IMU
            for something else, see `SensorSuite.require_filter`.

    Source: F. L. Markley, J. Guidance, Control, and Dynamics 26(2), 2003, for error angles about
    an estimated attitude.
    """

    _kind = "ekf"
