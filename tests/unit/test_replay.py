"""Replays of simulated flights, from tables and PX4 files, against the filter in flight."""

import dataclasses
import json
import math

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import LOG_COLUMNS, Stream, read_log, replay
from quad_gym.frames import ecef_to_geodetic, geodetic_to_ecef
from quad_gym.logs.plots import replay_figure
from quad_gym.params.suites import CONSUMER
from tests.builders import recorded_flight
from tests.console_commands import run
from tests.estimators import Simple
from tests.filter_states import at_rest
from tests.logged_flights import PX4, RTK, Recorded, errors_in_flight, errors_in_replay, flown

SECONDS = 10.0


@pytest.fixture(scope="module")
def flight():
    return flown(RTK, SECONDS)


@pytest.fixture(scope="module")
def recorded(flight):
    return Recorded(flight, RTK)


@pytest.fixture(scope="module")
def table(recorded):
    return recorded.table()


def sizes(errors):
    """Root mean square errors of position, velocity and attitude."""
    return np.array([math.sqrt((errors[:, i : i + 3] ** 2).sum(axis=1).mean()) for i in (0, 3, 6)])


def compare(recorded, result, settle, boot=0.0):
    """Root mean square errors in replay over errors in flight."""
    shifted = result.time - boot
    k = np.rint(shifted * recorded.suite.imu.rate).astype(int)
    replayed = errors_in_replay(recorded, result, k)
    return sizes(replayed[shifted > settle]) / sizes(
        errors_in_flight(recorded, k)[shifted > settle]
    )


@pytest.mark.parametrize("estimator", ["ukf", "ekf"])
def test_replay_of_a_csv_has_the_errors_of_the_flight(recorded, tmp_path, estimator):
    """Errors agree within 10 % (measured: 4 %) with irregular times, 1 % lost, 50 ms of jitter."""
    assert len(np.unique(np.diff([s[0] for s in recorded.imu]).round(6))) > 3
    recorded.write_csv(tmp_path / "flight.csv")
    result = replay(tmp_path / "flight.csv", sensors=RTK, estimator=estimator)
    assert np.abs(compare(recorded, result, 1.0) - 1.0).max() < 0.1
    assert result.too_late == 0
    assert not result.status
    assert set(result.measured) >= {"gnss_position", "gnss_baseline", "gnss_velocity", "feature_3"}
    count = len(result.measured["gnss_position"].time)
    assert count == len(recorded.gnss) - 1  # without the one that started the filter
    assert (result.measured["gnss_position"].received > result.measured["gnss_position"].time).all()


def test_replay_of_a_px4_log_has_the_errors_of_the_flight(tmp_path):
    """The filter starts by a compass, and its heading converges within some seconds."""
    pytest.importorskip("pyulog")
    recorded = Recorded(flown(PX4, SECONDS), PX4)
    recorded.write_ulog(tmp_path / "flight.ulg", boot=12.0)
    result = replay(tmp_path / "flight.ulg", sensors=PX4)
    assert np.abs(compare(recorded, result, 3.0, boot=12.0)[:2] - 1.0).max() < 0.1
    assert set(result.measured) == {
        "gnss_position", "gnss_velocity", "barometer", "magnetometer"
    }  # fmt: skip
    for measured in result.measured.values():
        mean = measured.nis.mean() / measured.innovation.shape[1]
        assert 0.7 < mean < 1.4
    log = read_log(tmp_path / "flight.ulg")
    assert log.barometer_from_start
    np.testing.assert_allclose(log.imu.values["accel"], [s[2][3:] for s in recorded.imu], atol=1e-5)
    origin = np.array(PX4.gnss.reference_antenna_G)
    there = log.gnss.values["gnss_position_G"] - origin
    here = [s[2]["gnss_position"] for s in recorded.gnss]
    lengths = (np.linalg.norm(places, axis=1) for places in (there, here))
    np.testing.assert_allclose(*lengths, atol=1e-5)
    speeds = [s[2]["gnss_velocity"] for s in recorded.gnss]
    np.testing.assert_allclose(log.gnss.values["gnss_velocity_I"], speeds, atol=1e-5)


