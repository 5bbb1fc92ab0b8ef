"""Logs in other formats, written here, contain the values of the table."""

import struct
import sys

import numpy as np
import pytest

from quad_gym.estimation import read_log, replay
from quad_gym.frames import ecef_to_enu, ecef_to_geodetic
from tests.logged_flights import PX4, Recorded, flown

FLU = np.array([1.0, -1.0, -1.0])
BOOT = 12.0


@pytest.fixture(scope="module")
def recorded():
    return Recorded(flown(PX4, 3.0), PX4)


@pytest.fixture(scope="module")
def table(recorded):
    return read_log(recorded.table())


def geodetic(recorded):
    """Latitude, longitude [deg] and height of each fix."""
    origin = np.array(PX4.gnss.reference_antenna_G)
    for _, _, values in recorded.gnss:
        place = origin + ecef_to_enu(origin).T @ values["gnss_position"]
        lat, lon, height = ecef_to_geodetic(place)
        yield np.degrees(lat), np.degrees(lon), height


def check_imu(log, table, boot=0.0, atol=1e-6):
    np.testing.assert_allclose(log.imu.time - boot, table.imu.time, atol=2e-6)
    for name in ("gyro", "accel"):
        np.testing.assert_allclose(log.imu.values[name], table.imu.values[name], atol=atol)


def check_positions(log, table, atol):
    """Differences of positions, in ECEF and in I, have equal norms."""
    found, expected = log.gnss.values["position_G"], table.gnss.values["position_I"]
    found = found[np.isfinite(found).all(axis=1)]
    expected = expected[np.isfinite(expected).all(axis=1)]
    norms = (np.linalg.norm(p - p[0], axis=1) for p in (found, expected))
    np.testing.assert_allclose(*norms, atol=atol)


MESSAGES = {
    "IMU": (131, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "GPS": (132, "QBBIHLLeffff", "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw"),
    "GPA": (133, "QBfff", "TimeUS,I,HAcc,VAcc,SAcc"),
    "BARO": (134, "QBf", "TimeUS,I,Alt"),
    "MAG": (135, "QBhhh", "TimeUS,I,MagX,MagY,MagZ"),
    "PARM": (136, "QNf", "TimeUS,Name,Value"),
}
CODES = {"N": "16s", "L": "i", "e": "i"}
SCALES = {"L": 1e7, "e": 1e2}


def write_bin(file, recorded):
    """Write ArduPilot's self-describing format: FMT messages, then the others in order of time."""
    layouts = {"FMT": (128, "BBnNZ", None)}
    data = b""
    for name, (number, kinds, fields) in (layouts | MESSAGES).items():
        codes = "".join({"n": "4s", "Z": "64s", **CODES}.get(c, c) for c in kinds)
        packer = struct.Struct("<" + codes)
        fields = fields or "Type,Length,Name,Format,Columns"
        words = [w.encode() for w in (name, kinds, fields)]
        data += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, packer.size + 3, *words)
        layouts[name] = (number, kinds, packer)
    rows = []

    def add(name, time, *values):
        number, kinds, packer = layouts[name]
        values = [
            round(SCALES[c] * v) if c in SCALES else v
            for c, v in zip(kinds[1:], values, strict=True)
        ]
        us = round(1e6 * (time + BOOT))
        rows.append((us, b"\xa3\x95" + bytes([number]) + packer.pack(us, *values)))

    add("PARM", -BOOT, b"GPS_DELAY_MS", 100.0)
    for time, _, values in recorded.imu:
        add("IMU", time, 0, *(values[:3] * FLU), *(values[3:] * FLU))
        add("IMU", time, 1, *(9.0 * values))  # a second IMU
    for (_, received, values), place in zip(recorded.gnss, geodetic(recorded), strict=True):
        e, n, u = values["gnss_velocity"]
        course = np.degrees(np.arctan2(e, n)) % 360.0
        speed = (np.hypot(e, n), course, -u, 0.0)
        add("GPS", received, 0, 3, round(1e3 * received), 2300, *place, *speed)
        add("GPA", received, 0, 0.3, 0.6, 0.1)
    for time, _, value in recorded.aids[0]:
        add("BARO", time, 0, value[0])
    for time, _, value in recorded.aids[1]:
        add("MAG", time, 0, *(round(x) for x in 1e7 * value * FLU))
    file.write_bytes(data + b"".join(row for _, row in sorted(rows, key=lambda row: row[0])))


