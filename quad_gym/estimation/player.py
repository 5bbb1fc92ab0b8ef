"""A filter that processes a log event by event, in the order of arrival.

Times alone determine which samples and measurements are processed, and when. The operations are
therefore written to a tape first, which compiled code then runs.
"""

import bisect
import math
from array import array
from collections.abc import Iterable
from typing import Any

import numpy as np

from quad_gym.estimation.calls import FilterCalls
from quad_gym.estimation.filters import (
    LONGEST_STEP,
    ExtendedKalmanFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
)
from quad_gym.estimation.first_motion import with_wide_start
from quad_gym.estimation.held_position import SENTENCE, held, lacks_position
from quad_gym.estimation.history import SAME_TIME, InputHistory
from quad_gym.estimation.logs import Floats, Log, Stream
from quad_gym.estimation.plausibility import MisfitError, nothing_in_common
from quad_gym.estimation.results import Measured, Replay
from quad_gym.estimation.running import Results, run_filter
from quad_gym.estimation.samples import Measurement, Sample, checked_measurement
from quad_gym.estimation.starts import level, state_at_rest
from quad_gym.estimation.tape import TapeWriter
from quad_gym.frames import ecef_to_enu
from quad_gym.packing.aids import blocks_of
from quad_gym.params import checks as check
from quad_gym.params.portable import turned
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import AID_BLOCKS, FEATURE_BLOCKS, FREEDOMS, POSITION_BLOCK, Aid
from quad_gym.rotations import dcm_to_quaternion, quaternion_to_dcm

ESTIMATORS = {"ukf": UnscentedKalmanFilter, "ekf": ExtendedKalmanFilter}

_OF_GNSS = ("gnss_position_G", "gnss_baseline_G", "gnss_velocity_G")

UNMEASURED = 1e4  #: standard deviation along an axis that was not measured [m]

_AT_ONCE = 8192  #: events whose numbers are Python's at a time

PATIENCE = 2.0  #: time for which a start waits for the first magnetic field [s]


