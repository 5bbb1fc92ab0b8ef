"""Unscented and extended Kalman filters for one vehicle."""

import math
import warnings
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.estimation.filtering.engine import Engine
from quad_gym.estimation.filtering.estimate import FilterEstimate
from quad_gym.estimation.filtering.first_fix import FirstFix, filter_start
from quad_gym.estimation.filtering.headings import RESOLVED, collapse, moments, update_and_weigh
from quad_gym.estimation.filtering.history import InputHistory
from quad_gym.estimation.filtering.samples import Measurement, checked_measurement
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.shown import takes
from quad_gym.records import FilterForm, FilterStatus, Operation
from quad_gym.records.inputs import SAME_TIME

_STATE = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat")

LONGEST_STEP = 1.0
"""Longest time of a prediction with one IMU sample [s], unless the suite's tick is longer."""

_OF_GATES = int(FilterForm.GATE)


class KalmanFilter(FilterEstimate):
    """Common base of the filters: everything but the kind of their kernels."""

    _kind: str

    def __init__(self, sensors: SensorSuite, *, window: float = 0.5) -> None:
        if not isinstance(sensors, SensorSuite):
            raise ValueError(f"sensors must be a SensorSuite, got {type(sensors).__name__}")
        sensors.require_filter()
        length = check.number("window", window, least=0.0, most=60.0)
        self.sensors = sensors
        self._engine = Engine(sensors, self._kind)
        self._history = InputHistory(length, max(LONGEST_STEP, sensors.imu.dt))
        self._measurements: dict[int, Measurement] = {}
        self._copies: dict[int, Any] = {}
        self._log_weights, self._moments = None, None
        self._report, self._reported = None, Measurement()
        self._running = False

    # ---- the cycle ----------------------------------------------------------------------------

    @takes(FirstFix)
    def initialize(self, *values: Any, **keywords: Any) -> None:
        """Start from a first fix; `FirstFix` explains the arguments.

        With a baseline, the attitude solves Wahba's problem, with the body z axis assumed vertical.
        A baseline within 12 degrees of the vertical hardly observes the heading; `heading` then
        provides it, with the standard deviation `initial_pose.heading_sigma` of the suite.

        Without a baseline, the vehicle is assumed level. Its heading comes from the first of these
        that is given: `heading`, `magnetometer`, or, with `course`, the direction of
        `gnss_velocity_G`. With none of them, the heading is unknown until the motion reveals it:
        see `heading_known`.

        With `accel`, roll and pitch are computed from the specific force of a vehicle at rest,
        however tilted it stands. The heading comes from a baseline or from one of the sources
        above.

        The initial covariance includes the correlations of these errors: a tilt error or hard iron
        changes the magnetic heading, an accelerometer bias tilts the start, and the lever arm of
        the antenna couples position and attitude.

        Raises:
            ValueError: If an argument has another shape or is not finite, the position is farther
                than FARTHEST_FIX from the reference antenna, the baseline is zero, arguments
                contradict each other, or the suite lacks a sensor.
        """
        check.keywords(keywords, [field.name for field in fields(FirstFix)], "initialize")
        fix, engine = FirstFix(*values, **keywords), self._engine
        start = filter_start(self.sensors, fix)
        self._begin(check.number("time", fix.time), len(start.estimates))
        start.write(engine)
        if len(start.estimates) > 1:
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
            position: (3,) position in I [m].
            velocity: (3,) velocity in I [m/s].
            R_BI: (3, 3) attitude, a rotation matrix.
            accel_bias: (3,) accelerometer bias in B [m/s^2].
            gyro_bias: (3,) gyro bias in B [rad/s].
            covariance: (15, 15) covariance in the order r, v, e, b_a, b_g; symmetric positive
                definite.
            time: Time stamp of the start [s].

        Raises:
            ValueError: If an argument has another shape or is not finite, `R_BI` is not a rotation
                matrix, or the covariance is not symmetric positive definite.
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
        self._engine.start(np.zeros(3))  # all memory is cleared; the estimate is given
        for name, value in zip((*_STATE, "L"), (*values, L), strict=True):
            self._engine.fill(name, value)
        self._running = True

    def predict(self, gyro: ArrayLike, accel: ArrayLike, dt: float | None = None) -> None:
        """Propagate the estimate over one tick, or another time.

        Args:
            gyro: (3,) angular rate in B, measured at the start of the time or averaged over it (see
                `ImuParams.samples`) [rad/s].
            accel: (3,) specific force in B, measured or averaged in the same way [m/s^2].
            dt: The time, at most LONGEST_STEP [s]; None: one tick of the suite's IMU. The noise
                density is the same for all times.

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
        status, given = self.status, self._history.one
        given["rank"], given["dt"], given["gyro"], given["accel"] = 0, step, rates, force
        self._take_one(None)
        self.warn_of_news(status)

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
        """Update the estimate with measurements of one instant; None: not measured.

        Delayed measurements are processed at their time stamps, see `quad_gym.kernels.window`.

        Args:
            gnss_position_G: (3,) primary antenna relative to the reference antenna, in G [m].
            gnss_baseline_G: (3,) primary to secondary antenna, in G [m].
            pixels: (n_features, 2) image coordinates of the features [pixels]; a row with a NaN is
                a feature that was not detected.
            gnss_velocity_G: (3,) velocity of the primary antenna, in G [m/s]; for suites whose GNSS
                measures it. The velocity of the lever arm is computed with the last `gyro` of
                `predict`.
            time: Time stamp of the measurements [s], from `oldest_time` to the filter's `time`;
                None: the filter's `time`.
            others: Measurements of aiding sensors in the suite: `barometer`, the height in I from
                static pressure [m]; `magnetometer`, (3,) the magnetic field in B [T];
                `optical_flow`, (2,) angular rates [rad/s]; `range_finder` [m]; `uwb_range`,
                (anchors,) ranges [m]. Also standard deviations that replace the suite's, per axis:
                `gnss_sigma`, a number or three numbers (east, north, up) [m]; `velocity_sigma`
                [m/s], `baseline_sigma` [rad], `pixel_sigma` [pixels], and for each aiding sensor,
                such as `barometer_sigma` [m], in its unit.

        Raises:
            ValueError: If an argument has another shape or is not finite, the suite lacks the
                sensor of a measurement, or the time stamp is older than the window or later than
                the last prediction; the estimate is unchanged then.
            RuntimeError: Before `initialize` or `set_state`.
        """
        self._require_start()
        measurement = checked_measurement(
            self.sensors, gnss_position_G, gnss_baseline_G, pixels, gnss_velocity_G, others
        )
        now = self._history.time
        stamp = now if time is None else check.number("time", time)
        if stamp > now + SAME_TIME:
            raise ValueError(
                f"time must not be later than the filter, which is at {now:.6f} s, got "
                f"{stamp:.6f} s: predict up to it first"
            )
        if stamp < self.oldest_time - SAME_TIME:
            raise ValueError(
                f"time must be at least {self.oldest_time:.6f} s, as the filter keeps "
                f"{self._history.window:g} s of data (window=) since its start, got "
                f"{stamp:.6f} s"
            )
        status, given = self.status, self._history.one
        given["rank"], given["time"] = 1, stamp
        self._take_one(measurement)
        self.warn_of_news(status)

    @property
    def time(self) -> float:
        """Time stamp up to which the filter has predicted [s]."""
        return self._history.time

    @property
    def oldest_time(self) -> float:
        """Oldest time stamp of a measurement that `update` accepts [s]."""
        return self._history.oldest

    # ---- memory -------------------------------------------------------------------------------

    def _begin(self, time: float, flights: int = 1) -> None:
        """Clear all memory, and make room for flights."""
        self._log_weights, self._moments = None, None
        self._report, self._reported = None, Measurement()
        self._measurements, self._copies = {}, {}
        self._choose_form()
        if flights > 1 or len(self._engine.blocks) > 1:
            self._engine.allocate(flights)
        self._history.begin(time)

    def _take_one(self, measurement: Measurement | None) -> None:
        """Process the one input of the history, a measurement or else a sample."""
        history = self._history
        for part in history.take(history.one):
            if measurement is not None:
                self._measurements[int(history.one["index"][0])] = measurement
            operations = part.tolist()
            for k, (code, index, target) in enumerate(operations):
                given = self._measurements[index] if code == Operation.UPDATE else None
                self._operate((code, index, target), history.samples, given, self._copies)
                if given is not None and target >= 0:
                    self._report, self._reported = None, given
                    if k + 1 < len(operations):  # what follows overwrites its innovations
                        self._report = self._innovations(given.blocks)

    def _operate(
        self,
        operation: tuple[int, int, int],
        samples: NDArray[Any],
        measurement: Measurement | None,
        copies: dict[int, Any],
    ) -> None:
        """Run an operation of a tape.

        Args:
            operation: OPERATION.
            samples: (n,) SAMPLE.
            measurement: What an update processes.
            copies: Copies of the filter's memory by number.
        """
        code, index, number = operation
        self._moments = None
        match code:
            case Operation.PREDICT:
                self._engine.predict(samples[index])
            case Operation.UPDATE:
                assert measurement is not None
                if not measurement.empty:
                    self._condition(measurement)
            case Operation.COPY:
                copies[number] = self._engine.copy(), self._log_weights
            case Operation.RESTORE:
                words, self._log_weights = copies[number]
                self._engine.restore(words)
                self._choose_form()

    def _condition(self, measurement: Measurement) -> None:
        """Update the estimate, or the bank of filters until a single one is left."""
        if self._log_weights is None:
            self._engine.update(measurement)
            return
        self._log_weights = update_and_weigh(self._engine, measurement, self._log_weights)
        mixed = moments(self._engine, self._log_weights)
        if mixed.heading_sigma < RESOLVED:
            collapse(self._engine, self._log_weights, mixed)
            self._log_weights = None
            self._choose_form()

    def _choose_form(self) -> None:
        """Use the gate only with a single flight: unlikely innovations weigh headings."""
        form = int(self._engine.form)
        if self._log_weights is not None:
            form &= ~_OF_GATES
        self._engine.settings["form"] = form

    def warn_of_news(self, before: FilterStatus) -> None:
        """Warn of failures that `status` did not have before."""
        news = self.status & ~before
        if news:
            warnings.warn(
                f"The filter kept its last good state: {news.name}", RuntimeWarning, stacklevel=3
            )


class UnscentedKalmanFilter(KalmanFilter):
    """The report's UKF for one vehicle: position, velocity, attitude and IMU biases.

    One cycle is: `update` with the measurements at t_k, read the estimate, then `predict` to t_k+1
    with the IMU sample of that tick. The measurement model is the one in the report's section 3.4,
    with antenna position, baseline direction and feature directions; any of them may be missing at
    any time. `FilterParams` lists the options in which the filter may differ from the report's.

    Samples may come at any time, and measurements late, with their time stamps and their own noise:
    see `predict` and `update`. `quad_gym.estimation.replay` filters a log.

    A cycle whose result is not finite, or whose covariance would not be positive definite, leaves
    the estimate as it was, sets `status`, and warns.

    Args:
        sensors: The sensor suite whose geometry and noise the filter assumes.
        window: Longest delay of measurements with a time stamp [s]; 0: no delays, and no data are
            kept for them.

    Raises:
        ValueError: If `sensors` is not a sensor suite, or its filter misinterprets the IMU samples,
            see `SensorSuite.require_filter`.
    """

    _kind = "ukf"


class ExtendedKalmanFilter(KalmanFilter):
    """An error-state EKF for one vehicle, with the state, models, noise and interface of the UKF.

    Its covariance follows from analytic derivatives of the models at the estimate, which cost less
    than sigma points and neglect the second order; see `quad_gym.kernels.filter.predict`.

    Source: F. L. Markley, J. Guidance, Control, and Dynamics 26(2), 2003, for error angles about an
    estimated attitude.
    """

    _kind = "ekf"