def test_ardupilot_log_has_the_values_of_the_table(recorded, table, tmp_path):
    pytest.importorskip("pymavlink")
    write_bin(tmp_path / "flight.bin", recorded)
    log = read_log(tmp_path / "flight.bin")
    check_imu(log, table, BOOT, atol=2e-6)
    check_positions(log, table, atol=0.03)
    speeds = (one.gnss.values["velocity_I"] for one in (log, table))
    np.testing.assert_allclose(*speeds, atol=1e-4)
    np.testing.assert_allclose(log.gnss.received - log.gnss.time, 0.1)
    np.testing.assert_allclose(log.gnss.values["position_sigma_I"][0], [0.3, 0.3, 0.6], rtol=1e-6)
    for sensor, atol in (("barometer", 1e-4), ("magnetometer", 1e-7)):  # in the order of time
        found, expected = getattr(log, sensor), getattr(table, sensor)
        order = np.argsort(expected.time)
        np.testing.assert_allclose(found.time - BOOT, expected.time[order], atol=2e-6)
        np.testing.assert_allclose(found.values[sensor], expected.values[sensor][order], atol=atol)
    assert len(replay(log, sensors=PX4, start={"heading": 0.0})) > 100


@pytest.mark.parametrize(
    ("name", "kind", "library"),
    [("some.bin", "a log of ArduPilot", "pymavlink"), ("some.bag", "a bag of ROS", "rosbags")],
)
def test_files_of_another_kind_are_refused(tmp_path, name, kind, library):
    pytest.importorskip(library)
    (tmp_path / name).write_bytes(bytes(1000))
    with pytest.raises(ValueError, match=f"{name} must be {kind}"):
        read_log(tmp_path / name)
    with pytest.raises(FileNotFoundError, match=r"none.bin"):
        read_log(tmp_path / "none.bin")


def write_bag(path, recorded, version):
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    types = store.types
    number = [0]

    def header(time):
        ns = round(1e9 * (time + BOOT))
        stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        number[0] += 1
        extra = {"seq": number[0]} if version == 1 else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="b", **extra)

    def vector(v):
        return types["geometry_msgs/msg/Vector3"](x=float(v[0]), y=float(v[1]), z=float(v[2]))

    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    unknown = np.zeros(9)
    rows = []
    for time, received, values in recorded.imu:
        message = types["sensor_msgs/msg/Imu"](
            header(time), turn, unknown, vector(values[:3]), unknown, vector(values[3:]), unknown
        )
        rows.append((received, "/imu/data", message))
    status = types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
    variances = np.diag([0.09, 0.09, 0.36]).ravel()
    for (time, received, values), place in zip(recorded.gnss, geodetic(recorded), strict=True):
        fix = types["sensor_msgs/msg/NavSatFix"](header(time), status, *place, variances, 2)
        twist = types["geometry_msgs/msg/Twist"](vector(values["gnss_velocity"]), vector([0] * 3))
        speed = types["geometry_msgs/msg/TwistStamped"](header(time), twist)
        rows += [(received, "/gps/fix", fix), (received, "/gps/vel", speed)]
    for time, received, value in recorded.aids[0]:
        pressure = 101325.0 * (1.0 - value[0] / 44330.77) ** (1.0 / 0.190263)
        air = types["sensor_msgs/msg/FluidPressure"](header(time), float(pressure), 0.0)
        rows.append((received, "/air", air))
    for time, received, value in recorded.aids[1]:
        field = types["sensor_msgs/msg/MagneticField"](header(time), vector(value), unknown)
        rows.append((received, "/mag", field))
    writer = rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=9)
    with writer:
        topics = {}
        for received, topic, message in sorted(rows, key=lambda row: row[0]):
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=store)
            serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr
            writer.write(topics[topic], round(1e9 * (received + BOOT)), serialize(message, kind))