class Player:
    """Processes the contents of a log with a filter, in the order of arrival.

    Without a window, measurements are processed in the order of their time stamps, none late. With
    `calls`, what the filter receives is added to them. With `hold`, a fictitious position keeps
    roll and pitch in logs without any.
    """

    def __init__(
        self,
        log: Log,
        suite: SensorSuite,
        estimator: str,
        start: dict[str, Any],
        reported_noise: bool,
        window: float | None,
        calls: FilterCalls | None = None,
        hold: bool = False,
    ) -> None:
        self.calls = calls
        self.assumed, self.holds, unused_gnss = suite, False, False
        place = start.get("position")
        if hold and place is not None and np.shape(place) == (3,) and lacks_position(log, suite):
            self.holds, unused_gnss = True, "gnss" in log.streams
            log, suite = held(log, suite, place)
        self.log, self.suite, self.estimator = log, suite, estimator
        self.in_order, window = window is None, window or 0.0
        self.start, self.reported = start, reported_noise
        wide = with_wide_start(suite, log)
        self.filter = ESTIMATORS[estimator](wide, window=window)
        self.tilted = wide is not suite and not self.in_order
        """True: roll and pitch at the start are too uncertain for a heading by a magnetic field"""
        self.window = window
        self.averages = suite.imu.samples == "average"
        self.gyros, self.accels = log.imu.values["gyro"], log.imu.values["accel"]
        self.running = False
        self.held: list[int] = []  # samples before the start
        self.waiting: list[tuple[float, str, int]] = []  # time stamps after the filter's time
        self.before: int | None = None  # the sample that holds now, of an IMU of instants
        self.field: int | None = None  # the last magnetic field before the start
        self.first_fix = math.inf
        self.first_state: dict[str, Any] = {}
        self.late: dict[str, list[float]] = {}  # ages of what came too late, by sensor
        self.times = array("d")
        self.stamps = array("d")  # of all updates, each with its arrival
        self.gyro: Floats | None = None  # of the prediction before
        self.writer = TapeWriter(self._made)
        writer = self.writer
        self.history = InputHistory(window, writer.apply, writer.copy, writer.restore)
        self.unused: tuple[str, ...] = ()
        self._choose_streams()
        if unused_gnss:
            self.unused = ("gnss", *self.unused)

    def _choose_streams(self) -> None:
        """Select the streams that the suite uses, and list the others."""
        suite, log = self.suite, self.log
        unused = []
        self.streams = {"imu": log.imu}
        for name, stream in log.streams.items():
            if name == "imu":
                continue
            if name == "attitude":
                used = self._baselines_of_attitudes()
            else:
                used = getattr(suite, name) is not None
            if not used:
                unused.append(name)
            else:
                self.streams[name] = stream
        gnss = self.streams.get("gnss")
        self.takes_velocity = suite.gnss is not None and suite.gnss.velocity_sigma is not None
        if gnss is not None and not self.takes_velocity:
            unused += ["gnss_velocity"] if {"velocity_G", "velocity_I"} & set(gnss.values) else []
        self.unused = tuple(unused)
        if "camera" in self.streams:
            assert suite.camera is not None
            have = self.streams["camera"].values["pixels"].shape[1]
            if have != len(suite.camera.features_I):
                raise MisfitError(
                    f"the log must have the {len(suite.camera.features_I)} features of the suite, "
                    f"got {have}"
                )
        self.R_GI = np.eye(3)
        self.origin = np.zeros(3)
        if suite.gnss is not None:
            self.origin = np.array(suite.gnss.reference_antenna_G)
            self.R_GI = ecef_to_enu(self.origin).T

    def _baselines_of_attitudes(self) -> bool:
        """Return True if attitudes act as baselines, which the suite has and the log lacks."""
        gnss, given = self.suite.gnss, self.log.gnss
        told = given is not None and {"baseline_G", "baseline_I"} & set(given.values)
        return gnss is not None and gnss.has_baseline and not told

    # ---- the log, event by event ---------------------------------------------------------------

    def write_tape(self) -> None:
        """Start the filter, and write the operations on the log to a tape.

        Raises:
            MisfitError: If the suite has no sensor of the log.
            ValueError: If the log has no fix to start from, or its IMU samples have a gap.
        """
        names = self.names = list(
            self.streams
        )  # the IMU first: it comes before what arrives with it
        arrivals = "time" if self.in_order else "received"
        received = np.concatenate([getattr(self.streams[name], arrivals) for name in names])
        kinds = np.concatenate([np.full(len(self.streams[n]), k) for k, n in enumerate(names)])
        places = np.concatenate([np.arange(len(self.streams[n])) for n in names])
        if "position" in self.start:
            self._start_from_state()
        order = np.lexsort((places, kinds, received))
        for first in range(0, len(order), _AT_ONCE):
            some = order[first : first + _AT_ONCE]
            for kind, place in zip(kinds[some].tolist(), places[some].tolist(), strict=True):
                if kind == 0:
                    self._take_sample(place)
                else:
                    self._take_measurement(names[kind], place)
        self._keep_row()
        if not self.times:
            if self.unused and len(self.streams) == 1:
                raise MisfitError(
                    f"{nothing_in_common(self.unused)}: use a suite with these sensors"
                )
            raise ValueError(
                "a log must have a GNSS position to start from, with IMU samples after it; or give "
                "start= a position and a heading (--start-position 0 0 0 --heading 0), or all "
                "keywords of set_state"
            )

    def play(self) -> Replay:
        """Filter the whole log."""
        self.write_tape()
        if self.log.barometer_from_start:  # relative to the height of the vehicle
            self.filter._engine.steps["level"] = np.nan
        return self._result(run_filter(self.filter, self.writer))

    def _take_sample(self, i: int) -> None:
        if not self.running:
            self.held.append(i)
            return
        self._keep_row()
        self._predict(i)

    def _predict(self, i: int) -> None:
        """Propagate the estimate to the time of a sample."""
        time, now = float(self.log.imu.time[i]), self.history.time
        chosen = i if self.averages else self.before
        self.before = i
        step = time - now
        if step <= SAME_TIME or chosen is None:
            return
        if step > max(LONGEST_STEP, self.suite.imu.dt):
            usual = float(np.median(np.diff(self.log.imu.time)))
            cause = "cut the log there" if usual < LONGEST_STEP else "time in ms?"
            raise ValueError(
                f"samples of the IMU must be at most {LONGEST_STEP:g} s apart, got none from "
                f"{now:.3f} s to {time:.3f} s: {cause}"
            )
        gyro, accel = self.gyros[chosen], self.accels[chosen]
        sample = Sample(gyro, accel, step, gyro if self.gyro is None else self.gyro)
        self.gyro = gyro
        if self.calls is not None:
            for stamp, name, k in self.waiting:
                if stamp <= time + SAME_TIME:
                    self._call_update(name, k)
            self.calls.predict(sample)
        while self.waiting and self.waiting[0][0] < time - SAME_TIME:  # taken within the sample
            stamp, name, k = self.waiting.pop(0)
            if (elapsed := stamp - self.history.time) > SAME_TIME:
                first, sample = sample.split(elapsed)
                self.history.add(first)
            self._update(name, k)
        self.history.add(sample)
        while self.waiting and self.waiting[0][0] <= self.history.time + SAME_TIME:
            _, name, k = self.waiting.pop(0)
            self._update(name, k)

    def _take_measurement(self, name: str, k: int) -> None:
        stamp = float(self.streams[name].time[k])
        if not self.running:
            self._try_to_start(name, k)
        elif stamp > self.history.time + SAME_TIME:
            if self._measurement(name, self.streams[name], k) is not None:
                bisect.insort(self.waiting, (stamp, name, k))
        elif stamp < self.history.oldest - SAME_TIME:
            received = float(self.streams[name].received[k])
            self.late.setdefault(name, []).append(received - stamp)
        else:
            self._call_update(name, k)
            self._update(name, k)

    def _call_update(self, name: str, k: int) -> None:
        if self.calls is not None:
            measurement = self._measurement(name, self.streams[name], k)
            if measurement is not None:
                self.calls.update(name, float(self.streams[name].time[k]), measurement)

    def _update(self, name: str, k: int) -> None:
        stream, history = self.streams[name], self.history
        measurement = self._measurement(name, stream, k)
        if measurement is None:
            return
        stamp = float(stream.time[k])
        self.writer.awaited, self.writer.place = measurement, (self.names.index(name), k)
        if stamp >= history.time - SAME_TIME:
            history.add(measurement)
        else:
            history.insert(measurement, stamp)
        self.stamps.extend((stamp, float(stream.received[k])))

    def _made(self, number: int, k: int) -> Measurement:
        """Return a measurement by the number of its stream."""
        name = self.names[number]
        found = self._measurement(name, self.streams[name], k)
        assert found is not None
        return found

    def _measurement(self, name: str, stream: Stream, k: int) -> Measurement | None:
        """Return a measurement of a stream; None: nothing was measured."""
        if name == "gnss":
            given = self._fix(stream, k)
            position, baseline, velocity = (given.pop(key, None) for key in _OF_GNSS)
            if position is None and baseline is None and velocity is None:
                return None
            return checked_measurement(self.suite, position, baseline, None, velocity, given)
        if name == "camera":
            return Measurement(pixels=stream.values["pixels"][k])
        if name == "attitude":
            assert self.suite.gnss is not None
            baseline = turned(self._attitude(k).T, self.suite.gnss.baseline_B)
            return checked_measurement(
                self.suite, None, turned(self.R_GI, baseline), None, None, {}
            )
        value = stream.values[name][k]
        if not np.isfinite(value).all():
            return None
        return Measurement(aids={Aid[name.upper()]: np.atleast_1d(value)})

    def _attitude(self, k: int) -> Floats:
        """Return an attitude R_BI of the log, level if only its heading is known."""
        assert self.log.attitude is not None
        values = self.log.attitude.values
        if "quaternion" in values:
            return quaternion_to_dcm(values["quaternion"][k])
        return level(float(values["heading"][k]))

    def _first_heading(self, time: float) -> float | None:
        """Return the heading in the log nearest to a time, within `LONGEST_STEP`; None: none."""
        attitude = self.log.attitude
        if attitude is None or not len(attitude):
            return None
        k = int(np.argmin(np.abs(attitude.time - time)))
        R_BI = self._attitude(k)
        near = abs(attitude.time[k] - time) < LONGEST_STEP
        return math.atan2(R_BI[0, 1], R_BI[0, 0]) if near else None

    def _fix(self, stream: Stream, k: int) -> dict[str, Any]:
        """Return the GNSS measurements of one instant as keywords of `update`."""
        position, velocity, baseline = (
            self._vector_G(stream, quantity, k) for quantity in ("position", "velocity", "baseline")
        )
        found: dict[str, Any] = {}
        if position is not None:
            found["gnss_position_G"] = position
            self._add_noise(found, "gnss_sigma", stream, "position_sigma_I", k)
        if baseline is not None:
            found["gnss_baseline_G"] = baseline
        if velocity is not None and self.takes_velocity:
            found["gnss_velocity_G"] = velocity
            self._add_noise(found, "velocity_sigma", stream, "velocity_sigma", k)
        return found

    def _vector_G(self, stream: Stream, quantity: str, k: int) -> Floats | None:
        """Return a vector in G, positions relative to the origin; None: not measured."""
        for frame in "GI":
            values = stream.values.get(f"{quantity}_{frame}")
            if values is not None and np.isfinite(values[k]).all():
                vector = values[k] if frame == "G" else turned(self.R_GI, values[k])
                from_center = frame == "G" and quantity == "position"
                return vector - self.origin if from_center else vector
        return None

    def _add_noise(
        self, found: dict[str, Any], keyword: str, stream: Stream, name: str, k: int
    ) -> None:
        values = stream.values.get(name)
        if values is None:
            return
        sigma, suites = values[k], self.suite.gnss
        if name == "position_sigma_I" and np.isinf(sigma).any() and suites is not None:
            known = sigma if self.reported else np.full(3, np.nan)
            known = np.where(np.isnan(known), suites.position_sigma_I, known)
            found[keyword] = np.where(np.isinf(sigma), UNMEASURED, known)
        elif self.reported and np.isfinite(sigma).all():
            found[keyword] = sigma if values.ndim > 1 else float(sigma)

    # ---- the start -----------------------------------------------------------------------------

    def _try_to_start(self, name: str, k: int) -> None:
        """Start with the first fix, and other measurements of the heading."""
        if name == "magnetometer":
            self.field = k
        if name != "gnss":
            return
        stream = self.streams["gnss"]
        fix, time = self._fix(stream, k), float(stream.time[k])
        first = float(
            self.log.imu.time[0 if self.averages else 1]
        )  # an instant needs the sample before
        if "gnss_position_G" not in fix or time < first - LONGEST_STEP:
            return
        if not {"heading", "course"} & set(self.start) and "gnss_baseline_G" not in fix:
            heading = self._first_heading(time)
            fix |= {} if heading is None else {"heading": heading}
        known = {"gnss_baseline_G", "heading"} & set(fix) or {
            "heading",
            "course",
            "magnetometer",
        } & set(self.start)
        if not known and "magnetometer" in self.streams and not self.tilted:
            if self.in_order:  # the nearest one, even if it is later
                fields = self.streams["magnetometer"].time
                self.field = int(np.argmin(np.abs(fields - time)))
            self.first_fix = min(self.first_fix, float(stream.received[k]))
            if self.field is None and stream.received[k] < self.first_fix + PATIENCE:
                return
            if self.field is not None:
                fix["magnetometer"] = self.streams["magnetometer"].values["magnetometer"][
                    self.field
                ]
        if self.start.get("course") and "gnss_velocity_G" not in {**fix, **self.start}:
            why = "the first fix of the log has none"
            if not self.takes_velocity:
                why = "the sensors take none: GnssParams.velocity_sigma is None"
            raise ValueError(f"a start by its course must have a GNSS velocity, but {why}")
        self.first_state = {**fix, **self.start, "time": time}
        self.filter.initialize(**self.first_state)
        self._go_on()

    def started(self, suite: SensorSuite) -> KalmanFilter:
        """Return a filter for another suite in the state in which the tape begins."""
        kf = ESTIMATORS[self.estimator](with_wide_start(suite, self.log), window=self.window)
        if "position" in self.start:
            kf.set_state(**self._given_state(suite))
        else:
            kf.initialize(**self.first_state)
        if self.log.barometer_from_start:
            kf._engine.steps["level"] = np.nan
        return kf

    def _start_from_state(self) -> None:
        """Start from the state that the caller gives."""
        try:
            self.filter.set_state(**self._given_state(self.suite))
        except TypeError as error:
            raise ValueError(f"start must be the keywords of set_state: {error}") from None
        self._go_on()

    def _given_state(self, suite: SensorSuite) -> dict[str, Any]:
        """Return keywords of `set_state`, completed for a vehicle at rest."""
        state = {"time": float(self.log.imu.time[0]), **self.start}
        if {"R_BI", "covariance"} & set(state):
            return state
        check.keywords(state, ("position", "heading", "time"), "a start at a position")
        heading = state.setdefault("heading", self._first_heading(state["time"]))
        if heading is None:
            raise ValueError(
                "start must have a heading in addition to the position, or all keywords of "
                "set_state"
            )
        return state_at_rest(suite, **state)

    def _go_on(self) -> None:
        """Process the samples since the time of the start."""
        self.running, begin = True, self.filter.time
        self.history.begin(begin)
        if self.calls is not None:
            given = self.first_state or {"time": begin, **self.start}
            self.calls.start(given, self.filter.sensors, self.log.barometer_from_start)
        for i in self.held:
            if self.log.imu.time[i] > begin + SAME_TIME:
                self._predict(i)
            else:
                self.before = i
        self.held = []

    # ---- results -------------------------------------------------------------------------------

    def _keep_row(self) -> None:
        """Store the estimate before the next sample arrives."""
        if self.running:
            self.times.append(self.history.time)
            self.writer.keep()
            if self.calls is not None:
                self.calls.keep()

    def _result(self, pieces: Iterable[Results]) -> Replay:
        """Return the estimates of all pieces of the tape."""
        found: dict[str, Any] = {}
        first, blocks = (
            0,
            {block: Counted(FREEDOMS[block]) for block in blocks_of(self.filter.sensors)},
        )
        updates = 0
        stamps = np.frombuffer(self.stamps).reshape(-1, 2) if self.stamps else np.empty((0, 2))
        for kept, reported, valid in pieces:
            for name, values in _columns_of(kept).items():
                shape = (len(self.times), *values.shape[1:])
                found.setdefault(name, np.empty(shape, values.dtype))[first : first + len(kept)] = (
                    values
                )
            first += len(kept)
            times = stamps[updates : updates + len(valid)]
            updates += len(valid)
            for row, (block, counted) in enumerate(blocks.items()):
                have = valid[:, block]
                if have.any():
                    counted.add(times[have], reported[have, row])
        return Replay(
            estimator=self.estimator,
            sensors=self.assumed,
            time=np.array(self.times),
            **found,
            status=self.filter.status,
            measured={
                name_of(b): c.measured()
                for b, c in blocks.items()
                if c.rows and not (self.holds and b == POSITION_BLOCK)
            },
            notes=(SENTENCE,) if self.holds else (),
            late={name: np.array(ages) for name, ages in self.late.items()},
            unused=self.unused,
        )