@pytest.mark.slow  # three flights of 5 s, each replayed
def test_baselines_added_to_a_px4_log_give_the_attitude(tmp_path):
    """With baselines, for which PX4 has no message, attitude errors after 1 s agree within 10 %
    over all flights (measured: 6 %; 20 to 50 % without baselines)."""
    pytest.importorskip("pyulog")
    R_GI = quad_gym.frames.ecef_to_enu(PX4.gnss.reference_antenna_G).T
    sums = np.zeros(2)
    for seed in (5, 6, 7):
        recorded = Recorded(flown(PX4, 5.0, seed=seed), PX4, seed=seed)
        recorded.write_ulog(tmp_path / "flight.ulg", boot=0.0)
        log = read_log(tmp_path / "flight.ulg")
        baselines = np.array([values["gnss_baseline"] for _, _, values in recorded.gnss])
        values = {**log.gnss.values, "gnss_baseline_G": baselines @ R_GI.T}
        told = Stream(log.gnss.time, log.gnss.received, values)
        result = replay(dataclasses.replace(log, gnss=told), sensors=PX4)
        k = np.rint(result.time * PX4.imu.rate).astype(int)[result.time > 1.0]
        both = errors_in_replay(recorded, result, np.rint(result.time * PX4.imu.rate).astype(int))
        for i, errors in enumerate((both[result.time > 1.0], errors_in_flight(recorded, k))):
            sums[i] += (errors[:, 6:9] ** 2).sum()
    assert abs(math.sqrt(sums[0] / sums[1]) - 1.0) < 0.1


def test_baselines_of_a_log_are_left_out_with_one_antenna():
    count, rng = 400, np.random.default_rng(0)
    fixes = np.arange(0, count, 40)
    columns = {
        "time": np.arange(count) / 200.0,
        "gyro": 1e-3 * rng.normal(size=(count, 3)),
        "accel": [0.0, 0.0, 9.81] + 0.05 * rng.normal(size=(count, 3)),
        "gnss_enu": np.full((count, 3), np.nan),
        "gnss_baseline_enu": np.full((count, 3), np.nan),
    }
    columns["gnss_enu"][fixes] = 0.5 * rng.normal(size=(len(fixes), 3))
    columns["gnss_baseline_enu"][fixes] = [0.19, 0.0, 0.0]
    result = replay(columns, sensors="consumer", start={"heading": 0.0})
    assert result.unused == ("gnss_baseline",)
    assert list(result.measured) == ["gnss_position"]


def test_late_aiding_sensors_find_an_unknown_heading(tmp_path):
    """Barometer and magnetometer arrive late, and the first magnetic field comes after 3 s."""
    pytest.importorskip("pyulog")
    kinds = {"barometer": quad_gym.BarometerParams, "magnetometer": quad_gym.MagnetometerParams}
    suite = PX4.replace(**{name: kind(latency=0.04) for name, kind in kinds.items()})
    recorded = Recorded(flown(suite, 8.0, seed=11), suite)
    recorded.write_ulog(tmp_path / "flight.ulg", boot=1.0)
    whole = read_log(tmp_path / "flight.ulg")
    late = whole.magnetometer.time > 4.0
    fields = {name: values[late] for name, values in whole.magnetometer.values.items()}
    cut = Stream(whole.magnetometer.time[late], whole.magnetometer.received[late], fields)
    assert (whole.barometer.received - whole.barometer.time).min() >= 0.04 - 1e-6
    result = replay(dataclasses.replace(whole, magnetometer=cut), sensors=suite)
    known = result.heading_known
    assert not known[result.time < 3.9].all()
    assert known[result.time > 5.5].all()
    k = np.rint((result.time - 1.0) * suite.imu.rate).astype(int)
    errors = errors_in_replay(recorded, result, k)
    last = result.time > 7.0
    assert np.abs(errors[last] / result.sigma[last, :9]).max() < 6.0
    assert sizes(errors[last])[2] < math.radians(6.0)


