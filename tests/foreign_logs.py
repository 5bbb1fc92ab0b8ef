"""A simulated flight, independent of the package, and its logs in the formats of others.

The vehicle rests, takes off, and flies figures of eight with a turning nose. Bodies are forward,
left, up; the world is east, north, up.
"""

import struct
from dataclasses import dataclass, field

import numpy as np

from tests.logged_flights import ULogWriter

LAT, LON, HEIGHT = 47.0, 8.0, 450.0
BOOT = 20.0  #: clock of the autopilot at the start of the flight [s]
EPOCH = 1.7e9  #: clock of ROS at the start of the flight [s]
FLU = np.array([1.0, -1.0, -1.0])
_A, _E2 = 6378137.0, 0.00669437999014


def _ecef(lat, lon, height):
    lat, lon = np.radians(lat), np.radians(lon)
    n = _A / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    level = (n + height) * np.cos(lat)
    up = (n * (1.0 - _E2) + height) * np.sin(lat)
    return np.stack([level * np.cos(lon), level * np.sin(lon), up], -1)


def geodetic(places):
    """Latitude, longitude [deg] and height of places (n, 3) in I, by iteration."""
    a, b = np.radians(LAT), np.radians(LON)
    R = np.array(
        [
            [-np.sin(b), np.cos(b), 0.0],
            [-np.sin(a) * np.cos(b), -np.sin(a) * np.sin(b), np.cos(a)],
            [np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)],
        ]
    )
    lat, lon, height = (np.full(len(places), x) for x in (LAT, LON, HEIGHT))
    origin = _ecef(LAT, LON, HEIGHT)
    for _ in range(5):
        missing = places - (_ecef(lat, lon, height) - origin) @ R.T
        lat = lat + np.degrees(missing[:, 1] / 6.36e6)
        lon = lon + np.degrees(missing[:, 0] / (6.39e6 * np.cos(a)))
        height = height + missing[:, 2]
    return lat, lon, height


@dataclass
class Flight:
    """Measurements of a flight, and its truth at the samples of the IMU."""

    time: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    position: np.ndarray
    fix_time: np.ndarray
    fixes: np.ndarray
    velocities: np.ndarray
    baro_time: np.ndarray
    heights: np.ndarray
    fields: np.ndarray
    lla: tuple = field(default=())

    def table(self):
        """Columns with a row per sample or measurement, in the order of time."""
        parts = [
            {"time": self.time, "gyro": self.gyro, "accel": self.accel},
            {"time": self.fix_time, "gnss_enu": self.fixes, "gnss_velocity_enu": self.velocities},
            {"time": self.baro_time, "barometer": self.heights, "magnetometer": self.fields},
        ]
        count = sum(len(part["time"]) for part in parts)
        found, row = {}, 0
        for part in parts:
            for name, values in part.items():
                shape = (count, *values.shape[1:])
                found.setdefault(name, np.full(shape, np.nan))[row : row + len(values)] = values
            row += len(part["time"])
        order = np.argsort(found["time"], kind="stable")
        return {name: values[order] for name, values in found.items()}

    def errors(self, result, clock=0.0):
        """Errors (n, 3) of the positions of a replay."""
        t = result.time - clock
        truth = np.column_stack([np.interp(t, self.time, axis) for axis in self.position.T])
        return result.position - truth