def _columns_of(kept: Floats) -> dict[str, Any]:
    """Return fields of `Replay` from stored estimates."""
    r, v, R, b_a, b_g, variances, state = np.split(kept, np.cumsum((3, 3, 9, 3, 3, 15)), 1)
    return {
        "position": r,
        "velocity": v,
        "quaternion": dcm_to_quaternion(R.reshape(-1, 3, 3)),
        "accel_bias": b_a,
        "gyro_bias": b_g,
        "sigma": np.sqrt(variances),
        "heading_known": state[:, 1] > 0.0,
        "diverged": state[:, 0] > 0.0,
    }


class Counted:
    """Innovations of one kind of measurement, from the pieces of a tape."""

    def __init__(self, freedoms: int) -> None:
        self._freedoms = freedoms
        self.rows: list[Floats] = []

    def add(self, times: Floats, reported: Floats) -> None:
        """Add innovations (m, REPORTED) with their times of measurement and arrival (m, 2)."""
        self.rows.append(np.column_stack([times, reported]))

    def measured(self) -> Measured:
        """Return all innovations."""
        table, d = np.concatenate(self.rows), self._freedoms
        values = table[:, 2:]
        return Measured(
            *(table[:, 0], table[:, 1], values[:, :d], values[:, 3 : 3 + d]),
            *(values[:, 6], values[:, 7]),
        )


def name_of(block: int) -> str:
    """Return the name of a block of innovations."""
    if block < FEATURE_BLOCKS:
        return ("gnss_position", "gnss_baseline", "gnss_velocity")[block]
    if block >= AID_BLOCKS:
        return Aid(block - AID_BLOCKS).name.lower()
    return f"feature_{block - FEATURE_BLOCKS}"
