"""Unscented and extended Kalman filters for one vehicle, and their estimates."""

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.estimation.engine import Engine, Floats
from quad_gym.estimation.inputs import (
    NOTHING,
    InputHistory,
    Measurement,
    Tape,
    TapeWriter,
    checked_measurement,
    measured_blocks,
)
from quad_gym.estimation.starts import (
    RESOLVED,
    FirstFix,
    Moments,
    collapse,
    filter_start,
    moments,
    update_and_weigh,
)
from quad_gym.packing import blocks_of
from quad_gym.params import checks as check
from quad_gym.params.checks import takes
from quad_gym.params.sensor_table import AID_PARAMS, READINGS
from quad_gym.params.suites import SensorSuite
from quad_gym.records import (
    KEPT,
    FilterForm,
    FilterStatus,
    Operation,
    covariance_of,
    joint_covariance,
    lower_triangle,
)
from quad_gym.records.inputs import SAME_TIME

# --------------------------------------------------------------------------------------------------
# The estimate of a filter, as properties that read the memory of its flight.
# --------------------------------------------------------------------------------------------------


class Innovations(NamedTuple):
    """Innovations of one update: position, baseline, velocity, features, aiding sensors."""

    innovation: NDArray[np.float64]
    """(n, 3) innovations: of position [m] and velocity [m/s] in I; of directions, horizontally and
    vertically across the predicted direction, then NaN; of the barometer [m], then zeros; of the
    magnetometer in B [T]"""
    sigma: NDArray[np.float64]
    """(n, 3) standard deviations of the innovations, as predicted by the filter"""
    nis: NDArray[np.float64]
    """(n,) normalized innovations squared; chi-square with 3, 2, 3, 2, 1 and 3 degrees of
    freedom"""
    gate: NDArray[np.float64]  #: (n,) gate decisions, see `quad_gym.records.GateDecision`


