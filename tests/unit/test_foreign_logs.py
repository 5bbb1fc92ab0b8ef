"""Logs of others, with the defects that they have, replay to the truth or are refused by name."""

import gzip
import math
import struct
import tomllib
from pathlib import Path

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import read_log, replay
from quad_gym.logs.formats.quantities import compared
from quad_gym.rotations import dcm_to_euler, euler_to_dcm, quaternion_to_dcm
from tests import foreign_logs as foreign
from tests.foreign_logs import BOOT, EPOCH, Bag

CONSUMER = quad_gym.sensor_suite("consumer")
EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
CLOSE = [0.8, 0.8, 1.0]  #: errors of the unchanged flight are below 0.4 m in all formats [m]


@pytest.fixture(scope="module")
def flight():
    return foreign.flight()


def arrives(flight, log, clock=BOOT, sensors=CONSUMER, start=None, **options):
    """Replay a log; its errors are small, and no alarm is raised."""
    result = replay(log, sensors=sensors, start=start, **options)
    errors = flight.errors(result, clock)
    assert (np.abs(errors).max(axis=0) < CLOSE).all(), np.abs(errors).max(axis=0)
    assert result.problems == ()
    return result


def has(sentences, *words):
    """Some sentence has all of the words."""
    found = [s for s in sentences if all(word in s for word in words)]
    assert found, sentences
    return found[0]


# ---- ArduPilot -----------------------------------------------------------------------------------


@pytest.fixture
def dataflash(flight, tmp_path):
    pytest.importorskip("pymavlink")

    def write(edit=lambda rows: rows, old=False, **options):
        path = tmp_path / "flight.bin"
        rows = edit(foreign.ardupilot_rows(flight, old=old))
        foreign.write_dataflash(path, rows, **options)
        return path

    return write


def test_layout_before_2015_has_the_clock_of_the_vehicle(flight, dataflash):
    path = dataflash(old=True, layouts=foreign.OLD_LAYOUTS)
    result = arrives(flight, path)
    assert len(result.measured["gnss_velocity"].time) == len(flight.fix_time) - 1
    np.testing.assert_allclose(read_log(path).gnss.received, flight.fix_time + BOOT + 0.2)


def test_layout_before_2015_without_a_receiver_keeps_heights_only(flight, dataflash):
    rows = [row for row in foreign.ardupilot_rows(flight, old=True) if row[1] != "GPS"]
    path = dataflash(lambda _: rows, old=True, layouts=foreign.OLD_LAYOUTS)
    result = replay(path, sensors=CONSUMER, start={"position": (0.0, 0.0, 0.0), "heading": 0.3})
    assert np.abs(flight.errors(result, BOOT)[:, 2]).max() < CLOSE[2]
    has(result.problems, "position: nothing corrects it", "dead reckoning")


@pytest.mark.parametrize("place", [0, 350, 699])
@pytest.mark.parametrize("hours", [1.0, -0.002])
def test_a_wrong_stamp_costs_one_row(flight, dataflash, place, hours):
    def edit(rows):
        (row,) = [r for r in rows if r[1] == "IMU"][place : place + 1]
        row[0] = max(row[0] + 3600.0 * hours, -BOOT)
        return rows

    log = read_log(dataflash(edit))
    assert len(log.imu) == len(flight.time) - 1
    np.testing.assert_allclose(np.delete(flight.time, place) + BOOT, log.imu.time, atol=1e-6)
    has(log.notes, "imu", "1 row dropped", "wrong time stamp")
    arrives(flight, log)


def second_receiver(flight, lost):
    """Rows of a receiver 0 without a fix from a time on, and of a receiver 1 with all of them."""

    def edit(rows):
        for row in [r for r in rows if r[1] == "GPS"]:
            rows.append([row[0], "GPS", [1, *row[2][1:]]])
            if row[0] > lost:
                row[2][1:4] = [1, 0.0, 0.0]
        return sorted(rows, key=lambda row: row[0])

    return edit


@pytest.mark.parametrize("lost", [-1.0, 6.0])
def test_receiver_with_a_fix_is_taken(flight, dataflash, lost):
    path = dataflash(second_receiver(flight, lost))
    result = arrives(flight, path)
    assert result.sources["gnss"]["taken"] == "GPS 1"
    has(result.notes, "GPS", "left out" if lost < 0.0 else "is taken, not GPS")
    if lost > 0.0:
        chosen = read_log(path, instance={"gnss": 0})
        assert chosen.gnss.received[-1] < lost + BOOT + 0.01
        has(chosen.notes, "no data", "--instance gnss=1")
    with pytest.raises(ValueError, match=r"flight.bin: instance of gnss must be .*\(0, 1\), got 5"):
        read_log(path, instance={"gnss": 5})


