"""A filter that processes a log event by event, in the order of arrival."""

import bisect
import math
from typing import Any

import numpy as np

from quad_gym.estimation.estimate import Innovations
from quad_gym.estimation.filters import LONGEST_STEP, ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.estimation.history import SAME_TIME
from quad_gym.estimation.logs import Floats, Log, Stream
from quad_gym.estimation.plausibility import MisfitError, nothing_in_common
from quad_gym.estimation.results import Measured, Replay
from quad_gym.estimation.starts import state_at_rest
from quad_gym.frames import ecef_to_enu
from quad_gym.packing.aids import blocks_of
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import AID_BLOCKS, FEATURE_BLOCKS, FREEDOMS, Aid
from quad_gym.rotations import dcm_to_quaternion

ESTIMATORS = {"ukf": UnscentedKalmanFilter, "ekf": ExtendedKalmanFilter}

PATIENCE = 2.0
"""Time for which a start waits for the first magnetic field [s]."""


class Player:
    """Processes the contents of a log with a filter, in the order of arrival."""

    def __init__(
        self,
        log: Log,
        suite: SensorSuite,
        estimator: str,
        start: dict[str, Any],
        reported_noise: bool,
        window: float,
    ) -> None:
        self.log, self.suite, self.estimator = log, suite, estimator
        self.start, self.reported = start, reported_noise
        self.filter = ESTIMATORS[estimator](suite, window=window)
        self.window = window
        self.averages = suite.imu.samples == "average"
        self.running = False
        self.held: list[int] = []  # samples before the start
        self.waiting: list[tuple[float, str, int]] = []  # time stamps after the filter's time
        self.before: int | None = None  # the sample that holds now, of an IMU of instants
        self.field: int | None = None  # the last magnetic field before the start
        self.pressure_level = 0.0 if not log.barometer_from_start else math.nan
        self.first_fix = math.inf
        self.too_late = 0
        self.rows: list[tuple[Any, ...]] = []
        self.reports: list[tuple[float, float, Innovations]] = []
        self._choose_streams()

    def _choose_streams(self) -> None:
        """Select the streams that the suite uses, and list the others."""
        suite, log = self.suite, self.log
        unused = []
        self.streams = {"imu": log.imu}
        for name, stream in log.streams.items():
            if name == "imu":
                continue
            if getattr(suite, name) is None:
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

    # ---- the log, event by event ---------------------------------------------------------------

    def play(self) -> Replay:
        """Filter the whole log."""
        names = list(self.streams)  # the IMU first: it comes before what arrives with it
        received = np.concatenate([self.streams[name].received for name in names])
        kinds = np.concatenate([np.full(len(self.streams[n]), k) for k, n in enumerate(names)])
        places = np.concatenate([np.arange(len(self.streams[n])) for n in names])
        if "position" in self.start:
            self._start_from_state()
        for k in np.lexsort((places, kinds, received)):
            if kinds[k] == 0:
                self._take_sample(int(places[k]))
            else:
                self._take_measurement(names[kinds[k]], int(places[k]))
        self._keep_row()
        if not self.rows:
            if self.unused and len(self.streams) == 1:
                raise MisfitError(
                    f"{nothing_in_common(self.unused)}: use a suite with these sensors"
                )
            raise ValueError(
                "a log must have a GNSS position to start from, with IMU samples after it; or give "
                "start= a position and a heading (--start-position 0 0 0 --heading 0), or all "
                "keywords of set_state"
            )
        return self._result()

    def _take_sample(self, i: int) -> None:
        if not self.running:
            self.held.append(i)
            return
        self._keep_row()
        self._predict(i)

    def _predict(self, i: int) -> None:
        """Propagate the estimate to the time of a sample."""
        imu, ukf = self.log.imu, self.filter
        time = float(imu.time[i])
        chosen = i if self.averages else self.before
        self.before = i
        step = time - ukf.time
        if step <= SAME_TIME or chosen is None:
            return
        if step > max(LONGEST_STEP, self.suite.imu.dt):
            raise ValueError(
                f"samples of the IMU must be at most {LONGEST_STEP:g} s apart, got none from "
                f"{ukf.time:.3f} s to {time:.3f} s: cut the log there"
            )
        ukf.predict(imu.values["gyro"][chosen], imu.values["accel"][chosen], dt=step)
        while self.waiting and self.waiting[0][0] <= ukf.time + SAME_TIME:
            _, name, k = self.waiting.pop(0)
            self._update(name, k)

    def _take_measurement(self, name: str, k: int) -> None:
        stamp = float(self.streams[name].time[k])
        if not self.running:
            self._try_to_start(name, k)
        elif stamp > self.filter.time + SAME_TIME:
            bisect.insort(self.waiting, (stamp, name, k))
        elif stamp < self.filter.oldest_time - SAME_TIME:
            self.too_late += 1
        else:
            self._update(name, k)

    def _update(self, name: str, k: int) -> None:
        stream = self.streams[name]
        given = self._keywords(name, stream, k)
        if not given:
            return
        stamp = float(stream.time[k])
        self.filter.update(**given, time=min(stamp, self.filter.time))
        self.reports.append((stamp, float(stream.received[k]), self.filter.last_update))

    def _keywords(self, name: str, stream: Stream, k: int) -> dict[str, Any]:
        """Return a measurement as keywords of `update`."""
        if name == "gnss":
            return self._fix(stream, k)
        value = stream.values[{"camera": "pixels"}.get(name, name)][k]
        if name == "camera":
            return {"pixels": value}
        if not np.isfinite(value).all():
            return {}
        if name == "barometer":
            if math.isnan(self.pressure_level):  # relative to the height of the vehicle
                self.pressure_level = float(value - self.filter.position[2])
            return {"barometer": float(value - self.pressure_level)}
        return {name: value}

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
                vector = values[k] if frame == "G" else self.R_GI @ values[k]
                from_center = frame == "G" and quantity == "position"
                return vector - self.origin if from_center else vector
        return None

    def _add_noise(
        self, found: dict[str, Any], keyword: str, stream: Stream, name: str, k: int
    ) -> None:
        values = stream.values.get(name)
        if self.reported and values is not None and np.isfinite(values[k]).all():
            found[keyword] = values[k] if values.ndim > 1 else float(values[k])

    # ---- the start -----------------------------------------------------------------------------

    def _try_to_start(self, name: str, k: int) -> None:
        """Start with the first fix, and other measurements of the heading."""
        if name == "magnetometer":
            self.field = k
        if name != "gnss":
            return
        stream = self.streams["gnss"]
        fix = self._fix(stream, k)
        if "gnss_position_G" not in fix:
            return
        known = "gnss_baseline_G" in fix or {"heading", "course", "magnetometer"} & set(self.start)
        if not known and "magnetometer" in self.streams:
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
        time = float(stream.time[k])
        self.filter.initialize(**{**fix, **self.start, "time": time})
        self._go_on()

    def _start_from_state(self) -> None:
        """Start from the state that the caller gives."""
        state = {"time": float(self.log.imu.time[0]), **self.start}
        if not {"R_BI", "covariance"} & set(state):
            check.keywords(state, ("position", "heading", "time"), "a start at a position")
            if "heading" not in state:
                raise ValueError(
                    "start must have a heading in addition to the position, or all keywords of "
                    "set_state"
                )
            state = state_at_rest(self.suite, **state)
        try:
            self.filter.set_state(**state)
        except TypeError as error:
            raise ValueError(f"start must be the keywords of set_state: {error}") from None
        self._go_on()

    def _go_on(self) -> None:
        """Process the samples since the time of the start."""
        self.running, begin = True, self.filter.time
        for i in self.held:
            if self.log.imu.time[i] > begin + SAME_TIME:
                self._predict(i)
            else:
                self.before = i
        self.held = []

    # ---- results -------------------------------------------------------------------------------

    def _keep_row(self) -> None:
        """Store the estimate before the next sample arrives."""
        f = self.filter
        if not self.running:
            return
        self.rows.append(
            (
                f.time,
                f.position,
                f.velocity,
                f.R_BI,
                f.accel_bias,
                f.gyro_bias,
                np.sqrt(np.diag(f.covariance)),
                f.heading_known,
                f.diverged,
            )
        )

    def _result(self) -> Replay:
        time, r, v, R, b_a, b_g, sigma, known, diverged = (
            np.array(column) for column in zip(*self.rows, strict=True)
        )
        return Replay(
            estimator=self.estimator,
            sensors=self.suite,
            time=time,
            position=r,
            velocity=v,
            quaternion=dcm_to_quaternion(R),
            accel_bias=b_a,
            gyro_bias=b_g,
            sigma=sigma,
            heading_known=known,
            diverged=diverged,
            status=self.filter.status,
            measured=_measured(self.suite, self.reports),
            too_late=self.too_late,
            unused=self.unused,
        )


def _measured(
    suite: SensorSuite, reports: list[tuple[float, float, Innovations]]
) -> dict[str, Measured]:
    """Return innovations by kind of measurement, for the kinds that occurred."""
    if not reports:
        return {}
    time, received = (np.array([report[k] for report in reports]) for k in (0, 1))
    innovation, sigma, nis, gate = (
        np.array([getattr(report[2], name) for report in reports]) for name in Innovations._fields
    )
    found = {}
    for row, block in enumerate(blocks_of(suite)):
        have, freedoms = np.isfinite(gate[:, row]), FREEDOMS[block]
        if have.any():
            found[_name_of(block)] = Measured(
                time[have],
                received[have],
                innovation[have, row, :freedoms],
                sigma[have, row, :freedoms],
                nis[have, row],
                gate[have, row],
            )
    return found


def _name_of(block: int) -> str:
    """Return the name of a block of innovations."""
    if block < FEATURE_BLOCKS:
        return ("gnss_position", "gnss_baseline", "gnss_velocity")[block]
    if block >= AID_BLOCKS:
        return Aid(block - AID_BLOCKS).name.lower()
    return f"feature_{block - FEATURE_BLOCKS}"
