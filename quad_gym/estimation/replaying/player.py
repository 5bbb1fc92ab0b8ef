"""A filter that processes a log event by event, in the order of arrival.

Times alone determine which samples and measurements are processed, and when. Compiled code
(`kernels/window.py`) therefore writes the operations to a tape first, which other code then runs.
"""

from typing import Any

import numpy as np

from quad_gym.estimation.filtering.filters import (
    LONGEST_STEP,
    ExtendedKalmanFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
)
from quad_gym.estimation.filtering.history import InputHistory
from quad_gym.estimation.filtering.running import run_filter
from quad_gym.estimation.filtering.tape import TapeWriter
from quad_gym.estimation.logs import Floats, Log
from quad_gym.estimation.replaying.calls import FilterCalls
from quad_gym.estimation.replaying.collecting import collected, name_of
from quad_gym.estimation.replaying.held_position import SENTENCE, held, lacks_position
from quad_gym.estimation.replaying.log_start import LogStart
from quad_gym.estimation.replaying.measurements import LogMeasurements
from quad_gym.estimation.replaying.plausibility import MisfitError, nothing_in_common
from quad_gym.estimation.replaying.results import Replay
from quad_gym.packing.aids import blocks_of
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import POSITION_BLOCK
from quad_gym.records.inputs import INPUT, Outcome

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
        self.filter = ESTIMATORS[estimator](suite, window=self.window)
        self.measured = LogMeasurements(log, suite, reported_noise)
        self.streams, self.unused = self.measured.streams, self.measured.unused
        self.unused = ("gnss", *self.unused) if unused_gnss else self.unused
        self.start = LogStart(self.measured, start, self.in_order)
        self.averages = suite.imu.samples == "average"
        self.late: dict[str, list[float]] = {}  # ages of what came too late, by sensor
        self.history = InputHistory(self.window, max(LONGEST_STEP, suite.imu.dt), numbered=True)
        self.writer = TapeWriter(self.measured.by_number, self.history)
        self.times = np.empty(0)  #: of the estimates
        self.stamps = np.empty((0, 2))  #: of all updates, each with its arrival

    # ---- the log, event by event ---------------------------------------------------------------

    def write_tape(self) -> None:
        """Start the filter, and write the operations on the log to a tape."""
        names = list(self.streams)  # the IMU first: it comes before what arrives with it
        arrivals = "time" if self.in_order else "received"
        received = np.concatenate([getattr(self.streams[name], arrivals) for name in names])
        kinds = np.concatenate([np.full(len(self.streams[n]), k) for k, n in enumerate(names)])
        places = np.concatenate([np.arange(len(self.streams[n])) for n in names])
        order = np.lexsort((places, kinds, received))
        kinds, places = kinds[order], places[order]
        first = self._begin(names, kinds, places)
        if first is not None:
            self._write_inputs(names, kinds, places, first)
        if not len(self.times):
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
            self.stamps,
        )
        if self.holds:
            measured.pop(POSITION_BLOCK, None)
        return Replay(
            estimator=self.estimator,
            sensors=self.assumed,
            time=self.times,
            **columns,
            status=self.filter.status,
            measured={name_of(block): found for block, found in measured.items()},
            notes=(SENTENCE,) if self.holds else (),
            late={name: np.array(ages) for name, ages in self.late.items()},
            unused=self.unused,
        )

    def started(self, suite: SensorSuite) -> KalmanFilter:
        """Return a filter for another suite in the state in which the tape begins."""
        kf = ESTIMATORS[self.estimator](suite, window=self.window)
        self.start.begin(kf, suite)
        return kf

    def _begin(self, names: list[str], kinds: Any, places: Any) -> int | None:
        """Start the filter; return the number of arrivals before, or None without a start."""
        arrivals = enumerate(zip(kinds.tolist(), places.tolist(), strict=True))
        found = (k for k, (kind, i) in arrivals if kind and self.start.found_in(names[kind], i))
        fix = -1 if self.start.at_rest else next(found, None)
        if fix is None:
            return None
        self.start.begin(self.filter, self.suite)
        begin = self.filter.time
        self.history.begin(begin)
        if self.calls is not None:
            given = self.start.from_fix or {"time": begin, **self.start.given}
            self.calls.start(given, self.start.field_row, self.log.barometer_from_start)
        return fix + 1

    def _write_inputs(self, names: list[str], kinds: Any, places: Any, first: int) -> None:
        """Write the samples, and the measurements after the start, to the tape.

        Args:
            names: Names of the streams.
            kinds: (n,) numbers of the streams in which something arrives.
            places: (n,) rows there.
            first: Number of arrivals before the start, of which only samples count.
        """
        chosen = kinds == 0
        for number in range(1, len(names)):
            own = first + np.flatnonzero(kinds[first:] == number)
            chosen[own] = self.measured.present(number, places[own])
        taken = np.flatnonzero(chosen)
        kinds_of = ["gnss" if name == "attitude" else name for name in names]
        ranks = np.unique(kinds_of, return_inverse=True)[1] + 1  # by name
        ranks[0] = 0
        times: list[Floats] = []
        before = -1  # the sample that holds now, of an IMU of instants
        for k in range(0, len(taken), _AT_ONCE):
            some = taken[k : k + _AT_ONCE]
            inputs = self._inputs(kinds[some], places[some], ranks, before)
            inputs["keeps"] = (kinds[some] == 0) & (some >= first)
            self.writer.write(inputs)
            self._require_samples(inputs)
            times.append(inputs["now"][inputs["keeps"] > 0])
            self._note(inputs, names, kinds[some], places[some], before)
            samples = places[some][kinds[some] == 0]
            before = int(samples[-1]) if len(samples) else before
        self.writer.keep()
        if self.calls is not None:
            self.calls.keep()
        self.times = np.append(np.concatenate([np.empty(0), *times]), self.history.time)
        rows = np.array(self.writer.rows, np.int64).reshape(-1, 2)[self.writer.updates]
        self.stamps = np.empty((len(rows), 2))
        for number, stream in enumerate(self.streams.values()):
            own = rows[:, 0] == number
            self.stamps[own, 0] = stream.time[rows[own, 1]]
            self.stamps[own, 1] = stream.received[rows[own, 1]]

    def _inputs(self, kinds: Any, places: Any, ranks: Any, before: int) -> Any:
        """Return arrivals as INPUT (n,); an IMU of instants measures at the start of its time."""
        inputs = np.zeros(len(kinds), INPUT)
        inputs["rank"], inputs["dt"] = ranks[kinds], np.nan
        for kind, stream in enumerate(self.streams.values()):
            inputs["time"][kinds == kind] = stream.time[places[kinds == kind]]
        imu, rows = kinds == 0, places[kinds == 0]
        chosen = self._samples(rows, before)
        for name in ("gyro", "accel"):
            values = self.log.imu.values[name][chosen]
            values[chosen < 0] = np.nan  # none holds before the first one
            inputs[name][imu] = values
        return inputs

    def _samples(self, rows: Any, before: int) -> Any:
        """Return the samples (n,) that hold for the times up to these rows of the IMU."""
        return rows if self.averages else np.append(before, rows)[:-1]

    def _require_samples(self, inputs: Any) -> None:
        """Refuse samples that are too far apart."""
        far = inputs[inputs["outcome"] == Outcome.OUT_OF_RANGE]
        if len(far):
            usual = float(np.median(np.diff(self.log.imu.time)))
            unit = "ms" if usual < 1e3 else "us" if usual < 1e6 else "ns"
            cause = "cut the log there" if usual < LONGEST_STEP else f"time in {unit}?"
            raise ValueError(
                f"samples of the IMU must be at most {LONGEST_STEP:g} s apart, got none from "
                f"{far['now'][0]:.3f} s to {far['time'][0]:.3f} s: {cause}"
            )

    def _note(self, inputs: Any, names: list[str], kinds: Any, places: Any, before: int) -> None:
        """Note which measurements were taken and which came too late, and the calls."""
        measures, old = inputs["rank"] > 0, inputs["outcome"] == Outcome.TOO_OLD
        took = measures & ~old
        self.writer.rows.extend(np.column_stack([kinds, places])[took].ravel().tolist())
        for kind, place in zip(kinds[old].tolist(), places[old].tolist(), strict=True):
            stream = self.streams[names[kind]]
            age = float(stream.received[place] - stream.time[place])
            self.late.setdefault(names[kind], []).append(age)
        if self.calls is not None:
            rows = places.copy()
            rows[kinds == 0] = self._samples(places[kinds == 0], before)
            for given, kind, row in zip(inputs, kinds.tolist(), rows.tolist(), strict=True):
                measurement = self.measured.at(names[kind], row) if kind else None
                self.calls.take(given, names[kind], row, measurement)
