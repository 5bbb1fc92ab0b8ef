"""Players of a log, event by event: the built-in filter, and a user's estimator."""

from collections import deque
from types import SimpleNamespace
from typing import Any

import numpy as np

from quad_gym.batch.own_estimator import (
    STARTS,
    Estimator,
    OwnFilter,
    checked_estimate,
    factors,
)
from quad_gym.estimation.filters import (
    LONGEST_STEP,
    ExtendedKalmanFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
    run_filter,
)
from quad_gym.estimation.inputs import (
    InputHistory,
    Measurement,
    TapeWriter,
    measured_blocks,
    values_of,
)
from quad_gym.logs.formats import Floats, Log
from quad_gym.logs.replaying.log_start import LogStart
from quad_gym.logs.replaying.measurements import (
    SENTENCE,
    FilterCalls,
    LogMeasurements,
    MisfitError,
    held,
    lacks_position,
    nothing_in_common,
)
from quad_gym.logs.replaying.results import (
    InnovationSeries,
    Replay,
    collected,
    name_of,
    state_columns,
)
from quad_gym.packing import blocks_of
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import FREEDOMS, POSITION_BLOCK
from quad_gym.records.inputs import INPUT, SAME_TIME, Outcome, SensorReading

# --------------------------------------------------------------------------------------------------
# A filter that processes a log event by event, in the order of arrival.
#
# Times alone determine which samples and measurements are processed, and when. Compiled code
# (`kernels/tape.py`) therefore writes the operations to a tape first, which other code then runs.
# --------------------------------------------------------------------------------------------------

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
        self.began = np.nan  #: time of the start
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
        return self._replay(self.estimator, columns, measured)

    def _replay(
        self, name: str, columns: dict[str, Any], measured: dict[int, InnovationSeries]
    ) -> Replay:
        """Return the result of the estimator with a name, with innovations by block."""
        return Replay(
            estimator=name,
            sensors=self.assumed,
            time=self.times,
            **columns,
            status=self.filter.status,
            measured={name_of(block): found for block, found in measured.items()},
            notes=(SENTENCE,) if self.holds else (),
            late={sensor: np.array(ages) for sensor, ages in self.late.items()},
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
        begin = self.began = self.filter.time
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
        # what was measured before the start and arrives soon after it is not late
        age = inputs["now"] - inputs["time"]
        late = old & ((inputs["time"] > self.began) | (age > self.window))
        for kind, place in zip(kinds[late].tolist(), places[late].tolist(), strict=True):
            stream = self.streams[names[kind]]
            waited = float(stream.received[place] - stream.time[place])
            self.late.setdefault(names[kind], []).append(waited)
        if self.calls is not None:
            rows = places.copy()
            rows[kinds == 0] = self._samples(places[kinds == 0], before)
            for given, kind, row in zip(inputs, kinds.tolist(), rows.tolist(), strict=True):
                measurement = self.measured.at(names[kind], row) if kind else None
                self.calls.take(given, names[kind], row, measurement)


# --------------------------------------------------------------------------------------------------
# A user's estimator that processes a log, in ticks of constant length.
# --------------------------------------------------------------------------------------------------

EVERYONE = np.ones(1, bool)


class OwnPlayer(Player):
    """Player with a user's estimator in place of the filter, whose start it has.

    A tick, of the suite's IMU, has the mean of the log's samples over it, and the measurements that
    have arrived since the tick before, one of each sensor at most.

    Args:
        own: The estimator, of which a copy is used.
        values: Arguments of `Player`.
    """

    def __init__(self, own: Estimator, *values: Any) -> None:
        super().__init__(*values)
        self._own = OwnFilter(own, 1)
        self._arrived: dict[int, list[tuple[float, float]]] = {}  # stamps and arrivals by block
        self._vehicle = VehicleParams(gravity=self.suite.estimator.gravity)
        features = () if self.suite.camera is None else self.suite.camera.features_I
        self._features = np.array(features, np.float64).reshape(1, -1, 3)

    def play(self) -> Replay:
        """Estimate along the whole log."""
        self.start.tilted = False  # an estimator of a user's knows no unknown heading
        self.write_tape()
        kf, imu, dt = self.filter, self.log.imu, self.suite.imu.dt
        if not kf.heading_known:
            raise ValueError(
                "start must have a heading, or the log a baseline or a magnetometer, for an "
                "estimator of your own (--heading)"
            )
        count = 1 + int((imu.time[-1] - kf.time) / dt + SAME_TIME)
        self.times = times = np.asarray(kf.time + dt * np.arange(count), np.float64)
        gyro, accel = (self._means(imu.values[name], times) for name in ("gyro", "accel"))
        last = np.searchsorted(imu.time, times + SAME_TIME, "right") - 1
        now = imu.values["gyro"][np.maximum(last, 0)]
        start = {name: np.array(getattr(kf, name))[np.newaxis] for name in STARTS}
        view = self._at(0.0, gyro[0], accel[0], now[0], {}, **start)
        rows = [self._row("reset", self._own.begin(view, EVERYONE))]
        waiting, self.late = self._arrivals(kf.time), {}
        for k in range(1, len(times)):
            readings = self._readings(waiting, times[k])
            view = self._at(times[k] - times[0], gyro[k - 1], accel[k - 1], now[k], readings)
            rows.append(self._row("update", self._own.estimator.update(view)))
        return self._replay(self._own.name, _columns(rows), self._measured())

    def _means(self, values: Floats, times: Floats) -> Floats:
        """Return the means of the IMU's samples between successive times, (n, 3)."""
        stamps = self.log.imu.time
        held = values[1:] if self.averages else values[:-1]
        integral = np.zeros_like(values)
        integral[1:] = np.cumsum(held * np.diff(stamps)[:, np.newaxis], axis=0)
        at = np.stack([np.interp(times, stamps, column) for column in integral.T], axis=1)
        means = np.diff(at, axis=0) / self.suite.imu.dt
        return means if len(means) else values[:1]

    def _arrivals(self, begin: float) -> deque[tuple[float, float, str, int]]:
        """Return arrivals, time stamps, sensors and places of the measurements after the start."""
        found = []
        for name, stream in self.streams.items():
            if name != "imu":
                later = np.flatnonzero(stream.time > begin + SAME_TIME).tolist()
                found += [(stream.received[k], stream.time[k], name, k) for k in later]
        return deque(sorted(found))

    def _readings(self, waiting: deque[Any], now: float) -> dict[str, SensorReading]:
        """Return the measurements that have arrived; a second one of a sensor waits for a tick."""
        found: dict[str, SensorReading] = {}
        later, known = [], set()
        while waiting and waiting[0][0] <= now + SAME_TIME:
            received, stamp, name, k = arrival = waiting.popleft()
            if name in known or stamp > now + SAME_TIME:
                later.append(arrival)
                continue
            known.add(name)
            measurement, age = self.measured.at(name, k), max(now - stamp, 0.0)
            if measurement is None:
                continue
            if age > self.window + self.suite.imu.dt:
                self.late.setdefault(name, []).append(received - stamp)
                continue
            found |= self._by_name(measurement, age)
            for block in measured_blocks(measurement):
                self._arrived.setdefault(block, []).append((stamp, received))
        waiting.extendleft(reversed(later))
        return found

    def _by_name(self, given: Measurement, age: float) -> dict[str, SensorReading]:
        """Return a measurement as readings, by their names."""
        found, R_IG = {}, self.measured.R_GI.T
        for name, reading in READINGS.items():
            value = values_of(given, name, self.suite.blocks_of(name))
            new = np.asarray(np.isfinite(value).all(axis=1))
            if not new.any():
                continue
            if name == "gnss_baseline":  # has any length
                assert self.suite.gnss is not None
                length = np.linalg.norm(self.suite.gnss.baseline_B)
                value = value * (length / np.linalg.norm(value))
            if reading.in_G:
                value = (R_IG @ value[0])[np.newaxis]
            several = reading.most_blocks > 1
            one = value.reshape(1, *self.suite.shape_of(name)).copy()
            found[name] = SensorReading(one, new[np.newaxis] if several else new, age)
        return found

    def _at(
        self,
        time: float,
        gyro: Floats,
        accel: Floats,
        now: Floats,
        readings: dict[str, SensorReading],
        **start: Any,
    ) -> Any:
        """Return the `Measurements`, or the `StartView`, of an instant."""
        for name, reading in READINGS.items():
            if name not in readings:
                count = self.suite.blocks_of(name)
                new = np.zeros((1, count) if reading.most_blocks > 1 else 1, bool)
                nothing = np.full((1, *self.suite.shape_of(name)), np.nan)
                start[name] = SensorReading(nothing, new, 0.0) if count else None
        return SimpleNamespace(
            count=1,
            dt=self.suite.imu.dt,
            sensors=self.suite,
            vehicle=self._vehicle,
            ground_height=self.suite.estimator.ground_height,
            gyro=gyro[np.newaxis].copy(),
            accel=accel[np.newaxis].copy(),
            gyro_now=now[np.newaxis].copy(),
            time=np.array([time]),
            action=np.full((1, 4), np.nan),
            features=self._features.copy(),
            **readings,
            **start,
        )

    def _row(self, method: str, given: Any) -> Floats:
        """Return an estimate, if it is valid, as numbers: r, v, R_BI, b_a, b_g and sigmas."""
        method = f"{self._own.name}.{method}"
        found = checked_estimate(method, given, 1, EVERYONE)
        sigma = np.full(15, np.nan)
        if "covariance" in found:
            factors(method, found["covariance"], EVERYONE)
            sigma = np.sqrt(np.diag(found["covariance"][0]))
        zero = np.zeros((1, 3))
        state = (found.get(name, zero).ravel() for name in STARTS if name != "covariance")
        return np.concatenate([*state, sigma])

    def _measured(self) -> dict[int, InnovationSeries]:
        """Return times of the measurements, by block; their innovations are unknown."""
        found = {}
        for block in blocks_of(self.suite):
            if block in self._arrived:
                stamps = np.array(self._arrived[block])
                unknown = np.full((len(stamps), FREEDOMS[block]), np.nan)
                none = np.zeros(len(stamps))
                times = stamps[:, 0], stamps[:, 1]
                found[block] = InnovationSeries(*times, unknown, unknown, unknown[:, 0], none)
        return found


def _columns(rows: list[Floats]) -> dict[str, Any]:
    """Return fields of `Replay` from rows; an own estimator has no diagnostics of its heading."""
    columns, sigma = state_columns(np.array(rows))
    everywhere = np.ones(len(rows), bool)
    return {
        **columns,
        "sigma": sigma,
        "heading_known": everywhere,
        "diverged": ~everywhere,
        "heading_apart": np.zeros(len(rows)),
        "motion_sigma": np.full(len(rows), np.inf),
        "compass_out": ~everywhere,
    }
