"""An unscented and an extended Kalman filter for one vehicle."""

import math
import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.estimation.correlated import update_with_correlated
from quad_gym.estimation.engine import Engine
from quad_gym.estimation.estimate import Estimate
from quad_gym.estimation.first_fix import checked_fix
from quad_gym.estimation.headings import RESOLVED, collapse, moments, update_and_weigh
from quad_gym.estimation.history import SAME_TIME, History
from quad_gym.estimation.samples import Measurement, Sample, checked_measurement
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FilterForm, FilterStatus

_STATE = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat")

LONGEST_STEP = 1.0
"""Of a prediction with one sample of the IMU [s], unless the suite's tick is longer."""

_OF_GATES = int(FilterForm.GATE)


class _KalmanFilter(Estimate):
    """What the filters have in common: their interface, and all but the kind of their kernels."""

    _kind: str

    def __init__(self, sensors: SensorSuite, *, window: float = 0.5) -> None:
        if not isinstance(sensors, SensorSuite):
            raise ValueError(f"sensors must be a SensorSuite, got {type(sensors).__name__}")
        sensors.require_filter()
        length = check.number("window", window, least=0.0, most=60.0)
        self.sensors = sensors
        self._engine = Engine(sensors, self._kind)
        self._history = History(length, self._apply, self._copy, self._restore)
        self._log_weights, self._moments = None, None
        self._gyro: NDArray[np.float64] | None = None
        self._awaited: Measurement | None = None
        self._report, self._reported = None, Measurement()
        self._running = False

    # ---- the cycle ----------------------------------------------------------------------------

    def initialize(
        self,
        gnss_position_G: ArrayLike,
        gnss_baseline_G: ArrayLike | None = None,
        heading: float | None = None,
        *,
        heading_sigma: float | None = None,
        magnetometer: ArrayLike | None = None,
        magnetometer_sigma: float | None = None,
        gnss_velocity_G: ArrayLike | None = None,
        course: bool = False,
        gnss_sigma: ArrayLike | None = None,
        velocity_sigma: float | None = None,
        tilt_sigma: float | None = None,
        accel: ArrayLike | None = None,
        accel_sigma: float | None = None,
        time: float = 0.0,
    ) -> None:
        """Start from a first fix.

        With a baseline: attitude by Wahba's problem, the body z axis taken as vertical. A baseline
        within 12 degrees of the vertical hardly tells the heading; then `heading` does, with the
        deviation `initial_pose.heading_sigma` of the suite.

        Without: the vehicle is taken as level, and its heading comes from the first of these that
        is given: `heading`, `magnetometer`, or with `course` the direction of `gnss_velocity_G`. If
        none is, the heading may be any, and the motion tells it: see `heading_known`.

        With `accel`: roll and pitch are those of a vehicle at rest whose accelerometer measures
        this, however tilted it stands. The heading comes from a baseline or from one of the above.

        The covariance says how uncertain all of this is, and which errors depend on each other: a
        tilt or hard iron turns the magnetic heading, a bias of the accelerometer tilts the start,
        and the center of mass hangs below its antenna.

        Args:
            gnss_position_G: (3,) primary antenna relative to the reference antenna, in G [m].
            gnss_baseline_G: (3,) primary to secondary antenna, in G [m]; None: not measured.
            heading: Of the body x axis, from east toward north [rad]; None: not known. The filter
                of a steep baseline then takes it for anything, and as it linearizes, it may be
                lost.
            heading_sigma: Its deviation, or with `course` that of the body x axis from the course
                [rad]; None: `initial_pose.heading_sigma`.
            magnetometer: (3,) magnetic field in B [T], for suites with a magnetometer.
            magnetometer_sigma: Its white noise per axis [T]; None: as the suite says.
            gnss_velocity_G: (3,) velocity in G [m/s]; None: at rest.
            course: Whether the vehicle flies nose first.
            gnss_sigma: Noise of the position, as of `update`; None: as the suite says.
            velocity_sigma: Noise of the velocity per axis [m/s]; None: as the suite says.
            tilt_sigma: Deviation of roll and pitch of a level start [rad]; None:
                `FilterParams.initial_tilt_sigma`, or else LEVEL_SIGMA.
            accel: (3,) specific force at rest in B, best the mean of many samples [m/s^2]; None:
                the vehicle is taken as level.
            accel_sigma: Its white noise per axis [m/s^2]; None: that of one sample. The bias counts
                besides.
            time: Time stamp of the start [s]; others count from the same zero.

        Raises:
            ValueError: If an argument has another shape or is not finite, the position is farther
                than FARTHEST_FIX from the reference antenna, the baseline is zero, or arguments do
                not belong together; or the suite lacks a sensor.
        """
        fix = checked_fix(
            self.sensors,
            gnss_position_G,
            gnss_baseline_G,
            heading,
            heading_sigma,
            magnetometer,
            magnetometer_sigma,
            gnss_velocity_G,
            course,
            gnss_sigma,
            velocity_sigma,
            tilt_sigma,
            accel,
            accel_sigma,
        )
        begin, engine = check.number("time", time), self._engine
        self._begin(begin, len(fix.starts))
        fix.write(engine)
        if len(fix.starts) > 1:
            self._log_weights = np.full(engine.lanes, -math.log(engine.lanes))
            self._choose_form()
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
        time: float = 0.0,
    ) -> None:
        """Start from a given estimate.

        Args:
            position: (3,) in I [m].
            velocity: (3,) in I [m/s].
            R_BI: (3, 3) attitude, a rotation.
            accel_bias: (3,) in B [m/s^2].
            gyro_bias: (3,) in B [rad/s].
            covariance: (15, 15) in the order r, v, e, b_a, b_g; symmetric positive definite.
            time: Time stamp of the start [s].

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
        begin = check.number("time", time)
        self._begin(begin)
        self._engine.start(np.zeros(3))  # what it remembers begins anew; the estimate is given
        for name, value in zip((*_STATE, "L"), (*values, L), strict=True):
            self._engine.fill(name, value)
        self._running = True

    def predict(self, gyro: ArrayLike, accel: ArrayLike, dt: float | None = None) -> None:
        """Carry the estimate over one tick, or another time.

        Args:
            gyro: (3,) angular rate measured at the start of the time, or its mean over it (see
                `ImuParams.samples`), in B [rad/s].
            accel: (3,) specific force, likewise, in B [m/s^2].
            dt: The time, at most LONGEST_STEP [s]; None: a tick of the suite's IMU. The white noise
                of a sample over another time is that of the same density.

        Raises:
            ValueError: If an argument has another shape or is not finite, or `dt` is not positive
                or too long; the estimate is unchanged then.
            RuntimeError: Before `initialize` or `set_state`.
        """
        self._require_start()
        rates = check.array("gyro", gyro, (3,))
        force = check.array("accel", accel, (3,))
        tick = self.sensors.imu.dt
        step = tick
        if dt is not None:
            step = check.positive("dt", dt, least=1e-9, most=max(LONGEST_STEP, tick))
        status, earlier = self._status_bits(), self._gyro
        self._gyro = rates
        self._history.add(Sample(rates, force, step, rates if earlier is None else earlier))
        self._warn_of_news(status)

    def update(
        self,
        gnss_position_G: ArrayLike | None = None,
        gnss_baseline_G: ArrayLike | None = None,
        pixels: ArrayLike | None = None,
        gnss_velocity_G: ArrayLike | None = None,
        *,
        time: float | None = None,
        **others: Any,
    ) -> None:
        """Condition the estimate on measurements of one instant; None: not measured.

        What comes late is included as if it had come in time, see `quad_gym.estimation.history`.

        Args:
            gnss_position_G: (3,) primary antenna relative to the reference antenna, in G [m].
            gnss_baseline_G: (3,) primary to secondary antenna, in G [m].
            pixels: (n_features, 2) feature projections [pixels]; a row with a NaN is a feature not
                seen.
            gnss_velocity_G: (3,) velocity of the primary antenna, in G [m/s]; for suites whose GNSS
                measures it. Its lever arm is turned with the last `gyro` predicted with.
            time: Their time stamp [s], from `oldest_time` to `time` of the filter; None: now.
            others: What aiding sensors measure that the suite has: `barometer`, the height in I by
                static pressure [m]; `magnetometer`, (3,) the magnetic field in B [T]. And noise in
                place of the suite's, per axis: `gnss_sigma`, a number, three (east, north, up), or
                a (3, 3) covariance in I, with which the position is processed by itself [m, m^2];
                `velocity_sigma` [m/s], `baseline_sigma` [rad], `pixel_sigma` [pixels],
                `barometer_sigma` [m], `magnetometer_sigma` [T].

        Raises:
            ValueError: If an argument has another shape or is not finite, the suite lacks the
                sensor whose measurement is given, or the time stamp is older than the window or
                later than the last prediction; the estimate is unchanged then.
            RuntimeError: Before `initialize` or `set_state`.
        """
        self._require_start()
        measurement = checked_measurement(
            self.sensors, gnss_position_G, gnss_baseline_G, pixels, gnss_velocity_G, others
        )
        status, now = self._status_bits(), self._history.time
        stamp = now if time is None else check.number("time", time)
        if stamp > now + SAME_TIME:
            raise ValueError(
                f"time must not be later than the filter, which is at {now:.6f} s, got "
                f"{stamp:.6f} s: predict up to it first"
            )
        if stamp >= now - SAME_TIME:
            self._history.add(measurement)
            self._report, self._reported = None, measurement
        elif stamp < self.oldest_time - SAME_TIME:
            raise ValueError(
                f"time must be at least {self.oldest_time:.6f} s, as the filter remembers "
                f"{self._history.window:g} s (window=) and what came since its start, got "
                f"{stamp:.6f} s"
            )
        else:
            self._awaited = measurement
            self._history.insert(measurement, stamp)
        self._warn_of_news(status)

    @property
    def time(self) -> float:
        """Time stamp up to which the filter has predicted [s]."""
        return self._history.time

    @property
    def oldest_time(self) -> float:
        """The oldest time stamp of a measurement that `update` still takes [s]."""
        return self._history.oldest

    # ---- memory -------------------------------------------------------------------------------

    def _begin(self, time: float, flights: int = 1) -> None:
        """Forget everything, and make room for flights."""
        self._log_weights, self._moments = None, None
        self._gyro, self._report, self._reported = None, None, Measurement()
        self._choose_form()
        if flights > 1 or len(self._engine.blocks) > 1:
            self._engine.allocate(flights)
        self._history.begin(time)

    def _apply(self, given: Sample | Measurement) -> None:
        """Give the filter a sample or a measurement."""
        self._moments, whole = None, given
        if isinstance(given, Sample):
            self._engine.predict(given)
            return
        covariance = given.position_covariance_I
        if covariance is not None:
            correlated = given.only_position()
            update_with_correlated(self._engine, self._condition, correlated, covariance)
            given = given.without_position()
        if not given.empty:
            self._condition(given)
        if whole is self._awaited:
            self._report = self._innovations(whole.blocks)

    def _condition(self, measurement: Measurement) -> None:
        """Condition the estimate, or those for each heading, until one of them is left."""
        if self._log_weights is None:
            self._engine.update(measurement)
            return
        self._log_weights = update_and_weigh(self._engine, measurement, self._log_weights)
        mixed = moments(self._engine, self._log_weights)
        if mixed.heading_sigma < RESOLVED:
            collapse(self._engine, self._log_weights, mixed)
            self._log_weights = None
            self._choose_form()

    def _copy(self) -> Any:
        return self._engine.copy(), self._log_weights

    def _restore(self, state: Any) -> None:
        words, self._log_weights = state
        self._moments = None
        self._engine.restore(words)
        self._choose_form()

    def _choose_form(self) -> None:
        """Gate only where one flight is estimated: what is unlikely of a heading weighs it."""
        form = int(self._engine.form)
        if self._log_weights is not None:
            form &= ~_OF_GATES
        self._engine.settings["form"] = form

    def _status_bits(self) -> int:
        return int(self._of_lane("filter_status"))

    def _warn_of_news(self, before: int) -> None:
        """Warn of what has gone wrong since."""
        bits = self._status_bits() & ~before
        if bits:
            news = FilterStatus(bits)
            warnings.warn(
                f"The filter kept its last good state: {news.name}", RuntimeWarning, stacklevel=3
            )


class UnscentedKalmanFilter(_KalmanFilter):
    """The report's UKF for one vehicle: position, velocity, attitude and IMU biases.

    One cycle is: `update` with what was measured at t_k, read the estimate, then `predict` to t_k+1
    with the IMU sample of that tick. The measurement model is that of the report's section 3.4,
    with antenna position, baseline direction and feature directions; any of them may be missing at
    any time. `FilterParams` tells where the filter may differ from the report's.

    Samples may come at any time, and measurements late, with their time stamps and their own noise:
    see `predict` and `update`. `quad_gym.estimation.replay` filters a log.

    A cycle whose result is not finite, or whose covariance would not be positive definite, leaves
    the estimate as it was, sets `status`, and warns.

    Args:
        sensors: The sensor suite whose geometry and noise the filter believes in.
        window: How late measurements may come that carry their time stamp [s]; 0: none may, and
            nothing is kept for them.

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
        window: How late measurements may come that carry their time stamp [s]; 0: none may, and
            nothing is kept for them.

    Raises:
        ValueError: If `sensors` is not a sensor suite, or its filter takes the samples of the IMU
            for something else, see `SensorSuite.require_filter`.

    Source: F. L. Markley, J. Guidance, Control, and Dynamics 26(2), 2003, for error angles about
    an estimated attitude.
    """

    _kind = "ekf"