@pytest.mark.parametrize(
    ("damage", "kept", "sentence"),
    [(b"\xff" * 700, 690, "skipped: 7"), (b"\xa3\x95\xee", 300, "type is unknown")],
)
def test_damage_of_a_file_is_counted_and_not_printed(
    flight, dataflash, capfd, damage, kept, sentence
):
    path = dataflash()
    whole = path.read_bytes()
    path.write_bytes(whole[:20_000] + damage + whole[20_000:])
    log = read_log(path)
    assert len(log.imu) > kept
    has(log.notes, sentence)
    assert capfd.readouterr() == ("", "")
    path.write_bytes(whole)
    assert not any("damaged" in note for note in read_log(path).notes)


def test_receiver_that_could_take_over_in_flight_is_named(flight, dataflash):
    """Receiver 0 loses its fix after 10 s; receiver 1 has its first fix after 7 s."""

    def edit(rows):
        late = [[t, name, [1, *values[1:]]] for t, name, values in rows if name == "GPS" and t > 7]
        first = [row for row in rows if row[1] != "GPS" or row[0] < 10.0]
        return sorted([*first, *late], key=lambda row: row[0])

    log = read_log(dataflash(edit))
    assert log.sources["gnss"]["taken"] == "GPS"
    has(log.notes, "GPS has no data in 4 s in which GPS 1 has", "--instance gnss=1")


def test_pause_divides_a_flight_into_parts(flight, dataflash):
    path = dataflash(lambda rows: [r for r in rows if not 2.0 < r[0] < 5.0])
    result = arrives(flight, path)
    has(result.notes, "flown in 2 parts")
    assert not ((result.time > BOOT + 2.05) & (result.time < BOOT + 4.9)).any()
    later = replay(path, sensors=CONSUMER, from_=BOOT + 5.0, until=BOOT + 12.0)
    assert later.time[0] > BOOT + 4.9
    assert later.time[-1] <= BOOT + 12.0
    with pytest.raises(
        ValueError, match="samples of the IMU from 100 s to inf s, got some from 20"
    ):
        read_log(path, from_=100.0)


@pytest.mark.parametrize("field", [[0, 0, 0], [110, -50, 300]])
def test_dead_compass_is_left_out(flight, dataflash, field):
    def edit(rows):
        for row in rows:
            row[2][1:] = field if row[1] == "MAG" else row[2][1:]
        return rows

    result = arrives(flight, dataflash(edit))
    has(result.notes, "magnetometer", "left out")
    assert "magnetometer" not in result.measured


def test_imu_of_the_primary_estimator_is_taken(flight, dataflash):
    """EK3_PRIMARY selects the second IMU; the first one has a wrong scale."""

    def edit(rows):
        extra = [[t, "IMU", [1, *values[1:]]] for t, name, values in rows if name == "IMU"]
        for row in rows:
            row[2][1:] = 3.0 * np.array(row[2][1:]) if row[1] == "IMU" else row[2][1:]
        return sorted([*rows, *extra], key=lambda row: row[0])

    result = arrives(flight, dataflash(edit, parameters=[("EK3_PRIMARY", 1.0)]))
    assert result.sources["imu"]["taken"] == "IMU 1"
    has(result.notes, "imu: IMU 1 is taken (EK3_PRIMARY 1), not IMU")