def flight(seconds=14.0, seed=0, rest=3.0):
    """Simulate a flight with an IMU at 50 Hz, GNSS at 5 Hz, barometer and compass at 20 Hz."""
    rng, rate, fine = np.random.default_rng(seed), 50, 20
    h = 1.0 / (rate * fine)
    t = np.arange(int(seconds * rate * fine) + 1) * h
    s = np.clip((t - rest) / 4.0, 0.0, 1.0)
    s = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    phase = np.cumsum(s) * h * 0.5
    p = np.stack([6 * np.sin(phase), 6 * np.sin(phase) * np.cos(phase), 8 * s], 1)
    v = np.gradient(p, h, axis=0)
    f = np.gradient(v, h, axis=0) + np.array([0.0, 0.0, 9.80665])
    yaw = 0.3 + 0.15 * np.cumsum(s) * h
    z = f / np.linalg.norm(f, axis=1, keepdims=True)
    y = np.cross(z, np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], 1))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    R = np.stack([np.cross(y, z), y, z], 1)  # rows: body axes in I
    ticks = R[::fine]
    D = np.einsum("nij,nkj->nik", ticks[:-1], ticks[1:])
    turn = np.stack([D[:, 2, 1] - D[:, 1, 2], D[:, 0, 2] - D[:, 2, 0], D[:, 1, 0] - D[:, 0, 1]], 1)
    sine = 0.5 * np.linalg.norm(turn, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(D, axis1=1, axis2=2) - 1.0))
    gyro = 0.5 * turn * (angle / np.maximum(sine, 1e-12))[:, np.newaxis] * rate
    force = np.einsum("nij,nj->ni", R, f)[:-1].reshape(-1, fine, 3).mean(1)
    slow, often = np.arange(0, len(t), 200), np.arange(0, len(t), 50)
    normal = rng.normal
    found = Flight(
        time=t[fine::fine],
        gyro=gyro + normal(0, 0.002, gyro.shape) + normal(0, 0.0008, 3),
        accel=force + normal(0, 0.05, force.shape) + normal(0, 0.05, 3),
        position=p[fine::fine],
        fix_time=t[slow],
        fixes=p[slow] + normal(0, 1, (len(slow), 3)) * [0.2, 0.2, 0.4],
        velocities=v[slow] + normal(0, 0.05, (len(slow), 3)),
        baro_time=t[often],
        heights=p[often, 2] + normal(0, 0.1, len(often)),
        fields=R[often] @ [1.0e-6, 21.5e-6, -43.0e-6] + normal(0, 3e-7, (len(often), 3)),
    )
    found.lla = geodetic(found.fixes)
    return found


def pressure(height):
    """Pressure [Pa] of the standard atmosphere, at a height above the start."""
    return 101325.0 * (1.0 - 2.25577e-5 * (height + HEIGHT)) ** 5.25588


# ---- ArduPilot -----------------------------------------------------------------------------------

LAYOUTS = {
    "IMU": (131, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "GPS": (132, "QBBLLeffff", "TimeUS,I,Status,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw"),
    "BARO": (134, "QBff", "TimeUS,I,Alt,Press"),
    "MAG": (135, "QBhhh", "TimeUS,I,MagX,MagY,MagZ"),
    "PARM": (136, "QNf", "TimeUS,Name,Value"),
}
OLD_LAYOUTS = {  # before 2015
    "IMU": (131, "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "GPS": (130, "BIHLLefffI", "Status,TimeMS,Week,Lat,Lng,Alt,Spd,GCrs,VZ,T"),
    "BARO": (136, "Iff", "TimeMS,Alt,Press"),
    "MAG": (135, "Ihhh", "TimeMS,MagX,MagY,MagZ"),
}
_CODES = {"N": "16s", "L": "i", "e": "i", "n": "4s", "Z": "64s"}
_SCALES = {"L": 1e7, "e": 1e2}


def ardupilot_rows(f, old=False, delay=0.2):
    """Rows (time [s], message, values) of a flight; the values lack the time."""
    rows = []
    for t, g, a in zip(f.time, f.gyro, f.accel, strict=True):
        rows.append([t, "IMU", [*([] if old else [0]), *(g * FLU), *(a * FLU)]])
    for k, t in enumerate(f.fix_time):
        e, n, u = f.velocities[k]
        lat, lon, height = (axis[k] for axis in f.lla)
        speed, course = np.hypot(e, n), np.degrees(np.arctan2(e, n)) % 360.0
        if old:
            week = [3, int(1e3 * t) + 302400000, 1820]
            rows.append([t + delay, "GPS", [*week, lat, lon, height, speed, course, -u]])
        else:
            rows.append([t + delay, "GPS", [0, 3, lat, lon, height, speed, course, -u, 0.0]])
    for t, height, m in zip(f.baro_time, f.heights, f.fields, strict=True):
        number = [] if old else [0]
        rows.append([t, "BARO", [*number, height, pressure(height)]])
        rows.append([t, "MAG", [*number, *(round(x) for x in 1e7 * m * FLU)]])
    return sorted(rows, key=lambda row: row[0])


def write_dataflash(path, rows, layouts=None, parameters=()):
    """Write ArduPilot's self-describing format."""
    layouts, out, packers = layouts or LAYOUTS, bytearray(), {}
    known = {"FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"), **layouts}
    for name, (number, kinds, fields) in known.items():
        packer = struct.Struct("<" + "".join(_CODES.get(c, c) for c in kinds))
        words = [word.encode() for word in (name, kinds, fields)]
        out += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, packer.size + 3, *words)
        packers[name] = number, kinds, packer, fields.split(",")
    listed = [(-BOOT, "PARM", [name.encode(), value]) for name, value in parameters]
    for t, name, given in [*listed, *rows]:
        number, kinds, packer, fields = packers[name]
        values = list(given)
        unit = 1e3 if "TimeMS" in fields else 1e6
        place = fields.index("T") if "T" in fields else fields.index(fields[0])
        values.insert(place, round(unit * (t + BOOT)))
        scaled = (
            round(_SCALES[c] * v) if c in _SCALES else v for c, v in zip(kinds, values, strict=True)
        )
        out += b"\xa3\x95" + bytes([number]) + packer.pack(*scaled)
    path.write_bytes(out)


