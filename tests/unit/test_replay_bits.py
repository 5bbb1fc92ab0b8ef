"""A replay gives bit for bit what the filter gives when it is used sample by sample."""

import bisect
import dataclasses

import numpy as np
import pytest

from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter, read_log, replay
from quad_gym.params.portable import turned
from quad_gym.params.suites import CONSUMER
from quad_gym.rotations import dcm_to_quaternion
from tests.logged_flights import RTK, Recorded, flown

FILTERS = {"ukf": UnscentedKalmanFilter, "ekf": ExtendedKalmanFilter}
GNSS = {"position_I": "gnss_position_G", "velocity_I": "gnss_velocity_G"}


class SampleBySample:
    """A user's loop: predict with each sample, update with each measurement at its arrival."""

    def __init__(self, log, suite, estimator):
        self.log, self.suite = log, suite
        self.kf = FILTERS[estimator](suite)
        self.waiting, self.rows, self.updates = [], [], []

    def run(self):
        events = [
            (float(stream.received[k]), name != "imu", name, k)
            for name, stream in self.log.streams.items()
            for k in range(len(stream))
        ]
        started, held = False, []
        for _, _, name, k in sorted(events):
            if name != "imu" and not started:
                if name == "gnss":
                    fix = self.keywords(name, k)
                    heading = {} if "gnss_baseline_G" in fix else {"heading": 0.3}
                    self.kf.initialize(**fix, **heading, time=float(self.log.gnss.time[k]))
                    started = True
                    for i in held:
                        self.predict(i)
            elif name == "imu":
                if started:
                    self.keep()
                    self.predict(k)
                else:
                    held.append(k)
            else:
                self.measure(name, k)
        self.keep()

    def predict(self, k):
        imu = self.log.imu
        step = float(imu.time[k]) - self.kf.time
        if step > 1e-6:
            self.kf.predict(imu.values["gyro"][k], imu.values["accel"][k], dt=step)
        while self.waiting and self.waiting[0][0] <= self.kf.time + 1e-6:
            _, name, k = self.waiting.pop(0)
            self.measure(name, k)

    def measure(self, name, k):
        stamp = float(self.log.streams[name].time[k])
        if stamp > self.kf.time + 1e-6:
            bisect.insort(self.waiting, (stamp, name, k))
        elif stamp >= self.kf.oldest_time - 1e-6:
            self.kf.update(**self.keywords(name, k), time=min(stamp, self.kf.time))
            self.updates.append(self.kf.last_update)

    def keywords(self, name, k):
        values = self.log.streams[name].values
        if name == "camera":
            return {"pixels": values["pixels"][k]}
        if name != "gnss":
            return {name: values[name][k]}
        R_GI = self.kf._engine.params["R_IG"][0, ..., 0].T
        names = {**GNSS, "baseline_I": "gnss_baseline_G"}
        return {
            keyword: turned(R_GI, values[key][k])
            for key, keyword in names.items()
            if key in values and np.isfinite(values[key][k]).all()
        }

    def keep(self):
        kf = self.kf
        numbers = (kf.position, kf.velocity, dcm_to_quaternion(kf.R_BI), kf.accel_bias)
        sigma = np.sqrt(np.diag(kf.covariance))
        self.rows.append((kf.time, *numbers, kf.gyro_bias, sigma, kf.diverged))


NO_CAMERA = RTK.replace(camera=None)


@pytest.mark.parametrize(
    ("suite", "estimator"), [(RTK, "ukf"), (NO_CAMERA, "ekf"), (CONSUMER, "ukf")]
)
def test_replay_of_late_measurements_equals_the_filter(suite, estimator):
    """With irregular times, losses and jitter; innovations included."""
    table = Recorded(flown(suite, 4.0), suite).table()
    log = read_log({name: np.asarray(column, float) for name, column in table.items()})
    start = {} if suite.gnss.has_baseline else {"heading": 0.3}
    result = replay(log, sensors=suite, estimator=estimator, start=start)
    loop = SampleBySample(log, suite, estimator)
    loop.run()
    time, r, v, q, b_a, b_g, sigma, diverged = map(np.array, zip(*loop.rows, strict=True))
    for name, values in {
        "time": time,
        "position": r,
        "velocity": v,
        "quaternion": q,
        "accel_bias": b_a,
        "gyro_bias": b_g,
        "diverged": diverged,
    }.items():
        np.testing.assert_array_equal(getattr(result, name), values, err_msg=name)
    np.testing.assert_allclose(result.sigma, sigma, rtol=1e-12)  # summed in another order
    nis = np.array([update.nis[0] for update in loop.updates])
    np.testing.assert_array_equal(result.measured["gnss_position"].nis, nis[np.isfinite(nis)])
    assert np.isfinite(nis).sum() > 30


def test_unknown_zero_of_the_barometer_is_its_first_height():
    """An offset of all heights changes no estimate."""
    table = Recorded(flown(CONSUMER, 3.0), CONSUMER).table()
    log = read_log({name: np.asarray(column, float) for name, column in table.items()})
    coarse, found = np.round(256.0 * log.barometer.values["barometer"]) / 256.0, []
    for offset in (0.0, 64.0):
        barometer = dataclasses.replace(log.barometer, values={"barometer": coarse + offset})
        shifted = dataclasses.replace(log, barometer=barometer, barometer_from_start=True)
        found.append(replay(shifted, sensors=CONSUMER, start={"heading": 0.3}))
    np.testing.assert_allclose(found[1].position, found[0].position, atol=1e-9)