def test_flow_distance_commands_and_battery_are_read(flight, dataflash):
    """ArduPilot's flow is positive for right-hand turns of the sensor: about x at a motion to the
    left, about y at a motion forward. Motors 1 to 4 are on the outputs 4 to 1."""
    layouts = foreign.LAYOUTS | {
        "OF": (140, "QBffff", "TimeUS,Qual,flowX,flowY,bodyX,bodyY"),
        "RFND": (141, "QBfBB", "TimeUS,Instance,Dist,Stat,Orient"),
        "RCOU": (142, "QHHHH", "TimeUS,C1,C2,C3,C4"),
        "BAT": (143, "QBf", "TimeUS,I,Volt"),
    }
    forward, left, height, (w_x, w_y) = 2.0, 0.5, 4.0, (0.3, -0.2)
    frd = (left / height + w_x, forward / height - w_y, w_x, -w_y)

    def edit(rows):
        for t in np.arange(0.0, 10.0, 0.1):
            rows.append([t, "OF", [200 if t < 5.0 else 0, *frd]])
            rows.append([t, "RFND", [0, height, 4, 25 if t < 5.0 else 0]])
            rows.append([t, "RCOU", [1900, 1500, 1300, 1100]])
            rows.append([t, "BAT", [0, 15.5]])
        return sorted(rows, key=lambda row: row[0])

    parameters = [("MOT_PWM_MIN", 1100.0), ("MOT_PWM_MAX", 1900.0)]
    parameters += [(f"SERVO{k}_FUNCTION", 37.0 - k) for k in range(1, 5)]
    log = read_log(dataflash(edit, layouts=layouts, parameters=parameters))
    assert len(log.optical_flow) == len(log.range_finder) == 50
    expected = (forward / height - w_y, left / height + w_x)
    np.testing.assert_allclose(log.optical_flow.values["optical_flow"][7], expected, atol=1e-6)
    np.testing.assert_allclose(log.range_finder.values["range_finder"], height)
    np.testing.assert_allclose(log.motors.values["commands"][0], [0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(log.battery.values["battery"], 15.5)


# ---- PX4 -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("prefer", [0, 1])
def test_compass_of_higher_priority_is_taken(flight, tmp_path, prefer):
    pytest.importorskip("pyulog")
    bad = flight.fields + 8e-6 * np.sin(flight.baro_time)[:, np.newaxis]
    fields = (bad, None) if prefer else (None, bad)
    values = [("CAL_MAG0_PRIO", 75 - 25 * prefer), ("CAL_MAG1_PRIO", 50 + 25 * prefer)]
    foreign.write_px4(tmp_path / "two.ulg", flight, fields, values)
    result = arrives(flight, tmp_path / "two.ulg")
    has(result.notes, "magnetometer", "is taken", f"CAL_MAG{prefer}_PRIO 75")
    worse = read_log(tmp_path / "two.ulg", instance={"magnetometer": 1 - prefer})
    assert np.ptp(np.linalg.norm(worse.magnetometer.values["magnetometer"], axis=1)) > 6e-6
    foreign.write_px4(tmp_path / "two.ulg", flight, fields)  # no preference: the steadier field
    arrives(flight, tmp_path / "two.ulg")


@pytest.mark.parametrize("turned", [False, True])
def test_compass_with_the_field_of_the_earth_is_taken_whatever_the_autopilot_used(
    flight, tmp_path, turned
):
    """The other one has twice the strength, or its field along other axes, and priority."""
    pytest.importorskip("pyulog")
    wrong = flight.fields[:, [2, 0, 1]] if turned else 2.0 * flight.fields
    values = [("CAL_MAG0_PRIO", 100), ("CAL_MAG1_PRIO", 50)]
    foreign.write_px4(tmp_path / "two.ulg", flight, (wrong, None), values)
    result = arrives(flight, tmp_path / "two.ulg")
    has(result.notes, "magnetometer 1 is taken", "is the Earth's")


def test_log_of_2016_has_compass_and_barometer_in_sensor_combined(flight, tmp_path):
    pytest.importorskip("pyulog")
    foreign.write_px4(tmp_path / "old.ulg", flight, combined=True)
    result = arrives(flight, tmp_path / "old.ulg")
    assert set(result.measured) >= {"barometer", "magnetometer", "gnss_position"}
    has(result.notes, "magnetometer", "copy of the measurement before")
    assert len(read_log(tmp_path / "old.ulg").magnetometer) < 1.1 * len(flight.baro_time)


def test_heights_above_the_ellipsoid_that_are_not_filled_are_replaced(flight, tmp_path):
    pytest.importorskip("pyulog")
    foreign.write_px4(tmp_path / "flight.ulg", flight, ellipsoid=False)
    arrives(flight, tmp_path / "flight.ulg")


def test_log_whose_topic_lacks_a_field_is_read_without_it(flight, tmp_path):
    """One wrong byte in the definition of a topic renames its field."""
    pytest.importorskip("pyulog")
    file = tmp_path / "flight.ulg"
    foreign.write_px4(file, flight)
    file.write_bytes(file.read_bytes().replace(b"uint8_t fix_type;", b"uint8_t fix_tyqe;"))
    log = read_log(file)
    assert len(log.imu) == len(flight.time)
    assert log.gnss is None
    has(log.notes, "vehicle_gps_position", "no fix")


def test_damage_of_a_ulog_is_a_note_and_not_printed(flight, tmp_path, capfd):
    pytest.importorskip("pyulog")
    file = tmp_path / "flight.ulg"
    foreign.write_px4(file, flight)
    whole = file.read_bytes()
    assert not any("damaged" in note for note in read_log(file).notes)
    unknown = struct.pack("<HcHQ", 10, b"D", 999, 0)  # data of no topic, of which pyulog prints
    for content in (whole[:20_000] + bytes(40) + whole[20_000:], whole + unknown):
        file.write_bytes(content)
        log = read_log(file)
        assert len(log.imu) > 300
        has(log.notes, "damaged parts of the file")
    assert capfd.readouterr() == ("", "")


# ---- ROS -----------------------------------------------------------------------------------------


@pytest.fixture
def bag(flight, tmp_path):
    pytest.importorskip("rosbags")

    def write(imu=True, gps=True, velocity=True, air=True, more=lambda bag: None, **options):
        made = Bag()
        if imu:
            made.imu("/imu/data", flight)
        if gps:
            made.fixes("/gps/fix", flight, **options)
        if velocity:
            made.velocities("/gps/vel", flight, **({} if options.get("clock", 1) else options))
        if air:
            made.pressures("/imu/static_pressure", flight)
        made.compass("/imu/mag", flight)
        more(made)
        return made.write(tmp_path / "flight.bag")

    return write


def test_gyro_and_accelerometer_on_two_topics_are_joined(flight, bag):
    def more(made):
        made.imu("/camera/gyro/sample", flight, accel=False)
        made.imu("/camera/accel/sample", flight, gyro=False)

    result = arrives(flight, bag(imu=False, more=more), EPOCH)
    has(result.notes, "/camera/gyro/sample", "/camera/accel/sample", "joined")


def test_topics_that_measured_nothing_are_skipped(flight, bag):
    def more(made):
        made.imu("/a/unknown", flight, gyro=False, accel=False)
        made.imu("/b/zeros", flight, zeros=True)

    result = arrives(flight, bag(more=more), EPOCH)
    assert result.sources["imu"]["taken"] == "/imu/data"


def test_receivers_velocity_comes_before_commands_and_parts_of_words(flight, bag):
    def more(made):
        made.velocities("/fixed_wing/cmd_vel", flight, 0.0 * flight.velocities + 2.0)
        made.velocities("/a_prefix/velocity", flight, 0.0 * flight.velocities - 2.0)

    result = arrives(flight, bag(more=more), EPOCH)
    assert result.sources["gnss_velocity"]["taken"] == "/gps/vel"
    wrong = read_log(bag(more=more), topic={"gnss_velocity": "/a_prefix/velocity"})
    assert wrong.sources["gnss_velocity"]["taken"] == "/a_prefix/velocity"


def test_repeated_fixes_count_once(flight, bag):
    path = bag(times=5)
    result = arrives(flight, path, EPOCH)
    assert len(result.measured["gnss_position"].time) == len(flight.fix_time) - 1
    has(result.notes, "/gps/fix", "repeated stamp", str(4 * len(flight.fix_time)))


@pytest.mark.parametrize("factor", [1.0, 0.01, 0.001])
def test_static_pressure_is_taken_in_its_unit(flight, bag, factor):
    def more(made):
        made.pressures("/a/pressure_diff", flight, 3.0 + 0.0 * flight.heights)
        made.pressures("/b/static_pressure", flight, factor * foreign.pressure(flight.heights))

    result = arrives(flight, bag(air=False, more=more), EPOCH)
    assert result.sources["barometer"]["taken"] == "/b/static_pressure"
    has(result.notes, "/a/pressure_diff", "no pressure of the atmosphere")


def test_stamps_that_were_never_set_are_replaced_by_times_of_recording(flight, bag):
    result = replay(bag(clock=0), sensors=CONSUMER)
    assert np.abs(flight.errors(result, EPOCH)).max() < 1.5  # 0.1 s late
    has(result.notes, "/gps/fix", "never set", "times of recording")


def test_clock_of_another_epoch_is_placed_by_times_of_recording_and_named(flight, bag):
    result = replay(bag(clock=1234.0), sensors=CONSUMER)
    assert np.abs(flight.errors(result, EPOCH)).max() < 1.5
    has(result.problems, "/gps/fix", "another clock")


def test_bag_without_imu_is_refused_by_name(flight, bag):
    with pytest.raises(
        ValueError, match=r"flight.bag must have messages sensor_msgs/Imu, got none"
    ):
        read_log(bag(imu=False))
    with pytest.raises(ValueError, match=r"flight.bag.*both halves \(it has only the gyro\)"):
        read_log(bag(imu=False, more=lambda made: made.imu("/gyro", flight, accel=False)))


# ---- tables and folders --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["leica0", "vicon3", "mocap0", "optitrack"])
def test_folder_with_doubled_rows_and_motion_capture_replays(flight, tmp_path, name):
    def row(time, values):
        return ",".join([str(round(1e9 * (time + EPOCH))), *(f"{x:.9f}" for x in values)])

    inertial = np.column_stack([flight.gyro, flight.accel])
    tables = {
        "imu0": ("#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z", flight.time, inertial),
        name: ("#timestamp [ns],p_RS_R_x [m],p_y,p_z", flight.fix_time, flight.fixes),
    }
    for folder, (heading, times, values) in tables.items():
        (tmp_path / "mav0" / folder).mkdir(parents=True)
        lines = [row(t, v) for t, v in zip(times, values, strict=True)]
        lines.insert(50, lines[49])
        (tmp_path / "mav0" / folder / "data.csv").write_text("\n".join([heading, *lines]))
    gnss = CONSUMER.gnss.replace(primary_antenna_B=(0.0, 0.0, 0.0), velocity_sigma=None)
    suite = CONSUMER.replace(barometer=None, magnetometer=None, gnss=gnss)
    result = arrives(flight, tmp_path, EPOCH, suite, {"heading": 0.3})
    has(result.notes, "imu0", "1 row dropped", "repeated stamp")


def changed(table, rows=None, **columns):
    """A copy of a table with other values where there are any; of some rows."""
    found = {name: values.copy() for name, values in table.items()}
    for name, change in columns.items():
        have = np.flatnonzero(np.isfinite(found[name].reshape(len(found["time"]), -1)).all(axis=1))
        have = have if rows is None else have[rows]
        found[name][have] = change(found[name][have])
    return found


def test_dead_compass_and_doubled_sample_of_a_table_are_named(flight):
    table = changed(flight.table(), magnetometer=lambda m: 0.0 * m)
    twice = np.sort([*range(len(table["time"])), 100])
    result = arrives(flight, {name: values[twice] for name, values in table.items()}, 0.0)
    has(result.notes, "magnetometer", "left out")
    has(result.notes, "1 row dropped", "repeated stamp")


@pytest.mark.parametrize("turn", ["reversed", "shuffled"])
def test_rows_in_another_order_than_time_are_sorted(flight, turn):
    table = flight.table()
    rows = np.arange(len(table["time"]))[::-1]
    if turn == "shuffled":
        rows = np.random.default_rng(1).permutation(rows)
    result = arrives(flight, {name: values[rows] for name, values in table.items()}, 0.0)
    has(result.notes, "not in the order of time: they are sorted")
    late = table | {"received": table["time"]}  # whose order is given
    assert not any("sorted" in note for note in read_log(late).notes)


def test_first_fixes_at_zero_are_no_fixes(flight):
    lla = np.full((len(flight.table()["time"]), 3), np.nan)
    table = flight.table()
    fixes = np.isfinite(table.pop("gnss_enu")).all(axis=1)
    lla[fixes] = np.column_stack(flight.lla)
    lla[np.flatnonzero(fixes)[:5]] = 0.0
    result = replay(table | {"gnss_lla": lla}, sensors=CONSUMER)
    assert len(result.measured["gnss_position"].time) == len(flight.fix_time) - 6
    has(result.notes, "gnss", "5 rows dropped", "0, 0")
    far = changed(flight.table(), gnss_enu=lambda p: p + np.array([300.0, 0, 0]))
    far = changed(far, slice(0, 5), gnss_enu=lambda p: 0.0 * p)
    has(read_log(far).notes, "5 rows dropped", "0, 0, 0")


def test_heights_that_are_not_filled_are_not_fused(flight):
    table = changed(flight.table(), gnss_enu=lambda p: p * [1.0, 1.0, 0.0])
    result = replay(table, sensors=CONSUMER)
    has(result.problems, "heights of GNSS are constant", "left out")
    assert (np.abs(flight.errors(result)).max(axis=0) < [0.8, 0.8, 2.0]).all()


def test_barometer_above_another_level_is_named_and_still_used(flight):
    result = replay(changed(flight.table(), barometer=lambda b: b + 1816.0), sensors=CONSUMER)
    assert result.problems == ()
    has(result.notes, "1816 m", "sea level")
    assert (np.abs(flight.errors(result)).max(axis=0) < CLOSE).all()
    assert len(result.measured["barometer"].time) > 200


@pytest.mark.parametrize(
    ("change", "unit"),
    [
        (lambda b: b / 0.3048, "in ft"),
        (lambda b: 950.0 - 0.113 * b, "in hPa"),
        (np.negative, "in m downward"),
    ],
)
def test_barometer_in_another_unit_is_named_and_left_out(flight, change, unit):
    result = replay(changed(flight.table(), barometer=change), sensors=CONSUMER)
    has(result.problems, "barometer", unit, "left out")
    assert "barometer" not in result.measured


def test_field_in_another_unit_is_named_and_left_out(flight):
    result = replay(changed(flight.table(), magnetometer=lambda m: 1e4 * m), sensors=CONSUMER)
    has(result.problems, "field in gauss", "left out")
    assert "magnetometer" not in result.measured
    assert (np.abs(flight.errors(result)).max(axis=0) < CLOSE).all()


def in_radians(v):
    """Velocities of a course in radians that was taken for degrees."""
    course = np.radians(np.arctan2(v[:, 0], v[:, 1]) % (2.0 * np.pi))
    speed = np.hypot(v[:, 0], v[:, 1])
    return np.column_stack([speed * np.sin(course), speed * np.cos(course), v[:, 2]])


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (in_radians, "course in radians"),
        (lambda v: 100.0 * v, "cm/s"),
        (lambda v: v[:, [1, 0, 2]] * [1.0, 1.0, -1.0], "north, east, down"),
        (np.negative, "sign is reversed"),
    ],
)
def test_velocities_against_differenced_positions_are_named_and_left_out(flight, change, cause):
    long = foreign.flight(24.0)
    table = changed(long.table(), gnss_velocity_enu=change)
    result = replay(table, sensors=CONSUMER)
    has(result.problems, "velocities contradict the positions", cause)
    assert "gnss_velocity" not in result.measured
    assert (np.abs(long.errors(result)).max(axis=0) < 2.0).all()


