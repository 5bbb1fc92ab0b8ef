"""A filter that processes a log event by event, in the order of arrival.

Times alone determine which samples and measurements are processed, and when. The operations are
therefore written to a tape first, which compiled code then runs.
"""

import bisect
from array import array
from typing import Any

import numpy as np

from quad_gym.estimation.calls import FilterCalls
from quad_gym.estimation.collecting import collected, name_of
from quad_gym.estimation.filters import (
    LONGEST_STEP,
    ExtendedKalmanFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
)
from quad_gym.estimation.first_motion import with_wide_start
from quad_gym.estimation.held_position import SENTENCE, held, lacks_position
from quad_gym.estimation.history import SAME_TIME, InputHistory
from quad_gym.estimation.log_start import LogStart
from quad_gym.estimation.logs import Floats, Log
from quad_gym.estimation.measurements import LogMeasurements
from quad_gym.estimation.plausibility import MisfitError, nothing_in_common
from quad_gym.estimation.results import Replay
from quad_gym.estimation.running import run_filter
from quad_gym.estimation.samples import Sample
from quad_gym.estimation.tape import TapeWriter
from quad_gym.packing.aids import blocks_of
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import POSITION_BLOCK

ESTIMATORS = {"ukf": UnscentedKalmanFilter, "ekf": ExtendedKalmanFilter}

_AT_ONCE = 8192  #: events whose numbers are Python's at a time


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
        self.in_order, self.window = window is None, window or 0.0
        wide = with_wide_start(suite, log)
        self.filter = ESTIMATORS[estimator](wide, window=self.window)
        self.measured = LogMeasurements(log, suite, reported_noise)
        self.streams, self.unused = self.measured.streams, self.measured.unused
        self.unused = ("gnss", *self.unused) if unused_gnss else self.unused
        tilted = wide is not suite and not self.in_order
        self.start = LogStart(self.measured, start, self.in_order, tilted)
        self.averages = suite.imu.samples == "average"
        self.gyros, self.accels = log.imu.values["gyro"], log.imu.values["accel"]
        self.running = False
        self.held: list[int] = []  # samples before the start
        self.waiting: list[tuple[float, str, int]] = []  # time stamps after the filter's time
        self.before: int | None = None  # the sample that holds now, of an IMU of instants
        self.late: dict[str, list[float]] = {}  # ages of what came too late, by sensor
        self.times = array("d")
        self.stamps = array("d")  # of all updates, each with its arrival
        self.gyro: Floats | None = None  # of the prediction before
        self.writer = writer = TapeWriter(self.measured.by_number)
        self.history = InputHistory(self.window, writer.apply, writer.copy, writer.restore)

    # ---- the log, event by event ---------------------------------------------------------------

    def write_tape(self) -> None:
        """Start the filter, and write the operations on the log to a tape.

        Raises:
            MisfitError: If the suite has no sensor of the log.
            ValueError: If the log has no fix to start from, or its IMU samples have a gap.
        """
        names = list(self.streams)  # the IMU first: it comes before what arrives with it
        arrivals = "time" if self.in_order else "received"
        received = np.concatenate([getattr(self.streams[name], arrivals) for name in names])
        kinds = np.concatenate([np.full(len(self.streams[n]), k) for k, n in enumerate(names)])
        places = np.concatenate([np.arange(len(self.streams[n])) for n in names])
        if self.start.at_rest:
            self._begin()
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
        columns, measured = collected(
            run_filter(self.filter, self.writer),
            blocks_of(self.filter.sensors),
            len(self.times),
            np.array(self.stamps).reshape(-1, 2),
        )
        if self.holds:
            measured.pop(POSITION_BLOCK, None)
        return Replay(
            estimator=self.estimator,
            sensors=self.assumed,
            time=np.array(self.times),
            **columns,
            status=self.filter.status,
            measured={name_of(block): found for block, found in measured.items()},
            notes=(SENTENCE,) if self.holds else (),
            late={name: np.array(ages) for name, ages in self.late.items()},
            unused=self.unused,
        )

    def started(self, suite: SensorSuite) -> KalmanFilter:
        """Return a filter for another suite in the state in which the tape begins."""
        kf = ESTIMATORS[self.estimator](with_wide_start(suite, self.log), window=self.window)
        self.start.begin(kf, suite)
        return kf

    def _begin(self) -> None:
        """Start the filter, and process the samples since the time of the start."""
        self.start.begin(self.filter, self.suite)
        self.running, begin = True, self.filter.time
        self.history.begin(begin)
        if self.calls is not None:
            given = self.start.from_fix or {"time": begin, **self.start.given}
            self.calls.start(given, self.filter.sensors, self.log.barometer_from_start)
        for i in self.held:
            if self.log.imu.time[i] > begin + SAME_TIME:
                self._predict(i)
            else:
                self.before = i
        self.held = []

    def _take_sample(self, i: int) -> None:
        if not self.running:
            self.held.append(i)
            return
        self._keep_row()
        self._predict(i)

    def _keep_row(self) -> None:
        """Store the estimate before the next sample arrives."""
        if self.running:
            self.times.append(self.history.time)
            self.writer.keep()
            if self.calls is not None:
                self.calls.keep()

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
            unit = "ms" if usual < 1e3 else "us" if usual < 1e6 else "ns"
            cause = "cut the log there" if usual < LONGEST_STEP else f"time in {unit}?"
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
            if self.start.found_in(name, k):
                self._begin()
        elif stamp > self.history.time + SAME_TIME:
            if self.measured.at(name, k) is not None:
                bisect.insort(self.waiting, (stamp, name, k))
        elif stamp < self.history.oldest - SAME_TIME:
            received = float(self.streams[name].received[k])
            self.late.setdefault(name, []).append(received - stamp)
        else:
            self._call_update(name, k)
            self._update(name, k)

    def _call_update(self, name: str, k: int) -> None:
        if self.calls is not None:
            measurement = self.measured.at(name, k)
            if measurement is not None:
                self.calls.update(name, float(self.streams[name].time[k]), measurement)

    def _update(self, name: str, k: int) -> None:
        stream, history = self.streams[name], self.history
        measurement = self.measured.at(name, k)
        if measurement is None:
            return
        stamp = float(stream.time[k])
        self.writer.awaited, self.writer.place = measurement, (self.measured.number(name), k)
        if stamp >= history.time - SAME_TIME:
            history.add(measurement)
        else:
            history.insert(measurement, stamp)
        self.stamps.extend((stamp, float(stream.received[k])))
