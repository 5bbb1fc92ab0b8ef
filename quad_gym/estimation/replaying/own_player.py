"""A user's estimator that processes a log, in ticks of constant length."""

from collections import deque
from types import SimpleNamespace
from typing import Any

import numpy as np

from quad_gym.estimation.filtering.samples import Measurement
from quad_gym.estimation.logs import Floats
from quad_gym.estimation.own import Estimator, checked_estimate, factors, own_copy
from quad_gym.estimation.replaying.collecting import name_of
from quad_gym.estimation.replaying.player import Player
from quad_gym.estimation.replaying.results import Measured, Replay
from quad_gym.packing.aids import blocks_of
from quad_gym.params.vehicle import VehicleParams
from quad_gym.records import (
    AID_MOST,
    FREEDOMS,
    Aid,
    FilterStatus,
)
from quad_gym.records.inputs import SAME_TIME
from quad_gym.records.reading import SensorReading
from quad_gym.records.state import State
from quad_gym.rotations import dcm_to_quaternion

EVERYONE = np.ones(1, bool)
_OF_GNSS = {
    "gnss_position": "position_G",
    "gnss_baseline": "baseline_G",
    "gnss_velocity": "velocity_G",
}
"""Readings of GNSS, and their values in a `Measurement`."""


class OwnPlayer:
    """Processes the contents of a log with a user's estimator, in the order of arrival.

    A tick, of the suite's IMU, has the mean of the log's samples over it, and the measurements that
    have arrived since the tick before, one of each sensor at most. The start is the built-in
    filter's.

    Args:
        player: A player of the log with a built-in filter.
        estimator: The estimator, of which a copy is used.
    """

    def __init__(self, player: Player, estimator: Estimator) -> None:
        self._player, self._suite = player, player.suite
        self._name, self._estimator = type(estimator).__name__, own_copy(estimator)
        self._estimator.state = State(1, estimator.state)
        self._estimator.state.lock(False)
        self._arrived: dict[int, list[tuple[float, float]]] = {}  # stamps and arrivals by block
        self._has = dict.fromkeys(("pixels", *(aid.name.lower() for aid in Aid)), False)
        suite, gnss = player.suite, player.suite.gnss
        self._has |= {aid.name.lower(): True for aid in suite.aids}
        self._has |= {"pixels": suite.camera is not None, "gnss_position": gnss is not None}
        self._has["gnss_baseline"] = gnss is not None and gnss.has_baseline
        self._has["gnss_velocity"] = player.measured.takes_velocity
        self._vehicle = VehicleParams(gravity=suite.estimator.gravity)
        features = () if suite.camera is None else suite.camera.features_I
        self._features = np.array(features, np.float64).reshape(1, -1, 3)

    def play(self) -> Replay:
        """Estimate along the whole log."""
        player, dt = self._player, self._suite.imu.dt
        player.start.tilted = False  # an estimator of a user's knows no unknown heading
        player.write_tape()
        kf = player.filter
        if not kf.heading_known:
            raise ValueError(
                "start must have a heading, or the log a baseline or a magnetometer, for an "
                "estimator of your own (--heading)"
            )
        begin, imu = kf.time, player.log.imu
        count = 1 + int((imu.time[-1] - begin) / dt + SAME_TIME)
        times = np.asarray(begin + dt * np.arange(count), np.float64)
        gyro, accel = (self._means(imu.values[name], times) for name in ("gyro", "accel"))
        last = np.searchsorted(imu.time, times + SAME_TIME, "right") - 1
        now = imu.values["gyro"][np.maximum(last, 0)]
        names = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias", "covariance")
        start = {name: np.array(getattr(kf, name))[np.newaxis] for name in names}
        view = self._at(0.0, gyro[0], accel[0], now[0], {}, **start)
        given = self._estimator.reset(view, EVERYONE)
        rows = [self._row("reset", start if given is None else given)]
        waiting = self._arrivals(begin)
        for k in range(1, len(times)):
            readings = self._readings(waiting, times[k])
            view = self._at(times[k] - begin, gyro[k - 1], accel[k - 1], now[k], readings)
            rows.append(self._row("update", self._estimator.update(view)))
        return self._result(times, rows)

    def _means(self, values: Floats, times: Floats) -> Floats:
        """Return the means of the IMU's samples between successive times, (n, 3)."""
        stamps = self._player.log.imu.time
        held = values[1:] if self._player.averages else values[:-1]
        integral = np.zeros_like(values)
        integral[1:] = np.cumsum(held * np.diff(stamps)[:, np.newaxis], axis=0)
        at = np.stack([np.interp(times, stamps, column) for column in integral.T], axis=1)
        means = np.diff(at, axis=0) / self._suite.imu.dt
        return means if len(means) else values[:1]

    def _arrivals(self, begin: float) -> deque[tuple[float, float, str, int]]:
        """Return arrivals, time stamps, sensors and places of the measurements after the start."""
        found = []
        for name, stream in self._player.streams.items():
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
            player, age = self._player, max(now - stamp, 0.0)
            measurement = player.measured.at(name, k)
            if measurement is not None and age <= player.window + self._suite.imu.dt:
                found |= self._by_name(measurement, age)
                for block in measurement.blocks:
                    self._arrived.setdefault(block, []).append((stamp, received))
        waiting.extendleft(reversed(later))
        return found

    def _by_name(self, given: Measurement, age: float) -> dict[str, SensorReading]:
        """Return a measurement as readings, by their names."""
        found, R_IG = {}, self._player.measured.R_GI.T
        for name, key in _OF_GNSS.items():
            value = getattr(given, key)
            if value is not None:
                if name == "gnss_baseline":  # has any length
                    assert self._suite.gnss is not None
                    length = np.linalg.norm(self._suite.gnss.baseline_B)
                    value = value * (length / np.linalg.norm(value))
                found[name] = SensorReading((R_IG @ value)[np.newaxis], EVERYONE, age)
        if given.pixels is not None:
            seen = np.asarray(~np.isnan(given.pixels).any(axis=1))
            found["pixels"] = SensorReading(given.pixels[np.newaxis], seen[np.newaxis], age)
        for aid, value in given.aids.items():
            new = (
                ~np.isnan(value[:, 0]) if AID_MOST[aid] == 1 else ~np.isnan(value[np.newaxis, :, 0])
            )
            one = np.reshape(value, (1, *self._suite.aids[aid].shape))
            found[aid.name.lower()] = SensorReading(one.copy(), new, age)
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
        count = self._features.shape[1]
        shapes: dict[str, tuple[int, ...]] = {"pixels": (1, count, 2)}
        shapes |= dict.fromkeys(_OF_GNSS, (1, 3))
        several = {"pixels": count}
        for aid in Aid:
            name, params = aid.name.lower(), self._suite.aids.get(aid)
            shapes[name] = (1,) if params is None else (1, *params.shape)
            if params is not None and params.most_blocks > 1:
                several[name] = params.blocks
        for name, shape in shapes.items():
            if name not in readings:
                new = np.zeros((1, several[name]) if name in several else 1, bool)
                start[name] = (
                    SensorReading(np.full(shape, np.nan), new, 0.0) if self._has[name] else None
                )
        return SimpleNamespace(
            count=1,
            dt=self._suite.imu.dt,
            sensors=self._suite,
            vehicle=self._vehicle,
            ground_height=self._suite.estimator.ground_height,
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
        method = f"{self._name}.{method}"
        found = checked_estimate(method, given, 1, EVERYONE)
        sigma = np.full(15, np.nan)
        if "covariance" in found:
            factors(method, found["covariance"], EVERYONE)
            sigma = np.sqrt(np.diag(found["covariance"][0]))
        zero = np.zeros((1, 3))
        names = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias")
        return np.concatenate([*(found.get(name, zero).ravel() for name in names), sigma])

    def _result(self, times: Floats, rows: list[Floats]) -> Replay:
        r, v, R, b_a, b_g, sigma = np.split(np.array(rows), np.cumsum((3, 3, 9, 3, 3)), axis=1)
        everywhere = np.ones(len(times), bool)
        return Replay(
            estimator=self._name,
            sensors=self._suite,
            time=times,
            position=r,
            velocity=v,
            quaternion=dcm_to_quaternion(R.reshape(-1, 3, 3)),
            accel_bias=b_a,
            gyro_bias=b_g,
            sigma=sigma,
            heading_known=everywhere,
            diverged=~everywhere,
            status=FilterStatus(0),
            measured=self._measured(),
            late={},
            unused=self._player.unused,
        )

    def _measured(self) -> dict[str, Measured]:
        """Return times of the measurements, by kind; their innovations are unknown."""
        found = {}
        for block in blocks_of(self._suite):
            if block in self._arrived:
                stamps = np.array(self._arrived[block])
                unknown = np.full((len(stamps), FREEDOMS[block]), np.nan)
                none = np.zeros(len(stamps))
                times = stamps[:, 0], stamps[:, 1]
                found[name_of(block)] = Measured(*times, unknown, unknown, unknown[:, 0], none)
        return found