def test_velocities_of_a_slow_flight_agree_with_noisy_positions_that_jump(flight):
    """Noise of 0.4 m makes differences of positions faster than the motion of up to 1 m/s; 3 % of
    the fixes are off by 40 m."""
    rng, slow = np.random.default_rng(0), foreign.flight(24.0)

    def noisy(p):
        wrong = 40.0 * (rng.random(len(p)) < 0.03)[:, np.newaxis]
        return 0.3 * p + rng.normal(0.0, 0.4, p.shape) + wrong * [1.0, 0.0, 0.0]

    table = changed(slow.table(), gnss_enu=noisy, gnss_velocity_enu=lambda v: 0.3 * v)
    log = read_log(table)
    assert compared(log, CONSUMER).problems == ()
    silent = read_log(changed(slow.table(), gnss_velocity_enu=lambda v: 1e-3 * v))
    has(compared(silent, CONSUMER).problems, "velocities contradict the positions")


def test_clocks_with_nothing_in_common_are_refused_with_both_ranges(flight):
    table = flight.table()
    fixes = np.isfinite(table["gnss_enu"]).all(axis=1)
    table["time"][fixes] += EPOCH
    pattern = r"gnss.*from 1700000000\.000 s to .* and the IMU from 0\.020 s to 14\.000 s"
    with pytest.raises(ValueError, match=pattern):
        replay(table, sensors=CONSUMER)


