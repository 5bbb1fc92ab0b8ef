"""Logs in other formats, written here, contain the numbers of the flight."""

import sys

import numpy as np
import pytest

from quad_gym.estimation import read_log
from tests import foreign_logs as foreign
from tests.foreign_logs import BOOT, EPOCH, HEIGHT


@pytest.fixture(scope="module")
def flight():
    return foreign.flight(5.0)


def check(log, flight, boot, *, imu, places, speeds):
    """Compare IMU, positions and velocities of a log, to absolute tolerances."""
    np.testing.assert_allclose(log.imu.time - boot, flight.time, atol=2e-6)
    for name in ("gyro", "accel"):
        np.testing.assert_allclose(log.imu.values[name], getattr(flight, name), atol=imu)
    values = log.gnss.values
    found = values["gnss_position_G"] if "gnss_position_G" in values else values["gnss_position_I"]
    fixes = np.isfinite(found).all(axis=1)  # differences in ECEF and in I have equal norms
    norms = (np.linalg.norm(p - p[0], axis=1) for p in (found[fixes], flight.fixes))
    np.testing.assert_allclose(*norms, atol=places)
    velocities = values["gnss_velocity_I"]
    known = np.isfinite(velocities).all(axis=1)
    np.testing.assert_allclose(velocities[known], flight.velocities, atol=speeds)


def check_aids(log, flight, boot, height, field, above=0.0):
    """Compare barometer and magnetometer, to absolute tolerances."""
    for sensor, expected, atol in (
        ("barometer", flight.heights + above, height),
        ("magnetometer", flight.fields, field),
    ):
        found = getattr(log, sensor)
        np.testing.assert_allclose(found.time - boot, flight.baro_time, atol=2e-6)
        np.testing.assert_allclose(found.values[sensor], expected, atol=atol)


def test_ardupilot_log_has_the_numbers_of_the_flight(flight, tmp_path):
    """A second IMU of the log is wrong by a factor of nine."""
    pytest.importorskip("pymavlink")
    rows = foreign.ardupilot_rows(flight)
    rows += [[t, "GPA", [0, 0.3, 0.6, 0.1]] for t, name, _ in rows if name == "GPS"]
    rows += [[t, n, [1, *np.multiply(9.0, v[1:])]] for t, n, v in rows if n == "IMU"]
    rows.sort(key=lambda row: row[0])
    layouts = foreign.LAYOUTS | {"GPA": (133, "QBfff", "TimeUS,I,HAcc,VAcc,SAcc")}
    delay = [("GPS_DELAY_MS", 100.0)]
    foreign.write_dataflash(tmp_path / "flight.bin", rows, layouts, delay)
    log = read_log(tmp_path / "flight.bin")
    check(log, flight, BOOT, imu=2e-6, places=0.03, speeds=1e-4)
    check_aids(log, flight, BOOT, 1e-4, 1e-7)
    np.testing.assert_allclose(log.gnss.received - log.gnss.time, 0.1)
    np.testing.assert_allclose(log.gnss.values["gnss_sigma"][0], [0.3, 0.3, 0.6], rtol=1e-6)


@pytest.mark.parametrize(("version", "name"), [(1, "flight.bag"), (2, "flight")])
def test_ros_bag_has_the_numbers_of_the_flight(flight, tmp_path, version, name):
    pytest.importorskip("rosbags")
    bag = foreign.Bag(version)
    bag.imu("/imu/data", flight)
    bag.fixes("/gps/fix", flight)
    bag.velocities("/gps/vel", flight)
    bag.pressures("/air", flight)
    bag.compass("/mag", flight)
    log = read_log(bag.write(tmp_path / name))
    check(log, flight, EPOCH, imu=1e-12, places=1e-6, speeds=1e-12)
    check_aids(log, flight, EPOCH, 0.01, 1e-12, above=HEIGHT)
    sigma = log.gnss.values["gnss_sigma"]
    np.testing.assert_allclose(sigma[np.isfinite(sigma).all(axis=1)][0], [0.2, 0.2, 0.4])


@pytest.mark.parametrize(
    ("name", "kind", "library", "module"),
    [
        ("some.bin", "a log of ArduPilot", "pymavlink", "pymavlink.DFReader"),
        ("some.bag", "a bag of ROS", "rosbags", "rosbags.highlevel"),
    ],
)
def test_files_of_another_kind_and_missing_libraries_are_named(
    tmp_path, monkeypatch, name, kind, library, module
):
    pytest.importorskip(library)
    (tmp_path / name).write_bytes(bytes(1000))
    with pytest.raises(ValueError, match=f"{name} must be {kind}"):
        read_log(tmp_path / name)
    with pytest.raises(FileNotFoundError, match=r"none.bin"):
        read_log(tmp_path / "none.bin")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match="install it with pip install 'quad-gym"):
        read_log(tmp_path / name)


@pytest.mark.parametrize("up", ["z", "x"])
def test_euroc_folder_has_the_numbers_of_the_flight(flight, tmp_path, up):
    """The IMU is rotated. If x is up, the body is EuRoC's, with z forward."""
    T, R_BS = np.eye(4), np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    body = np.eye(3) if up == "z" else np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0]])
    T[:3, :3] = R_BS
    turned = (values @ body @ R_BS for values in (flight.gyro, flight.accel))
    tables = {
        "imu0": ("w_RS_S_x [rad s^-1],w_y,w_z,a_x,a_y,a_z", flight.time, np.hstack([*turned])),
        "leica0": ("p_RS_R_x [m],p_y,p_z", flight.fix_time, flight.fixes),
    }
    for name, (columns, times, values) in tables.items():
        lines = [f"#timestamp [ns],{columns}"]
        for time, row in zip(times, values, strict=True):
            cells = [round(1e9 * time) + 10**12, *map(float, row)]
            lines.append(",".join(map(repr, cells)))
        (tmp_path / "mav0" / name).mkdir(parents=True)
        (tmp_path / "mav0" / name / "data.csv").write_text("\n".join(lines))
    numbers = ", ".join(f"{x}" for x in T.ravel())
    (tmp_path / "mav0/imu0/sensor.yaml").write_text(
        f"sensor_type: imu\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nrate_hz: 200\n"
    )
    log = read_log(tmp_path)
    np.testing.assert_allclose(log.imu.time - 1000.0, flight.time, atol=2e-6)
    for name in ("gyro", "accel"):
        np.testing.assert_allclose(log.imu.values[name], getattr(flight, name), atol=1e-12)
    np.testing.assert_array_equal(log.gnss.values["gnss_position_I"], flight.fixes)