def test_a_regular_log_replays_as_it_was_flown(flight):
    """Without losses and jitter, replay and retrodiction in flight agree to first order."""
    recorded = Recorded(flight, RTK, lost=0.0, jitter=0.0, max_ticks=1)
    result = replay(recorded.table(), sensors=RTK)
    k = np.rint(result.time * RTK.imu.rate).astype(int)
    late = k > 400
    gap = np.abs(result.position - flight["estimated_position"][k])[late]
    assert gap.max() < 0.1 * sizes(errors_in_flight(recorded, k)[late])[0]


def test_late_and_unused_measurements_are_counted(table):
    result = replay(table, sensors=RTK, window=0.12)
    assert 0 < result.too_late < 70
    assert np.isfinite(result.position).all()
    result = replay(small(barometer=np.ones(4)), sensors=RTK, start={"heading": 0.0})
    assert result.unused == ("barometer",)


def test_all_kinds_of_tables_give_the_same_replay(recorded, table, tmp_path):
    pandas = pytest.importorskip("pandas")
    short = {name: column[:900] for name, column in table.items()}
    first = replay(short, sensors=RTK)
    together = {"time": short["time"], "received": short["received"]}
    for key in ("gyro", "accel", "gnss_enu", "gnss_velocity_enu", "gnss_baseline_enu"):
        together[key] = np.column_stack([short[name] for name in LOG_COLUMNS[key].names])
    pixels = [short[n] for n in short if n.startswith("pixel")]
    together["pixels"] = np.stack(pixels, axis=1).reshape(len(short["time"]), -1, 2)
    for other in (pandas.DataFrame(short), together, read_log(short)):
        np.testing.assert_array_equal(replay(other, sensors=RTK).position, first.position)


def test_frames_of_positions_and_bodies_are_equivalent(table):
    short = {name: column[:1200] for name, column in table.items() if "pixel" not in name}
    suite = RTK.replace(camera=None)
    first = replay(short, sensors=suite)
    R_GI = quad_gym.frames.ecef_to_enu(suite.gnss.reference_antenna_G).T
    origin = np.array(suite.gnss.reference_antenna_G)
    ecef = {n: c for n, c in short.items() if not n.startswith("gnss")}
    for key in ("gnss", "gnss_velocity", "gnss_baseline"):
        vectors = np.column_stack([short[f"{key}_{axis}"] for axis in ("east", "north", "up")])
        ecef[key] = vectors @ R_GI.T + (origin if key == "gnss" else 0.0)
    frd = dict(ecef)
    for name in ("gyro_y", "gyro_z", "accel_y", "accel_z"):
        frd[name] = -frd[name]
    places = [ecef_to_geodetic(p) if np.isfinite(p).all() else [np.nan] * 3 for p in ecef["gnss"]]
    frd["gnss_lla"] = np.array(places) * [180.0 / math.pi, 180.0 / math.pi, 1.0]
    del frd["gnss"]
    for given, body in ((ecef, "flu"), (frd, "frd")):
        result = replay(given, sensors=suite, body=body)
        np.testing.assert_allclose(result.position, first.position, atol=1e-6)
        np.testing.assert_allclose(result.quaternion, first.quaternion, atol=1e-6)


def test_a_log_from_elsewhere_has_its_origin_at_the_first_fix(table):
    short = {name: column[:600] for name, column in table.items() if "pixel" not in name}
    suite = RTK.replace(camera=None)
    zurich = geodetic_to_ecef(math.radians(47.4), math.radians(8.5), 450.0)
    R_GI = quad_gym.frames.ecef_to_enu(zurich).T
    for key in ("gnss", "gnss_velocity", "gnss_baseline"):
        names = [f"{key}_{axis}" for axis in ("east", "north", "up")]
        vectors = np.column_stack([short.pop(name) for name in names])
        short[key] = vectors @ R_GI.T + (zurich if key == "gnss" else 0.0)
    result = replay(short, sensors=suite)
    first = short["gnss"][np.isfinite(short["gnss"]).all(axis=1)][0]
    np.testing.assert_allclose(result.sensors.gnss.reference_antenna_G, first)
    assert np.abs(result.position[:20]).max() < 0.2