def test_headings_in_degrees_are_named_and_left_out(flight):
    table, gnss = flight.table(), CONSUMER.gnss
    suite = CONSUMER.replace(
        magnetometer=None, gnss=gnss.replace(secondary_antenna_B=(-1.0, 0.0, 0.0))
    )
    turns = 0.3 + np.concatenate([[0.0], np.cumsum(flight.gyro[1:, 2] * np.diff(flight.time))])
    headings = np.full(len(table["time"]), np.nan)
    rows = np.isfinite(table["gyro"]).all(axis=1)
    headings[rows] = 90.0 + np.degrees(turns)
    result = replay(table | {"heading": headings}, sensors=suite, start={"heading": 0.3})
    has(result.problems, "headings reach 1", "in degrees?", "left out")
    assert "gnss_baseline" not in result.measured
    headings[rows] = turns
    assert compared(read_log(table | {"heading": headings}), suite).problems == ()


def test_heading_alone_does_not_level_a_vehicle_that_rests_on_a_slope(tmp_path):
    """A level baseline would pull the pitch by 0.24 rad, at a standard deviation of 0.006 rad."""
    gnss = CONSUMER.gnss.replace(primary_antenna_B=(0, 0, 0), secondary_antenna_B=(1, 0, 0))
    suite = CONSUMER.replace(magnetometer=None, barometer=None, gnss=gnss)
    rng, n, R_BI = np.random.default_rng(0), 3000, euler_to_dcm(np.array([0.05, 0.25, 0.8]))
    force, heading = R_BI @ [0.0, 0.0, 9.81], math.atan2(R_BI[0, 1], R_BI[0, 0])
    fixes = {
        "gnss_enu": rng.normal(size=(n, 3)) * gnss.position_sigma_I,
        "gnss_velocity_enu": rng.normal(0.0, gnss.velocity_sigma, (n, 3)),
        "heading": heading + rng.normal(0.0, gnss.baseline_noise, n),
    }
    for values in fixes.values():
        values[np.arange(n) % 20 > 0] = np.nan
    table = {
        "time": 0.01 * np.arange(1, n + 1),
        "gyro": rng.normal(0.0, 0.002, (n, 3)),
        "accel": force + rng.normal(0.0, 0.05, (n, 3)),
        **fixes,
    }
    start = {"accel": force, "heading": heading}
    result = replay(table, sensors=suite, start=start)
    errors = dcm_to_euler(R_BI @ np.swapaxes(quaternion_to_dcm(result.quaternion), 1, 2))[500:]
    assert (np.abs(errors) < 4.0 * result.sigma[500:, 6:9]).all()
    assert 0.001 < result.sigma[-1, 8] < 0.3 * gnss.baseline_noise  # it does measure the heading
    assert result.problems == ()
    fit = result.summary()["measurements"]["gnss_baseline"]
    assert fit["degrees_of_freedom"] == 1
    assert fit["mean_nis"] == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 150))
    with pytest.raises(ValueError, match="got headings alone"):
        replay(table, sensors=suite, start={"heading": heading}, samples=tmp_path / "samples.csv")