# ---- PX4 -----------------------------------------------------------------------------------------


def write_px4(path, f, fields=(None,), parameters=(), ellipsoid=True, combined=False):
    """Write a ULog with a compass for each of `fields` (None: the flight's)."""
    ulog = ULogWriter(path)
    for name, value in parameters:
        key = f"int32_t {name}".encode()
        ulog.head += ulog.message("P", bytes([len(key)]) + key + struct.pack("<i", value))
    us = lambda t: round(1e6 * (t + BOOT))  # noqa: E731
    extra = "float[3] magnetometer_ga;float baro_alt_meter;" if combined else ""
    inertial = "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;"
    imu = ulog.topic("sensor_combined", inertial + extra)
    gps = ulog.topic(
        "vehicle_gps_position",
        "uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
        "float s_variance_m_s;float eph;float epv;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;"
        "uint8_t fix_type;bool vel_ned_valid;",
    )
    for t, g, a in zip(f.time, f.gyro, f.accel, strict=True):
        nearest = int(np.argmin(np.abs(f.baro_time - t)))
        more = [*(1e4 * f.fields[nearest] * FLU), f.heights[nearest] + 430.0] if combined else []
        ulog.add(us(t), imu, us(t), *(g * FLU), *(a * FLU), *more)
    for k, t in enumerate(f.fix_time):
        (e, n, u), (lat, lon, height) = f.velocities[k], (axis[k] for axis in f.lla)
        place = (round(1e7 * lat), round(1e7 * lon), round(1e3 * height) - 47000)
        filled = round(1e3 * height) if ellipsoid else 0
        r = us(t + 0.11)
        ulog.add(r, gps, r, *place, filled, 0.1, 0.5, 0.8, n, e, -u, 3, True)
    if not combined:
        air = ulog.topic("vehicle_air_data", "uint64_t timestamp;float baro_alt_meter;")
        for t, height in zip(f.baro_time, f.heights, strict=True):
            ulog.add(us(t), air, us(t), height + 430.0)
        layout = "uint64_t timestamp;float[3] magnetometer_ga;"
        for instance, given in enumerate(fields):
            number = ulog.topic("vehicle_magnetometer", layout, instance)
            for t, m in zip(f.baro_time, f.fields if given is None else given, strict=True):
                ulog.add(us(t), number, us(t), *(1e4 * m * FLU))
    ulog.write()