def test_reported_noise_is_used_unless_disabled(table):
    short = {name: column[:900] for name, column in table.items() if "pixel" not in name}
    suite = RTK.replace(camera=None)
    fixes = np.isfinite(short["gnss_east"])
    sigma = np.where(fixes, 0.5, np.nan)
    told = short | {"gnss_sigma": np.column_stack([sigma] * 3)}
    plain, worse = replay(short, sensors=suite), replay(told, sensors=suite)
    assert worse.sigma[-1, 0] > 3.0 * plain.sigma[-1, 0]
    ignored = replay(told, sensors=suite, reported_noise=False)
    np.testing.assert_array_equal(ignored.position, plain.position)


def test_start_options_set_the_heading_or_the_state(table):
    short = {n: c[:900] for n, c in table.items() if not n.startswith(("pixel", "gnss_base"))}
    suite = RTK.replace(camera=None)
    assert not replay(short, sensors=suite).heading_known[0]
    told = replay(short, sensors=suite, start={"heading": 3.1, "heading_sigma": 0.1})
    assert told.heading_known.all()
    given = replay(short, sensors=suite, start=at_rest(covariance=np.eye(15)))
    assert given.time[0] == short["time"][np.isfinite(short["gyro_x"])][0]
    with pytest.raises(ValueError, match="must have a heading in addition to the position"):
        replay(short, sensors=suite, start={"position": np.zeros(3)})
    with pytest.raises(ValueError, match="keywords of set_state"):
        replay(short, sensors=suite, start={"position": np.zeros(3), "R_BI": np.eye(3)})


def latitude(degrees):
    """Columns of fixes at a latitude."""
    return {"gnss_lat": np.full(4, degrees), "gnss_lon": np.zeros(4), "gnss_alt": np.zeros(4)}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("step", [0.01, 1.0])
def test_log_without_any_noise_is_replayed_at_any_rate(step):
    """Innovations are zero, and samples may be farther apart than the spans of the checks."""
    rows = np.arange(300)
    log = {"time": step * rows, "gyro": np.zeros((300, 3)), "gnss_enu": np.zeros((300, 3))}
    log["accel"] = np.tile([0.0, 0.0, 9.80665], (300, 1))
    result = replay(log, sensors="consumer", start={"heading": 0.0})
    assert np.abs(result.position - result.position[0]).max() < 0.1


def small(**changes):
    """A log of four rows."""
    time = np.array([0.0, 0.01, 0.02, 0.03])
    ones = np.ones((4, 3))
    log = {"time": time, "gyro": 0.0 * ones, "accel": ones * [0, 0, 9.8], "gnss_enu": 0.0 * ones}
    return {name: value for name, value in (log | changes).items() if value is not None}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time": None}, "must have a column time"),
        ({"gyro": None}, "must have a column gyro_x"),
        ({"time": np.array([0.0, 10.0, 20.0, 30.0])}, "at most 1 s apart, got none from 0.000 s"),
        ({"time": np.zeros(3)}, "equal lengths"),
        ({"time": np.array(["a", "b", "c", "d"])}, "column time must contain numbers"),
        ({"gyro": np.zeros((4, 2))}, "gyro must have shape"),
        ({"accel": np.full((4, 3), np.inf)}, "accel must be finite"),
        ({"accel": np.full((4, 3), np.nan)}, "at least two IMU samples"),
        ({"gyros": np.zeros(4)}, "columns of a log must have .*, got gyros; did you mean gyro_x?"),
        ({"gnss": np.zeros((4, 3))}, "must have one of gnss, gnss_enu"),
        ({"gnss_enu": None}, "must have a GNSS position to start from"),
        ({"gnss_enu": None, "gnss_east": np.zeros(4)}, "must have a column gnss_north with"),
        ({"pixel_0_u": np.zeros(4), "pixel_0_v": np.zeros(4)}, "12 features of the suite, got 1"),
        ({"gnss_enu": None, **latitude(-90.5)}, r"^gnss_lat \[deg\] must be at least -90, got"),
    ],
)  # fmt: skip
def test_invalid_logs_raise_errors_that_name_the_column(changes, message):
    with pytest.raises((ValueError, TypeError), match=message):
        replay(small(**changes), sensors=RTK)