def test_log_without_measurements_is_dead_reckoning(flight):
    imu = {name: getattr(flight, name) for name in ("time", "gyro", "accel")}
    start = {"position": (0.0, 0.0, 0.0), "heading": 0.3}
    result = replay(imu, sensors=CONSUMER, start=start)
    has(result.problems, "position: nothing corrects it for 14 s", "dead reckoning")


def test_calm_flight_gives_no_false_finding():
    """A vehicle at rest: heights and velocities hardly change, and nothing is left out."""
    still = foreign.flight(14.0, rest=100.0)
    log = still.table()
    result = replay(log, sensors=CONSUMER)
    assert result.notes == result.problems == ()
    assert set(result.measured) == {"gnss_position", "gnss_velocity", "barometer", "magnetometer"}


def test_fictitious_position_keeps_the_tilt_without_gnss():
    """Measured over 60 s: 1.6 degrees with it, 3.7 without."""
    long, suite = foreign.flight(60.0), quad_gym.sensor_suite("field")
    table = {name: v for name, v in long.table().items() if not name.startswith("gnss")}
    result = replay(table, sensors=suite, start={"position": (0, 0, 0), "heading": 0.3})
    force = np.gradient(np.gradient(long.position, long.time, axis=0), long.time, axis=0)
    truth = np.column_stack([np.interp(result.time, long.time, axis) for axis in force.T])
    truth[:, 2] += 9.80665
    up = quaternion_to_dcm(result.quaternion)[:, 2]
    cosine = (up * truth).sum(axis=1) / np.linalg.norm(truth, axis=1)
    tilt = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))[100:]
    assert np.sqrt((tilt**2).mean()) < 2.5
    has(result.notes, "fictitious", "no meaning")
    assert set(result.measured) == {"barometer", "magnetometer"}
    assert result.sensors == suite


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,accel_x\n0,1\n", "a log must have a column gyro_x"),
        ("time,gyro\n0,inf\n", "columns of a log must have known names"),
        ("time,barometer\n0,inf\n1,2\n", "column barometer must be finite"),
    ],
)
def test_errors_of_tables_name_the_file(text, message, tmp_path):
    (tmp_path / "mine.csv").write_text(text)
    with pytest.raises(ValueError, match=f"^mine.csv: {message}"):
        read_log(tmp_path / "mine.csv")


