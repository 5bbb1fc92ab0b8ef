"""Logs of simulated flights as CSV and ULog, as a recorder on board would write them. IMU samples
have irregular times (means over one to three ticks). Measurements have correct time stamps, and
arrive with a jitter in addition to their latency. Some of both are lost."""

import csv
import struct

import numpy as np

import quad_gym
from baselines import PDPolicy
from quad_gym import FlightRecorder
from quad_gym.envs.single import QuadEnv
from quad_gym.frames import ecef_to_enu, ecef_to_geodetic
from quad_gym.logs.formats.log import LOG_COLUMNS
from quad_gym.records import AID_BLOCK, AID_BLOCKS
from quad_gym.rotations import quaternion_to_dcm

RTK = quad_gym.sensor_suite("rtk")
PX4 = RTK.replace(
    camera=None, barometer=quad_gym.BarometerParams(), magnetometer=quad_gym.MagnetometerParams()
)
"""Sensors in a log of PX4, and two antennas."""
LOST, JITTER = 0.01, 0.05


def flown(suite=RTK, seconds=10.0, seed=5, task="circle", **options):
    """A flight under PD control on the estimate, with a row per IMU sample.

    Its `about` has measurements of aiding sensors (n, 2, 3), NaN where there is none, and the
    voltages (n, 4) over the tick before each row.
    """
    rate = suite.imu.rate
    env = QuadEnv(task, sensors=suite, control_rate=rate, duration=seconds, **options)
    policy, recorder = PDPolicy(env), FlightRecorder(env.flights.batch)
    observation, _ = env.reset(seed=seed)
    recorder.keep()
    aids, voltages = [], []

    def keep_aids():
        batch = env.flights.batch
        fresh = (batch.record("block_fresh") + batch.record("block_valid"))[0, AID_BLOCKS:] > 0.0
        voltages.append(batch.record("voltages")[0].copy())
        aids.append(
            np.where(fresh[:, np.newaxis], batch.record("measurement")[0, AID_BLOCKS:], np.nan)
        )

    keep_aids()
    for _ in range(round(seconds * rate)):
        observation, _, terminated, _, _ = env.step(policy.predict(observation)[0])
        recorder.keep()
        keep_aids()
        if terminated:  # a crash, where the filter of a suite is poor
            break
    recorder.flight.about.update(aids=np.array(aids), voltages=np.array(voltages))
    return recorder.flight


class Recorded:
    """Recording of a flight: (time, received, values) of each sensor."""

    def __init__(self, flight, suite=RTK, seed=0, *, lost=LOST, jitter=JITTER, max_ticks=3):
        rng, time = np.random.default_rng(seed), flight["time"]
        self.suite, self.flight = suite, flight
        ends = np.cumsum(rng.integers(1, max_ticks + 1, len(time)))
        ends = ends[ends < len(time)]
        starts = np.concatenate([[0], ends[:-1]])
        self.imu = []
        for a, b in zip(starts, ends, strict=True):  # row k: the mean over tick k
            if rng.random() >= lost:
                means = [flight[name][a + 1 : b + 1].mean(axis=0) for name in ("gyro", "accel")]
                self.imu.append((time[b], time[b], np.concatenate(means)))

        def measured(names, latency):
            found = []
            for k in range(len(time)):
                values = {name: flight[name][k] for name in names}
                if not any(np.isfinite(v).any() for v in values.values()):
                    continue
                if k and rng.random() < lost:
                    continue
                late = latency if k else 0.0  # the first ones have no latency
                arrival = time[k] + (rng.uniform(0.0, jitter) if k else 0.0)
                found.append((time[k] - late, arrival, values))
            return found

        self.gnss = measured(
            ("gnss_position", "gnss_baseline", "gnss_velocity"),
            suite.gnss.latency if suite.gnss else 0.0,
        )
        self.aids = []
        for aid, params in suite.aids.items():
            found, latency, row = [], params.latency, AID_BLOCK[aid] - AID_BLOCKS
            values = flight.about["aids"][:, row : row + params.blocks, : params.length]
            for k in np.flatnonzero(np.isfinite(values).any(axis=(1, 2))):
                if k == 0 or rng.random() >= lost:
                    arrival = time[k] + (rng.uniform(0.0, jitter) if k else 0.0)
                    stamp = time[k] - (latency if k else 0.0)
                    found.append((stamp, arrival, values[k].ravel()))
            self.aids.append(found)
        self.camera = measured(("pixels",), suite.camera.latency if suite.camera else 0.0)

    def table(self):
        """Columns with a row per sample or measurement, in the order of arrival."""
        features = self.flight["pixels"].shape[1]
        names = ["time", "received", *(f"{s}_{a}" for s in ("gyro", "accel") for a in "xyz")]
        for quantity in ("gnss", "gnss_baseline", "gnss_velocity"):
            names += [f"{quantity}_{axis}" for axis in ("east", "north", "up")]
        names += [f"pixel_{i}_{axis}" for i in range(features) for axis in "uv"]
        aids = {
            aid: LOG_COLUMNS[aid.name.lower()].names[: params.blocks * params.length]
            for aid, params in self.suite.aids.items()
        }
        names += [name for aid in self.suite.aids for name in aids[aid]]
        rows = []

        def add(time, received, values):
            row = dict.fromkeys(names, np.nan) | {"time": time, "received": received} | values
            rows.append(list(row.values()))

        for time, received, values in self.imu:
            add(time, received, dict(zip(names[2:8], values, strict=True)))
        for time, received, values in self.gnss:
            numbers = np.concatenate([values[n] for n in values])
            order = [*names[8:11], *names[11:14], *names[14:17]]
            add(time, received, dict(zip(order, numbers, strict=True)))
        for time, received, values in self.camera:
            add(time, received, dict(zip(names[17:], values["pixels"].ravel(), strict=True)))
        for aid, found in zip(self.suite.aids, self.aids, strict=True):
            for time, received, values in found:
                add(time, received, dict(zip(aids[aid], values, strict=True)))
        table = np.array(rows)
        table = table[np.argsort(table[:, 1], kind="stable")]
        return {name: table[:, i] for i, name in enumerate(names)}

    def write_csv(self, file):
        table = self.table()
        with file.open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(table)
            for row in zip(*table.values(), strict=True):
                writer.writerow(["" if np.isnan(x) else repr(float(x)) for x in row])

    def write_ulog(self, file, boot=12.0):
        """Write a ULog file, without camera and baselines, which PX4 does not log."""
        flu = np.array([1.0, -1.0, -1.0])
        us = lambda t: round(1e6 * (t + boot))  # noqa: E731
        origin = np.array(self.suite.gnss.reference_antenna_G)
        R_GI = ecef_to_enu(origin).T
        ulog = ULogWriter(file)
        imu = ulog.topic("sensor_combined", _SENSOR_COMBINED)
        gps = ulog.topic("vehicle_gps_position", _GPS)
        for time, _, values in self.imu:
            ulog.add(us(time), imu, us(time), *(values[:3] * flu), 0, 0, *(values[3:] * flu), 0)
        for time, received, values in self.gnss:
            lat, lon, height = ecef_to_geodetic(origin + R_GI @ values["gnss_position"])
            e, n, u = values["gnss_velocity"]
            sigma = self.suite.gnss.position_sigma_I
            place = (np.degrees(lat), np.degrees(lon), height)
            accuracy = (sigma[0], sigma[2], self.suite.gnss.velocity_sigma)
            times = (us(received), us(time))
            ulog.add(us(received), gps, *times, *place, *accuracy, n, e, -u, 3, True)
        if self.aids:
            air, compass = (
                ulog.topic(n, f)
                for n, f in (("vehicle_air_data", _AIR), ("vehicle_magnetometer", _MAG))
            )
            for time, received, values in self.aids[0]:  # above the sea, not above the origin
                ulog.add(us(received), air, us(received), us(time), values[0] + 213.0)
            for time, received, values in self.aids[1]:
                gauss = 1e4 * values * flu
                ulog.add(us(received), compass, us(received), us(time), *gauss)
        ulog.write()


