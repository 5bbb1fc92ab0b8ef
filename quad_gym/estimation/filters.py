"""An unscented and an extended Kalman filter for one vehicle."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.estimation.alignment import leveled
from quad_gym.estimation.estimate import Estimate
from quad_gym.kernels import single
from quad_gym.kernels.compiling.linked import linked_table
from quad_gym.kernels.compiling.stages import Stage
from quad_gym.packing.aids import pack_aid_settings
from quad_gym.packing.flight import form_of, params_block, params_record
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    AID_FREEDOMS,
    FLIGHT_BLOCK,
    SETTINGS,
    WORK_BLOCK,
    Act,
    Aid,
    FilterForm,
    aligned_zeros,
)

_STATE = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat")

FARTHEST_FIX = 1e6
"""From the reference antenna [m]; positions from the center of the Earth are farther."""


def _require_relative(position_G: NDArray[np.float64]) -> None:
    """Refuse a first fix that is no place near the reference antenna."""
    if np.abs(position_G).max() > FARTHEST_FIX:
        raise ValueError(
            "gnss_position_G must be relative to the reference antenna "
            f"(GnssParams.reference_antenna_G), within {FARTHEST_FIX:g} m of it, got "
            f"{position_G}; from an absolute position in ECEF subtract that of the antenna"
        )


class _KalmanFilter(Estimate):
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
        pack_aid_settings(self._settings[0], sensors, sensors)
        self._slow = bool(self._settings["slow_states"] > 0)
        self._flight = aligned_zeros(1, FLIGHT_BLOCK)
        self._work = aligned_zeros(1, WORK_BLOCK)
        self._work["mask"] = 1.0
        self._running = False

    # ---- the cycle ----------------------------------------------------------------------------

    def initialize(
        self,
        gnss_position_G: ArrayLike,
        gnss_baseline_G: ArrayLike | None = None,
        heading: float | None = None,
        *,
        accel: ArrayLike | None = None,
        magnetometer: ArrayLike | None = None,
    ) -> None:
        """Start from a first fix: attitude by Wahba's problem, the body z axis taken as vertical.

        A baseline within 12 degrees of the vertical hardly tells the heading; then `heading` does,
        with the deviation `placement.heading_sigma` of the suite.

        GNSS with one antenna has no baseline. Then the vehicle is taken for level, or its tilt is
        that in which a resting accelerometer measures `accel`; and the heading is that in which the
        field points where the `magnetometer` sees it, or else `heading`. The covariance says how
        their errors go with those of accelerometer bias, hard iron and declination.

        Args:
            gnss_position_G: (3,) primary antenna relative to the reference antenna, in G [m].
            gnss_baseline_G: (3,) primary to secondary antenna, in G [m]; None for one antenna.
            heading: Of the body x axis, from east toward north, for a steep baseline or one antenna
                [rad]; None: not known. The filter then takes it for anything, and as it linearizes,
                it may be lost.
            accel: (3,) specific force at rest, in B [m/s^2]; for one antenna.
            magnetometer: (3,) magnetic field in B [T]; likewise. It counts once: do not `update`
                with the same sample.

        Raises:
            ValueError: If an argument has another shape or is not finite, the position is farther
                than FARTHEST_FIX from the reference antenna, or the baseline is zero; or the suite
                has no GNSS, or lacks a sensor whose measurement is given, or a baseline is missing.
        """
        self._require_gnss("initialize: start with set_state() instead")
        position = check.array("gnss_position_G", gnss_position_G, (3,))
        _require_relative(position)
        gnss = self.sensors.gnss
        if gnss is not None and gnss.has_baseline:
            if gnss_baseline_G is None:
                raise ValueError("gnss_baseline_G must be given for GNSS with two antennas")
            if accel is not None or magnetometer is not None:
                raise ValueError(
                    "accel and magnetometer must not be given for GNSS with two antennas, whose "
                    "baseline tells the heading"
                )
            baseline = self._checked_baseline(gnss_baseline_G)
        else:
            if gnss_baseline_G is not None:
                raise ValueError("gnss_baseline_G must be None for GNSS with one antenna")
            baseline = np.zeros(3)
        force = None if accel is None else check.array("accel", accel, (3,))
        if force is not None and not force.any():
            raise ValueError("accel must have a direction, got zeros")
        field = self._checked_aids({"magnetometer": magnetometer}).get(Aid.MAGNETOMETER)
        x_I = np.zeros(3)
        if heading is not None:
            angle = check.number("heading", heading)
            x_I[:2] = np.cos(angle), np.sin(angle)
        self._set("gnss_position", position)
        self._set("gnss_baseline", baseline)
        self._start(x_I)
        if force is not None:
            self._level_by(force)
        if field is not None:
            self._flight["aid_measurement"][0, Aid.MAGNETOMETER] = field[:, np.newaxis]
            self._run_stage(Stage[Aid.MAGNETOMETER.name], int(Act.ALIGN))
        self._running = True

    def _level_by(self, force: NDArray[np.float64]) -> None:
        """Tilt the level start as the accelerometer says, with the covariance of that."""
        L, R_hat, fix_G = (
            self._flight[name][0, ..., 0] for name in ("L", "R_hat", "gnss_position")
        )
        R_BI, P = leveled(R_hat, L @ L.T, force, self.sensors)
        R_IG, antenna_B = (self._params[name][0, ..., 0] for name in ("R_IG", "antenna"))
        self._set("r_hat", R_IG @ fix_G - R_BI.T @ antenna_B)
        self._set("R_hat", R_BI)
        self._set("L", np.linalg.cholesky(P))

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
        stages = single.SLOW_FILTER_STAGES if self._slow else single.FILTER_STAGES
        own = {Stage[aid.name] for aid in self.sensors.aids}
        return linked_table(stages | own, single.FILTER_ENTRIES)

    def _run(self, stage: Stage, with_slow: Stage) -> None:
        """Run a stage, or the one of a filter that estimates slow errors; warn of news.

        News are what goes wrong in it.
        """
        before = self.status
        self._run_stage(with_slow if self._slow else stage, 0)
        news = self.status & ~before
        if news:
            warnings.warn(
                f"The filter kept its last good state: {news.name}", RuntimeWarning, stacklevel=3
            )

    def _run_stage(self, stage: Stage, flag: int) -> None:
        p = self._params
        others = (p, p, self._settings, self._work, self._table(), flag)
        single.run_stage(self._flight.ctypes.data, 0, 1, int(stage), *others)

    def _set(self, name: str, value: NDArray[Any]) -> None:
        """Write a field of the flight."""
        self._flight[name][0] = value[..., np.newaxis]

    def update(
        self,
        gnss_position_G: ArrayLike | None = None,
        gnss_baseline_G: ArrayLike | None = None,
        pixels: ArrayLike | None = None,
        gnss_velocity_G: ArrayLike | None = None,
        **aids: ArrayLike | None,
    ) -> None:
        """Condition the estimate on measurements of one instant; None: not measured.

        Args:
            gnss_position_G: (3,) primary antenna relative to the reference antenna, in G [m].
            gnss_baseline_G: (3,) primary to secondary antenna, in G [m].
            pixels: (n_features, 2) feature projections [pixels]; a row with a NaN is a feature not
                seen.
            gnss_velocity_G: (3,) velocity of the primary antenna, in G [m/s]; for suites whose GNSS
                measures it. Its lever arm is turned with the last `gyro` predicted with.
            aids: What aiding sensors measure that the suite has: `barometer`, the height in I by
                static pressure [m]; `magnetometer`, (3,) the magnetic field in B [T].

        Raises:
            ValueError: If an argument has another shape or is not finite, or the suite lacks the
                sensor whose measurement is given; the estimate is unchanged then.
            RuntimeError: Before `initialize` or `set_state`.
        """
        self._require_start()
        f = self._flight
        aided = self._checked_aids(aids)
        if gnss_position_G is not None or gnss_baseline_G is not None:
            self._require_gnss("update")
        position = baseline = velocity = image = None
        if gnss_position_G is not None:
            position = check.array("gnss_position_G", gnss_position_G, (3,))
        if gnss_baseline_G is not None:
            if self.sensors.gnss is not None and not self.sensors.gnss.has_baseline:
                raise ValueError("gnss_baseline_G must be None for GNSS with one antenna")
            baseline = self._checked_baseline(gnss_baseline_G)
        if pixels is not None:
            image = check.array("pixels", pixels, (self._features, 2), allow_nan=True)

        if gnss_velocity_G is not None:
            if self.sensors.gnss is None or self.sensors.gnss.velocity_sigma is None:
                raise ValueError("the sensor suite has no GNSS velocity to update with")
            velocity = check.array("gnss_velocity_G", gnss_velocity_G, (3,))

        f["position_valid"], f["baseline_valid"] = position is not None, baseline is not None
        f["velocity_valid"] = velocity is not None
        f["feature_valid"], f["aid_valid"] = 0.0, 0.0
        for aid, value in aided.items():
            f["aid_valid"][0, aid] = 1.0
            f["aid_measurement"][0, aid, : len(value)] = value[:, np.newaxis]
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
        self._run(Stage.UPDATE, Stage.UPDATE_WITH_SLOW)

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
        self._run(Stage.PREDICT, Stage.PREDICT_WITH_SLOW)

    def _require_gnss(self, what: str) -> None:
        if self.sensors.gnss is None:
            raise ValueError(f"the sensor suite has no GNSS to {what}")

    def _checked_aids(self, given: dict[str, Any]) -> dict[Aid, NDArray[np.float64]]:
        """What aiding sensors measure, as arrays; None: not measured."""
        check.keywords(given, tuple(aid.name.lower() for aid in Aid), "update")
        found = {}
        for name, value in given.items():
            aid = Aid[name.upper()]
            if value is None:
                continue
            if aid not in self.sensors.aids:
                raise ValueError(f"the sensor suite has no {name} to update with")
            alone = AID_FREEDOMS[aid] == 1
            numbers = [check.number(name, value)] if alone else value
            found[aid] = check.array(name, numbers, (AID_FREEDOMS[aid],))
        return found

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