# ---- ROS -----------------------------------------------------------------------------------------


class Bag:
    """Messages of a bag of ROS 1 or 2, with stamps in the UNIX epoch plus `clock` of a topic."""

    def __init__(self, version=1):
        from rosbags.typesys import Stores, get_typestore

        self.version, self.rows = version, []
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        self._count = 0

    def header(self, stamp):
        """Header with a stamp [s]; 0: never set."""
        self._count += 1
        ns = round(1e9 * stamp) if stamp else 0
        time = self.store.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        extra = {"seq": self._count} if self.version == 1 else {}
        return self.store.types["std_msgs/msg/Header"](stamp=time, frame_id="b", **extra)

    def vector(self, v):
        """Vector3 of three numbers."""
        kind = self.store.types["geometry_msgs/msg/Vector3"]
        return kind(*(float(x) for x in v))

    def add(self, topic, kind, recorded, stamp, *contents):
        """Add a message with a header, at a time of recording after the start of the epoch."""
        message = self.store.types[kind](self.header(stamp), *contents)
        self.rows.append((recorded, topic, kind, message))

    def imu(self, topic, f, gyro=True, accel=True, zeros=False, clock=EPOCH):
        """Add samples; of a half that was not measured, the covariance begins with -1."""
        still = self.store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        known, unknown = np.zeros(9), np.array([-1.0, *np.zeros(8)])
        for t, w, a in zip(f.time, f.gyro, f.accel, strict=True):
            w, a = w * (gyro and not zeros), a * (accel and not zeros)
            marks = (known if gyro else unknown, known if accel else unknown)
            contents = (still, known, self.vector(w), marks[0], self.vector(a), marks[1])
            self.add(topic, "sensor_msgs/msg/Imu", t, clock and clock + t, *contents)

    def fixes(self, topic, f, times=1, clock=EPOCH):
        """Add fixes, each as often as `times`."""
        status = self.store.types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
        variances = np.diag([0.04, 0.04, 0.16]).ravel()
        for k, t in enumerate(f.fix_time):
            place = [float(axis[k]) for axis in f.lla]
            for copy in range(times):
                contents = (status, *place, variances, 2)
                late = t + 0.1 + 0.01 * copy
                self.add(topic, "sensor_msgs/msg/NavSatFix", late, clock and clock + t, *contents)

    def velocities(self, topic, f, values=None, clock=EPOCH):
        """Add velocities of the receiver, or other ones."""
        twist = self.store.types["geometry_msgs/msg/Twist"]
        for t, v in zip(f.fix_time, f.velocities if values is None else values, strict=True):
            both = twist(self.vector(v), self.vector((0, 0, 0)))
            kind = "geometry_msgs/msg/TwistStamped"
            self.add(topic, kind, t + 0.1, clock and clock + t, both)

    def pressures(self, topic, f, values=None):
        """Add pressures [Pa], or other numbers."""
        given = pressure(f.heights) if values is None else values
        for t, p in zip(f.baro_time, given, strict=True):
            self.add(topic, "sensor_msgs/msg/FluidPressure", t, EPOCH + t, float(p), 0.0)

    def compass(self, topic, f):
        """Add magnetic fields."""
        for t, m in zip(f.baro_time, f.fields, strict=True):
            contents = (self.vector(m), np.zeros(9))
            self.add(topic, "sensor_msgs/msg/MagneticField", t, EPOCH + t, *contents)

    def write(self, path):
        """Write the file, or the folder of version 2."""
        from rosbags import rosbag1, rosbag2

        path.unlink(missing_ok=True)
        topics, first = {}, self.version == 1
        serialize = self.store.serialize_ros1 if first else self.store.serialize_cdr
        with rosbag1.Writer(path) if first else rosbag2.Writer(path, version=9) as writer:
            for recorded, topic, kind, message in sorted(self.rows, key=lambda row: row[0]):
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=self.store)
                time = round(1e9 * (EPOCH + recorded))
                writer.write(topics[topic], time, serialize(message, kind))
        return path