class FilterEstimate:
    """State estimate and covariance."""

    sensors: SensorSuite
    _engine: Engine
    _log_weights: NDArray[np.float64] | None
    _moments: Moments | None
    _report: Innovations | None
    _reported: Measurement
    _running: bool

    @property
    def position(self) -> NDArray[np.float64]:
        """Estimated position (3,) of the center of mass in I [m]."""
        return self._vector("r_hat")

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Estimated velocity (3,) in I [m/s]."""
        return self._vector("v_hat")

    @property
    def R_BI(self) -> NDArray[np.float64]:
        """Estimated attitude (3, 3)."""
        mixed = self._mixed()
        return self._read("R_hat") if mixed is None else mixed.R_hat.copy()

    @property
    def accel_bias(self) -> NDArray[np.float64]:
        """Estimated accelerometer bias (3,) in B [m/s^2]."""
        return self._vector("b_a_hat")

    @property
    def gyro_bias(self) -> NDArray[np.float64]:
        """Estimated gyro bias (3,) in B [rad/s]."""
        return self._vector("b_g_hat")

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance (15, 15) of the errors, in the order r, v, e, b_a, b_g."""
        mixed = self._mixed()
        if mixed is not None:
            return mixed.covariance[:15, :15].copy()
        return covariance_of(self._read("P"), self._read("arc"))

    @property
    def heading_known(self) -> bool:
        """True if the heading is certain enough for a single Gaussian.

        False after a start without any heading, and where the motion contradicts the heading, until
        the motion has revealed it. Meanwhile, measurements of position and velocity do not correct
        the attitude. In suites without GNSS velocity, or with a camera, estimate and covariance are
        then the moments of a Gaussian sum: a bank of filters, one for each of many headings.
        """
        self._require_start()
        return self._log_weights is None and bool(self._of_lane("heading_lost") <= 0.0)

    @property
    def is_single(self) -> bool:
        """True unless a bank of filters has a heading for each of its lanes."""
        return self._log_weights is None

    @property
    def gnss_drift(self) -> NDArray[np.float64]:
        """Estimated time-correlated error (3,) of GNSS positions in I [m]; zero without drift.

        It is zero at the start, because positions are relative to the position that the receiver
        reports there.
        """
        return self._slow()[:3] * self.sensors.drifts

    @property
    def gnss_drift_covariance(self) -> NDArray[np.float64]:
        """Covariance (3, 3) of the estimated GNSS drift [m^2]."""
        mixed = self._mixed()
        if mixed is not None and self.sensors.drifts:
            return mixed.covariance[15:18, 15:18].copy()
        rows = slice(15, 18)
        P = joint_covariance(self._read("P"), self._read("P_slow"))
        return P[rows, rows] * self.sensors.drifts

    @property
    def aid_errors(self) -> dict[str, NDArray[np.float64]]:
        """Estimated time-correlated errors of the suite's aiding sensors, by name.

        "barometer": (1,) bias [m]; "magnetometer": (4,) hard iron in B [T], and error of the
        declination, true minus modeled [rad].
        """
        slow, found = self._slow(), {}
        for aid in self.sensors.aids:
            vector, scalar = (
                int(self._engine.settings[f"aid_{kind}"][0, aid]) for kind in ("vector", "scalar")
            )
            places = [*range(vector, vector + 3)] if vector >= 0 else []
            found[aid.name.lower()] = slow[places + ([scalar] if scalar >= 0 else [])]
        return found

    @property
    def status(self) -> FilterStatus:
        """Numerical failures since the start; `FilterStatus(0)`: none."""
        return FilterStatus(int(self._of_lane("filter_status")))

    @property
    def diverged(self) -> bool:
        """True while innovations show that the estimate is wrong, as `filter_diverged` of flights.

        The NIS is twice its degrees of freedom or more, or recent innovations, or corrections of
        biases, are not white.
        """
        return bool(self._of_lane("diverged") > 0.0)

    @property
    def nis(self) -> tuple[float, int]:
        """Normalized innovation squared of the last update, and its degrees of freedom.

        The suite's noise applies, and directions count across themselves, with two numbers. Where
        the gate has weakened directions so far off that their joint NIS is inexact, it is the sum
        of those in `block_nis`. Without a gate, the NIS of such directions is too small, and may
        be 0. NaN: the update was done in steps.

        With delayed measurements, the last update is the one with the latest time stamp.
        """
        return float(self._read("nis")), int(self._read("nis_dimension"))

    @property
    def block_nis(self) -> NDArray[np.float64]:
        """Normalized innovations squared (n,) of the last measurements, block by block.

        The blocks are position, baseline, velocity and features, followed by the barometer and the
        magnetometer if the suite has them. For a consistent filter they are chi-square with 3, 2,
        3, 2, 1 and 3 degrees of freedom; NaN: not measured yet.
        """
        return self._read("block_nis")[list(blocks_of(self.sensors))]

    @property
    def gate_decisions(self) -> NDArray[np.int64]:
        """Gate decisions (n,) in the order of `block_nis`, see `quad_gym.records.GateDecision`."""
        return self._read("gate")[list(blocks_of(self.sensors))].astype(np.int64)

    @property
    def last_update(self) -> Innovations:
        """Innovations of the last call of `update`, also of a delayed one; NaN: not measured."""
        self._require_start()
        if self._report is None:  # it came in time: its innovations are still in memory
            self._report = self._innovations(measured_blocks(self._reported))
        return self._report

    def _innovations(self, measured: list[int]) -> Innovations:
        """Return the innovations of some blocks, as they are in memory now."""
        blocks = list(blocks_of(self.sensors))
        apart = np.array([block not in measured for block in blocks], bool)
        values = [
            np.array(self._of_lane(name)[blocks])
            for name in ("innovation", "innovation_sigma", "block_nis", "gate")
        ]
        for numbers in values:
            numbers[apart] = np.nan
        return Innovations(*values)

    def _vector(self, name: str) -> NDArray[np.float64]:
        mixed = self._mixed()
        return self._read(name) if mixed is None else mixed.vectors[name].copy()

    def _slow(self) -> NDArray[np.float64]:
        slow, mixed = self._read("slow_hat"), self._mixed()
        if mixed is not None:
            slow[: len(mixed.vectors["slow_hat"])] = mixed.vectors["slow_hat"]
        return slow

    def _mixed(self) -> Moments | None:
        """Return mean and covariance over all headings, as long as the heading is unknown."""
        self._require_start()
        if self._log_weights is not None and self._moments is None:
            self._moments = moments(self._engine, self._log_weights)
        return self._moments

    def _read(self, name: str) -> NDArray[Any]:
        """Return a field of the only flight, or of the flight with the likeliest heading."""
        self._require_start()
        return self._of_lane(name)

    def _of_lane(self, name: str) -> NDArray[Any]:
        weights = self._log_weights
        lane = 0 if weights is None else int(np.argmax(weights))
        blocks = self._engine.blocks[name]
        width = blocks.shape[-1]
        return np.array(blocks[lane // width, ..., lane % width])

    def _require_start(self) -> None:
        if not self._running:
            raise RuntimeError("call initialize() or set_state() before using the filter")


# --------------------------------------------------------------------------------------------------
# Unscented and extended Kalman filters for one vehicle.
# --------------------------------------------------------------------------------------------------

_OTHERS = (*AID_PARAMS, *(reading.sigma for reading in READINGS.values()))
"""Further keywords of `update`."""
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
        self._report, self._reported = None, NOTHING
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
            np.linalg.cholesky(P)
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
        for name, value in zip((*_STATE, "P"), (*values, lower_triangle(P)), strict=True):
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

        Delayed measurements are processed at their time stamps, see `quad_gym.kernels.tape`.

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
            others: Measurements of the suite's other sensors by their names, with the units and
                frames of `measured.NAME` in docs/reference/fields.md and the shape (), (length,),
                (blocks,) or (blocks, length): `barometer` [m], `magnetometer`, (3,) in B [T].
                Also standard deviations that replace the suite's, per axis: `gnss_sigma`, a number
                or three numbers (east, north, up) [m]; `velocity_sigma` [m/s], `baseline_sigma`
                [rad], `pixel_sigma` [pixels], and for each other sensor, such as `barometer_sigma`
                [m], in its unit.

        Raises:
            ValueError: If an argument has another shape or is not finite, the suite lacks the
                sensor of a measurement, or the time stamp is older than the window or later than
                the last prediction; the estimate is unchanged then.
            RuntimeError: Before `initialize` or `set_state`.
        """
        self._require_start()
        check.keywords(others, _OTHERS, "update")
        given = {
            "gnss_position_G": gnss_position_G,
            "gnss_baseline_G": gnss_baseline_G,
            "pixels": pixels,
            "gnss_velocity_G": gnss_velocity_G,
            **others,
        }
        measured = any(value is not None for value in given.values())
        measurement = checked_measurement(self.sensors, given) if measured else NOTHING
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
        status, one = self.status, self._history.one
        one["rank"], one["time"] = 1, stamp
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
        self._report, self._reported = None, NOTHING
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
                        self._report = self._innovations(measured_blocks(given))

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
                if measurement is not NOTHING:
                    self._condition(measurement)
            case Operation.COPY:
                copies[number] = self._engine.copy(), self._log_weights
            case Operation.RESTORE:
                copied, self._log_weights = copies[number]
                self._engine.restore(copied)
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
        """Use the gate, and the heading by motion, only with a single flight.

        Unlikely innovations weigh headings, and wrong ones are not to be replaced.
        """
        form, engine = int(self._engine.form), self._engine
        if self._log_weights is not None:
            form &= ~_OF_GATES
        engine.settings["form"] = form
        engine.settings["by_motion"] = self.sensors.heading_by_motion if self.is_single else 0

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


# --------------------------------------------------------------------------------------------------
# Runs a tape with a filter: in compiled code, except while the heading is unknown.
# --------------------------------------------------------------------------------------------------


class Results(NamedTuple):
    """Results of a piece of a tape."""

    estimates: Floats
    """(n, KEPT + 1) estimates, whose last number is 0 while there is a bank of filters"""
    innovations: Floats  #: (m, blocks, REPORTED)
    valid: Any  #: (m, MAX_BLOCKS) True where a block was measured


def run_filter(kf: KalmanFilter, writer: TapeWriter) -> Iterator[Results]:
    """Run a tape from the present state of a filter, piece by piece.

    Args:
        kf: The filter.
        writer: The tape, and its measurements.
    """
    status, bank = kf.status, not kf.is_single
    copies: dict[int, Any] = {}
    slots: NDArray[Any] | None = None
    for piece in writer.pieces():
        first, estimates, innovations = 0, _no_rows(KEPT + 1), _no_rows(0)
        if slots is None and bank:
            first, before, reports = run_while_unknown(kf, writer, piece, copies)
            estimates = np.reshape(before, (-1, KEPT + 1))
            innovations = np.array(reports)
        if first < len(piece.operations):
            if slots is None:
                slots = kf._engine.empty_slots(piece)
                for k, (copied, _) in copies.items():
                    kf._engine.put_in_slot(slots[k], copied)
            kept, reported = (rows[0, ..., 0] for rows in kf._engine.run(piece.after(first), slots))
            kept = np.column_stack([kept, np.ones(len(kept))])
            kept[: len(estimates)] = estimates
            if len(innovations):
                reported[: len(innovations)] = innovations
            estimates, innovations = kept, reported
        yield Results(estimates, innovations, piece.valid)
    kf.warn_of_news(status)


def _no_rows(width: int) -> Floats:
    return np.empty((0, width))


def run_while_unknown(
    kf: KalmanFilter, writer: TapeWriter, tape: Tape, copies: dict[int, Any]
) -> tuple[int, list[Floats], list[Floats]]:
    """Run a tape until the heading is known, also in all copies that may be restored.

    Args:
        kf: The filter.
        writer: The measurements.
        tape: The tape.
        copies: Copies of the filter's memory by number; further ones are added.

    Returns:
        Number of operations that were run, estimates and innovations.
    """
    estimates: list[Floats] = []
    innovations: list[Floats] = []
    for k, (code, index, target) in enumerate(tape.operations.tolist()):
        if kf.heading_known and all(weights is None for _, weights in copies.values()):
            return k, estimates, innovations
        if code == Operation.KEEP:
            estimates.append(_estimate(kf))
            continue
        updates = code == Operation.UPDATE
        measurement = writer.measurement(tape.first + index) if updates else None
        kf._operate((code, index, target), tape.samples, measurement, copies)
        if measurement is not None and target >= 0:
            innovations.append(_innovations(kf, measurement))
    return len(tape.operations), estimates, innovations


def _innovations(kf: KalmanFilter, measurement: Measurement) -> Floats:
    """Return innovations (blocks, REPORTED)."""
    innovation, sigma, nis, gate = kf._innovations(measured_blocks(measurement))
    return np.column_stack([innovation, sigma, nis, gate])


def _estimate(kf: KalmanFilter) -> Floats:
    """Return an estimate (KEPT + 1,)."""
    values: Sequence[Any] = (
        kf.position,
        kf.velocity,
        kf.R_BI.ravel(),
        kf.accel_bias,
        kf.gyro_bias,
        np.diag(kf.covariance),
        [kf.diverged, 0.0, 0.0, 0.0, 0.0, kf.heading_known],
    )
    return np.concatenate(values)