_SENSOR_COMBINED = (
    "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;"
    "uint32_t accelerometer_integral_dt;"
)
_GPS = (
    "uint64_t timestamp;uint64_t timestamp_sample;double latitude_deg;double longitude_deg;"
    "double altitude_ellipsoid_m;float eph;float epv;float s_variance_m_s;"
    "float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;bool vel_ned_valid;"
)
_AIR = "uint64_t timestamp;uint64_t timestamp_sample;float baro_alt_meter;"
_MAG = "uint64_t timestamp;uint64_t timestamp_sample;float[3] magnetometer_ga;"
_CODES = {"uint64_t": "Q", "uint32_t": "I", "int32_t": "i", "uint8_t": "B", "bool": "?"}
_CODES |= {"double": "d", "float": "f"}


class ULogWriter:
    """Writer of PX4's log files; see "ULog File Format" in its user guide."""

    def __init__(self, file):
        self.file, self.packers, self.data = file, [], []
        self.head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
        self.head += self.message("B", bytes(40))

    @staticmethod
    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    def topic(self, name, fields, instance=0):
        """Define and subscribe to a topic; return its number."""
        number, codes = len(self.packers), "<"
        for item in fields.rstrip(";").split(";"):
            kind, count = item.split()[0], 1
            if kind.endswith("]"):
                kind, count = kind.rstrip("]").split("[")
            codes += _CODES[kind] * int(count)
        self.packers.append(struct.Struct(codes))
        if not instance:
            self.head += self.message("F", f"{name}:{fields}".encode())
        subscription = struct.pack("<BH", instance, number) + name.encode()
        self.data.append((-1, self.message("A", subscription)))
        return number

    def add(self, stamp, number, *values):
        content = struct.pack("<H", number) + self.packers[number].pack(*values)
        self.data.append((stamp, self.message("D", content)))

    def write(self):
        in_order = sorted(self.data, key=lambda entry: entry[0])
        self.file.write_bytes(self.head + b"".join(message for _, message in in_order))


def errors_in_flight(recorded, k):
    """Errors (n, 9) of position, velocity and attitude of the filter in flight, at rows `k`."""
    f = recorded.flight
    words = ("position", "velocity", "quaternion")
    return _errors(f, k, *(f[f"estimated_{word}"][k] for word in words))


def errors_in_replay(recorded, result, k):
    """Errors (n, 9) of a replay, whose rows are the rows `k` of the flight."""
    return _errors(recorded.flight, k, result.position, result.velocity, result.quaternion)


def _errors(flight, k, position, velocity, attitude):
    turned = quaternion_to_dcm(flight["quaternion"][k]) @ quaternion_to_dcm(attitude).swapaxes(1, 2)
    angles = 0.5 * np.stack(
        [
            turned[:, 1, 2] - turned[:, 2, 1],
            turned[:, 2, 0] - turned[:, 0, 2],
            turned[:, 0, 1] - turned[:, 1, 0],
        ],
        axis=1,
    )
    r, v = flight["position"][k] - position, flight["velocity"][k] - velocity
    return np.hstack([r, v, angles])