@pytest.mark.parametrize(("version", "name"), [(1, "flight.bag"), (2, "flight")])
def test_ros_bag_has_the_values_of_the_table(recorded, table, tmp_path, version, name):
    pytest.importorskip("rosbags")
    write_bag(tmp_path / name, recorded, version)
    log = read_log(tmp_path / name)
    check_imu(log, table, BOOT, atol=1e-12)
    check_positions(log, table, atol=1e-6)
    speeds = log.gnss.values["velocity_I"]
    np.testing.assert_allclose(
        speeds[np.isfinite(speeds).all(axis=1)], table.gnss.values["velocity_I"], atol=1e-12
    )
    sigma = log.gnss.values["position_sigma_I"]
    np.testing.assert_allclose(sigma[np.isfinite(sigma).all(axis=1)][0], [0.3, 0.3, 0.6])
    for sensor in ("barometer", "magnetometer"):
        found, expected = getattr(log, sensor), getattr(table, sensor)
        np.testing.assert_allclose(found.values[sensor], expected.values[sensor], atol=1e-6)
        np.testing.assert_allclose(found.time - BOOT, expected.time, atol=2e-6)
        np.testing.assert_allclose(found.received - BOOT, expected.received, atol=2e-6)
    assert len(replay(log, sensors=PX4, start={"heading": 0.0})) > 100


@pytest.mark.parametrize(
    ("file", "library"), [("a.bin", "pymavlink.DFReader"), ("a.bag", "rosbags.highlevel")]
)
def test_missing_libraries_are_named(tmp_path, monkeypatch, file, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match="install it with pip install 'quad-gym"):
        read_log(tmp_path / file)


@pytest.mark.parametrize("up", ["z", "x"])
def test_euroc_folder_has_the_values_of_the_table(recorded, table, tmp_path, up):
    """The IMU is rotated. If x is up, the body is EuRoC's, with z forward."""
    R_BS = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    body = np.eye(3) if up == "z" else np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0]])
    for name in ("imu0", "leica0"):
        (tmp_path / "mav0" / name).mkdir(parents=True)
    T = np.eye(4)
    T[:3, :3] = R_BS
    numbers = ", ".join(f"{x}" for x in T.ravel())
    (tmp_path / "mav0/imu0/sensor.yaml").write_text(
        f"sensor_type: imu\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nrate_hz: 200\n"
    )

    def row(time, values):
        return ",".join([str(round(1e9 * time) + 10**12), *(repr(float(x)) for x in values)])

    lines = ["#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_x,a_y,a_z"]
    for time, _, values in recorded.imu:
        turned = [R_BS.T @ body.T @ v for v in (values[:3], values[3:])]
        lines.append(row(time, np.concatenate(turned)))
    (tmp_path / "mav0/imu0/data.csv").write_text("\n".join(lines))
    lines = ["#timestamp [ns],p_RS_R_x [m],p_y,p_z"]
    lines += [row(time, values["gnss_position"]) for time, _, values in recorded.gnss]
    (tmp_path / "mav0/leica0/data.csv").write_text("\n".join(lines))
    log = read_log(tmp_path)
    check_imu(log, table, 1000.0, atol=1e-12)
    np.testing.assert_array_equal(log.gnss.values["position_I"], table.gnss.values["position_I"])
    assert len(replay(log, sensors=PX4, start={"heading": 0.0})) > 100