def test_recorded_episode_is_no_log(tmp_path):
    """`flight.csv` is the name of both in the documentation."""
    _, flight, _ = recorded_flight(steps=3)
    logs = [flight, flight.save(tmp_path / "flight.npz"), flight.to_csv(tmp_path / "flight.csv")]
    for log in logs:
        with pytest.raises(ValueError, match=r"one row for each control step.* fly --replay"):
            replay(log, sensors=RTK)


@pytest.mark.parametrize("name", ["rtk", "lab"])  # averaged and instant samples
def test_fixes_long_before_the_imu_start_no_filter(name):
    """Delays, such as the ones that a calibration tries, move fixes to before the log."""
    suite = quad_gym.sensor_suite(name).replace(camera=None)
    suite = suite.replace(log_delays=suite.log_delays.replace(gnss=0.995))
    log = small(time=0.01 * np.arange(200), gyro=np.zeros((200, 3)))
    log |= {"accel": np.tile([0.0, 0.0, 9.8], (200, 1)), "gnss_enu": np.zeros((200, 3))}
    result = replay(log, sensors=suite, start={"heading": 0.0})
    assert result.time[0] >= -1.0 + (0.0 if suite.imu.samples == "average" else 0.01)
    assert np.isfinite(result.position).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensors": 3}, "sensors must be a SensorSuite"),
        ({"estimator": "kf"}, "estimator must be one of"),
        ({"body": "ned"}, "body must be one of"),
        ({"window": -1.0}, "window"),
        ({"reported_noise": 1}, "reported_noise"),
        ({"start": {"headings": 1.0}}, "^headings is not a keyword of start.*did you mean heading"),
        ({"start": "x"}, "^start must be values by name, or None, got 'x'"),
        ({"start": {"course": True}, "sensors": "lab"}, "sensors take none: GnssParams.velocity_s"),
        ({"start": {"course": True}}, "must have a GNSS velocity, but the first fix of the log"),
        (
            {"estimator": Simple(), "samples": "it.csv"},
            "samples must not be given with an estimator",
        ),
    ],
)
def test_invalid_options_raise_errors_that_name_them(options, message):
    with pytest.raises(ValueError, match=message):
        replay(small(), **{"sensors": RTK} | options)


def test_missing_or_invalid_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="must be a DataFrame"):
        replay(3, sensors=RTK)
    with pytest.raises(OSError, match="missing"):
        replay(tmp_path / "missing.csv", sensors=RTK)
    file = tmp_path / "broken.csv"
    for text, message in (
        ("time,gyro_x\n0.0\n", "2 cells in each row, got 1 in row 1"),
        ("time,gyro_x\n0.0,x\n", "must contain numbers"),
        ("time,time\n0.0,1.0\n", "must have distinct column names"),
        ("", "must have at least one row of numbers"),
        ("time,gyro_x\n", "must have at least one row of numbers"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=message):
            replay(file, sensors=RTK)
    pytest.importorskip("pyulog")
    with pytest.raises(OSError, match="there is no file"):
        replay(tmp_path / "missing.ulg", sensors=RTK)
    (tmp_path / "broken.ulg").write_bytes(b"no log at all")
    with pytest.raises(ValueError, match="must be a ULog"):
        replay(tmp_path / "broken.ulg", sensors=RTK)


def test_command_writes_estimates_and_innovations(recorded, tmp_path):
    pytest.importorskip("matplotlib")
    recorded.write_csv(tmp_path / "flight.csv")
    options = ("flight.csv", "--sensors", "rtk", "--output", "out")
    ended = run("replay", *options, where=tmp_path, figures=True)
    assert ended.returncode == 0, ended.stderr
    assert "features" in ended.stdout
    out = tmp_path / "out"
    names = {"estimates.csv", "innovations.csv", "replay.json", "replay.png", "replay.svg"}
    assert {file.name for file in out.iterdir()} == names
    found = json.loads((out / "replay.json").read_text())
    assert found["configuration"]["sensors"] == "rtk"
    assert found["measurements"]["gnss_position"]["count"] == len(recorded.gnss) - 1
    rows = np.genfromtxt(out / "estimates.csv", delimiter=",", names=True)
    direct = replay(tmp_path / "flight.csv", sensors=RTK)
    np.testing.assert_allclose(rows["position_x"], direct.position[:, 0], atol=1e-12)
    again = run("replay", *options, where=tmp_path)
    assert again.returncode == 2
    assert "--overwrite" in again.stderr
    for wrong, message in (
        (("none.csv",), "none.csv"),
        (("flight.csv", "--course", "--heading", "3"), "--heading must not be given"),
    ):
        failed = run("replay", *wrong, where=tmp_path)
        assert failed.returncode == 2
        assert message in failed.stderr


def test_the_figure_has_a_picture_for_each_sensor(table):
    pytest.importorskip("matplotlib")
    short = {name: column[:800] for name, column in table.items()}
    figure = replay_figure(replay(short, sensors=RTK), "a flight")
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in figure.axes]
    assert len(titles) == 7
    assert any("features" in title for title in titles)