def test_damaged_compressed_table_is_refused_by_name(tmp_path):
    """Wrong bytes in the head, of the first block, and of the checksum: different exceptions."""
    text = b"time,gyro_x\n" + b"".join(b"%d,%d\n" % (k, k * k) for k in range(3000))
    whole, file = gzip.compress(text, mtime=0), tmp_path / "log.csv.gz"
    for place in (0, 10, len(whole) - 8):
        file.write_bytes(whole[:place] + b"\xff" * 4 + whole[place + 4 :])
        with pytest.raises(ValueError, match=r"log\.csv\.gz must be a table of text"):
            read_log(file)


def test_map_of_columns_converts_units_axes_clocks_and_makes_measurements(flight, tmp_path):
    """The table is in g, deg/s, mG and hPa, its body is forward, right, down, and time is in ms."""
    near = [int(np.argmin(np.abs(flight.baro_time - t))) for t in flight.time]
    columns = {
        "ms": 1e3 * flight.time,
        **{f"w{i}": np.degrees(flight.gyro[:, i]) * foreign.FLU[i] for i in range(3)},
        **{f"a{i}": flight.accel[:, i] * foreign.FLU[i] / 9.80665 for i in range(3)},
        **{f"m{i}": 1e7 * flight.fields[near, i] * foreign.FLU[i] for i in range(3)},
        "air": 0.01 * foreign.pressure(flight.heights[near]),
        **{name: flight.position[:, i] for i, name in enumerate(("n", "e", "d"))},
    }
    columns["n"], columns["e"] = columns["e"], columns["n"]
    columns["d"] = -columns["d"]
    table = np.column_stack(list(columns.values()))
    header = ",".join(columns)
    with gzip.open(tmp_path / "flight.csv.gz", "wt") as file:
        np.savetxt(file, table, delimiter=",", header=header, comments="")
    three = lambda name: [f"{name}{i}" for i in range(3)]  # noqa: E731
    text = f"""
body = "frd"
[time]
columns = ["ms"]
unit = "ms"
[gyro]
columns = {three("w")}
unit = "deg/s"
[accel]
columns = {three("a")}
unit = "g"
[magnetometer]
columns = {three("m")}
unit = "mG"
[barometer]
columns = ["air"]
unit = "hPa"
[gnss_enu]
columns = ["n", "e", "d"]
axes = ["y", "x", "-z"]
rate = 5.0
sigma = 0.1
seed = 3
"""
    file = tmp_path / "map.toml"
    file.write_text(text)
    log = read_log(tmp_path / "flight.csv.gz", columns=file)
    np.testing.assert_allclose(log.imu.values["gyro"], flight.gyro, atol=1e-9)
    np.testing.assert_allclose(log.imu.values["accel"], flight.accel, atol=1e-9)
    np.testing.assert_allclose(np.diff(log.gnss.time), 0.2, atol=1e-9)
    noise = log.gnss.values["gnss_position_I"] - flight.position[::10]
    assert 0.08 < noise.std() < 0.12
    suite = CONSUMER.replace(gnss=CONSUMER.gnss.replace(velocity_sigma=None))
    arrives(flight, tmp_path / "flight.csv.gz", 0.0, suite, {"heading": 0.3}, columns=file)
    for wrong, message in (
        (text.replace('"deg/s"', '"m"'), r"unit of \[gyro\] must be one of"),
        (text.replace('"w1"', '"w9"').replace("'w1'", "'w9'"), "no column w9"),
        (text.replace("[gyro]", "[gyroscope]"), "gyroscope is not a keyword.*did you mean gyro"),
        (text + "[", r"map.toml must be a map of columns"),
    ):
        file.write_text(wrong)
        with pytest.raises(ValueError, match=message):
            read_log(tmp_path / "flight.csv.gz", columns=file)


def test_map_for_nanobench_reads_its_columns(flight):
    contents = tomllib.loads((EXAMPLES / "nanobench.toml").read_text())
    names = [name for entry in contents.values() for name in entry["columns"]]
    table = dict.fromkeys(names, np.ones(len(flight.time)))
    table["t"] = flight.time
    for names, values in (("gyro", flight.gyro), ("acc", flight.accel / 9.80665)):
        table |= {f"imu_{names}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
    table |= {f"p{axis}": flight.position[:, i] for i, axis in enumerate("xyz")}
    table |= {f"motor_motor_m{k}": 0.25 * 65535 * table["t"] ** 0 for k in range(1, 5)}
    log = read_log(table, columns=EXAMPLES / "nanobench.toml")
    np.testing.assert_allclose(log.imu.values["accel"], flight.accel, atol=1e-9)
    np.testing.assert_allclose(np.diff(log.gnss.time), 0.1, atol=1e-9)
    np.testing.assert_allclose(log.motors.values["commands"], 0.25)
    assert np.abs(log.gnss.values["gnss_position_I"] - flight.position[::5]).max() < 0.05