def test_offset_of_a_barometer_with_unknown_zero_changes_no_estimate():
    table = Recorded(flown(CONSUMER, 3.0), CONSUMER).table()
    log = read_log({name: np.asarray(column, float) for name, column in table.items()})
    coarse, found = np.round(256.0 * log.barometer.values["barometer"]) / 256.0, []
    for offset in (0.0, 64.0):
        barometer = dataclasses.replace(log.barometer, values={"barometer": coarse + offset})
        shifted = dataclasses.replace(log, barometer=barometer, barometer_from_start=True)
        found.append(replay(shifted, sensors=CONSUMER, start={"heading": 0.3}))
    np.testing.assert_allclose(found[1].position, found[0].position, atol=1e-9)


def test_quaternions_of_a_turn_do_not_change_their_sign():
    time = 0.02 * np.arange(1, 400)
    still = {
        "gyro": np.tile([0.0, 0.0, -1.0], (399, 1)),
        "accel": np.tile([0, 0, 9.80665], (399, 1)),
    }
    start = {"position": (0.0, 0.0, 0.0), "heading": 0.0}
    result = replay({"time": time, **still}, sensors="indoor", start=start)
    w, x, y, z = result.quaternion.T
    half = -0.5 * (result.time - time[0])
    np.testing.assert_allclose(np.stack([w, z]), [np.cos(half), np.sin(half)], atol=1e-2)
    np.testing.assert_allclose(np.stack([x, y]), 0.0, atol=1e-2)


def test_measurement_from_before_the_start_is_not_late():
    """It was taken before the first sample of the IMU, and arrives within the jitter of others."""
    suite, rng = quad_gym.sensor_suite("uwb"), np.random.default_rng(0)
    place, count = np.array([1.0, 0.5, 1.5]), 100
    ranges = np.linalg.norm(place - np.array(suite.uwb_range.anchors_I), axis=1)
    stamps = 0.005 + 0.04 * np.arange(count)
    delays = rng.uniform(0.01, 0.05, count)
    delays[[0, 5]] = 0.008, 0.001
    ticks = 0.01 * np.arange(1, 401)
    columns = {"time": np.append(ticks, stamps), "received": np.append(ticks, stamps + delays)}
    wide = np.full((len(ticks) + count, 10), np.nan)
    wide[: len(ticks), :6] = np.array([0, 0, 0, 0, 0, 9.8]) + 1e-3 * rng.normal(size=(400, 6))
    wide[len(ticks) :, 6:] = ranges + 0.1 * rng.normal(size=(count, 4))
    columns |= {"gyro": wide[:, :3], "accel": wide[:, 3:6]}
    columns |= {f"uwb_range_{k}": wide[:, 6 + k] for k in range(4)}
    order = np.argsort(columns["received"], kind="stable")
    log = {name: column[order] for name, column in columns.items()}
    result = replay(log, sensors=suite, start={"position": place, "heading": 0.0})
    assert (result.time[0], result.too_late) == (0.01, 0)
    assert not result.problems
    assert len(result.measured["uwb_range_0"].time) == count - 1
