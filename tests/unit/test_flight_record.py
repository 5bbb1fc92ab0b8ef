"""Records of flights, and files that restore them exactly."""

import csv
import dataclasses
import json
import sys

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym import Flight, FlightRecorder
from quad_gym.batch.quantities import innovations_of
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.faults import GnssOutage, GnssOutliers
from quad_gym.flights import COLUMNS, FlightScene, table
from quad_gym.records import FaultKind, GateDecision
from quad_gym.rendering import record_flight
from quad_gym.rotations import quaternion_to_dcm
from tests.builders import recorded_flight


def at_rates(**rates):
    return quad_gym.sensor_suite("standard").with_rates(**rates)


def assert_same_flights(ours, theirs):
    assert ours.rows.dtype == theirs.rows.dtype
    for column in COLUMNS:
        assert ours[column.name].tobytes() == theirs[column.name].tobytes(), column.name
    for field in dataclasses.fields(FlightScene):
        a, b = getattr(ours.scene, field.name), getattr(theirs.scene, field.name)
        np.testing.assert_array_equal(a, b)
    assert ours.about == theirs.about


def test_seeds_and_keywords_as_numpy_scalars_are_saved(tmp_path):
    flight = record_flight(
        PDPolicy(gymnasium.make("QuadGym/Circle-v0")),
        "QuadGym/Circle-v0",
        seed=np.int64(7),
        duration=np.float32(0.5),
    )
    flight.save(tmp_path / "it.npz")
    assert Flight.load(tmp_path / "it.npz").about["seed"] == 7


def test_rows_are_control_steps_from_the_start():
    _, flight, _ = recorded_flight(steps=12, control_rate=100.0)
    assert len(flight) == 13
    np.testing.assert_allclose(flight["time"], np.arange(13) / 100.0, atol=1e-12)
    assert len(flight.until(0.05)) == 6
    assert len(flight.until(-1.0)) == 1
    with pytest.raises(ValueError, match="time must be a number, got nan"):
        flight.until(np.nan)


def test_recorded_estimate_and_reference_equal_the_observation():
    _, flight, observed = recorded_flight(layout="absolute")
    part = {f.name: f.slice for f in quad_gym.observation_layout(layout="absolute")}
    for name, column in (
        ("position", "estimated_position"),
        ("velocity", "estimated_velocity"),
        ("accel_bias", "estimated_accel_bias"),
        ("reference_position", "reference_position"),
        ("last_action", "action"),
    ):
        np.testing.assert_allclose(observed[:, part[name]], flight[column], atol=1e-6)
    R_hat = quaternion_to_dcm(flight["estimated_quaternion"]).reshape(-1, 9)
    np.testing.assert_allclose(observed[:, part["R_BI"]], R_hat, atol=1e-6)


@pytest.mark.parametrize(
    "task", ["hover", "lemniscate", "random_trajectory", "trajectory", "waypoints"]
)
def test_errors_are_distances_between_columns(task):
    _, flight, _ = recorded_flight(task)
    gap = np.linalg.norm(flight["position"] - flight["reference_position"], axis=1)
    np.testing.assert_allclose(gap, flight["position_error"], atol=1e-12)
    gap = np.linalg.norm(flight["position"] - flight["observed_position"], axis=1)
    np.testing.assert_allclose(gap, flight["estimation_error"], atol=1e-12)
    start = flight["position"][0] - flight.scene.reference(np.zeros(1))[0]
    if task != "waypoints":
        assert np.linalg.norm(start) == pytest.approx(flight["position_error"][0])


def test_gate_decisions_are_recorded_with_their_measurements():
    faults = {"faults": GnssOutliers(share=0.5, size=(50.0, 100.0))}
    env, flight, _ = recorded_flight("hover", steps=100, sensors="rtk", **faults)
    measured = np.isfinite(flight["gnss_position"]).all(axis=1)
    np.testing.assert_array_equal(measured, np.isfinite(flight["gnss_velocity"]).all(axis=1))
    miss = (flight["gnss_velocity"] - flight["velocity"])[measured]
    assert np.abs(miss).max() < 6 * 0.05 + 0.3  # the antenna turns, and the row ends later
    np.testing.assert_array_equal(np.isfinite(flight["gnss_decision"][:, 0]), measured)
    antenna_B = env.flights.batch.sensors.gnss.primary_antenna_B
    antenna = flight["position"] + antenna_B @ quaternion_to_dcm(flight["quaternion"])
    # the vehicle moves some centimeters between a fix and the end of its row
    far = np.linalg.norm(flight["gnss_position"] - antenna, axis=1) > 0.3
    assert far.sum() > 5
    np.testing.assert_array_equal(flight["gnss_decision"][far, 0], GateDecision.REJECTED)
    kept = flight["gnss_decision"][measured & ~far, 0][1:]  # the first fix is not gated
    assert (kept == GateDecision.ACCEPTED).mean() > 0.8
    np.testing.assert_array_equal(
        np.isfinite(flight["feature_decision"]), np.isfinite(flight["pixels"]).all(axis=2)
    )
    lab = recorded_flight("hover")[1]
    assert (lab["gnss_decision"][:, 0] == GateDecision.NONE).all()
    assert np.isnan(lab["gnss_decision"][:, 2]).all()  # its receiver gives no velocity


AIDED = at_rates(gnss=10.0).replace(
    barometer=quad_gym.BarometerParams(rate=25.0),
    uwb_range=quad_gym.UwbRangeParams(
        rate=10.0,
        anchors_I=((9.0, 0.0, 2.0), (0.0, 9.0, 0.5), (-9.0, 0.0, 3.0)),
        outlier_probability=0.0,
    ),
)


def test_measurements_and_decisions_of_every_sensor_are_recorded(tmp_path):
    env, flight, _ = recorded_flight("hover", steps=50, sensors=AIDED, innovations=True)
    measured = np.isfinite(flight["barometer"])
    assert 15 < measured.sum() < 40
    assert np.abs(flight["barometer"] - flight["position"][:, 2])[measured].max() < 5.0
    np.testing.assert_array_equal(np.isfinite(flight["barometer_decision"]), measured)
    assert np.isnan(flight["magnetometer"]).all()  # the suite has none
    gaps = flight["position"][:, np.newaxis] - AIDED.uwb_range.anchors_I
    measured = np.isfinite(flight["uwb_range"])
    assert measured.shape == (51, 3)
    assert measured.any(axis=0).all()
    # six standard deviations, and the way between a range and the end of its row
    assert np.abs(flight["uwb_range"] - np.linalg.norm(gaps, axis=2))[measured].max() < 0.6 + 0.1
    np.testing.assert_array_equal(np.isfinite(flight["uwb_range_decision"]), measured)
    gate = innovations_of(env.flights.batch)
    last = [
        flight[f"{name}_decision"][-1] for name in ("gnss", "feature", "barometer", "uwb_range")
    ]
    decided = np.where(gate["measured"][0], gate["gate"][0], np.nan)
    np.testing.assert_array_equal(np.hstack(last), decided)
    assert_same_flights(flight, Flight.load(flight.save(tmp_path / "aided.npz")))
    names = table(flight.rows)
    np.testing.assert_array_equal(names["uwb_range_1"], flight["uwb_range"][:, 1])
    np.testing.assert_array_equal(names["uwb_range_decision_2"], flight["uwb_range_decision"][:, 2])


def test_file_from_before_a_sensor_has_nan_in_its_columns(tmp_path):
    path = recorded_flight(sensors=AIDED)[1].save(tmp_path / "flight.npz")
    with np.load(path) as archive:
        entries = {name: archive[name] for name in archive.files}
    for name in ("barometer", "barometer_decision", "uwb_range", "uwb_range_decision"):
        del entries[f"columns/{name}"]
    np.savez_compressed(path, **entries)
    old = Flight.load(path)
    assert np.isnan(old["barometer"]).all()
    assert old["uwb_range"].shape == (len(old), 0)
    assert np.isfinite(old["gnss_position"]).any()


@pytest.mark.parametrize(
    ("column", "change"),
    [
        ("gnss_position", None),
        ("gnss_decision", None),
        ("pixels", None),
        ("pixels", lambda values: values[:, :1]),
        ("uwb_range", lambda values: values[:, 0]),
    ],
)
def test_file_without_a_column_or_with_one_of_another_shape_is_refused(tmp_path, column, change):
    path = recorded_flight(sensors=AIDED)[1].save(tmp_path / "flight.npz")
    with np.load(path) as archive:
        entries = {name: archive[name] for name in archive.files}
    values = entries.pop(f"columns/{column}")
    if change is not None:
        entries[f"columns/{column}"] = change(values)
    np.savez_compressed(path, **entries)
    with pytest.raises(ValueError, match=f"not a complete flight: .*{column}"):
        Flight.load(path)


def test_wind_and_faults_are_kept():
    outage = GnssOutage(start=0.1, duration=0.1)
    _, flight, _ = recorded_flight(world="fresh_breeze", faults=outage)
    assert np.linalg.norm(flight["wind"], axis=1).min() > 1.0
    bit = 2.0**FaultKind.GNSS_OUTAGE
    away = (flight["time"] > 0.099) & (flight["time"] < 0.199)
    np.testing.assert_array_equal(flight["faults"], np.where(away, bit, 0.0))


def test_flight_without_filter_has_nan_estimates():
    _, flight, _ = recorded_flight(observation="truth")
    assert not flight.estimated
    for name in ("estimated_position", "covariance", "nees", "gnss_position", "pixels", "gyro"):
        assert np.isnan(flight[name]).all(), name
    assert np.isfinite(flight["position"]).all()
    assert recorded_flight()[1].estimated


def test_new_episode_starts_new_flight_and_keeps_the_old_one():
    env, first, _ = recorded_flight(steps=5)
    recorder = FlightRecorder(env.flights.batch)
    env.reset(seed=1)
    recorder.keep()
    before = recorder.flight
    position = before["position"].copy()
    env.reset(seed=2)
    recorder.keep()
    np.testing.assert_array_equal(before["position"], position)
    assert len(recorder.flight) == 1
    np.testing.assert_array_equal(recorder.flight["position"], first["position"][:1])


def test_instants_after_a_restored_snapshot_are_replaced():
    """The rows are those of a flight with the same actions, and an earlier record is unchanged."""
    calm, wild = np.random.default_rng(0).uniform(-0.3, 0.3, (2, 8, 4))
    env, straight = (QuadEnv("hover", sensors="rtk", faults="gnss_outliers") for _ in range(2))
    recorder, expected = (FlightRecorder(e.flights.batch) for e in (env, straight))

    def fly(env, recorder, actions):
        for action in actions:
            env.step(action)
            recorder.keep()

    for each, kept in ((env, recorder), (straight, expected)):
        each.reset(seed=1)
        kept.keep()
        fly(each, kept, calm[:3])
    instant = env.flights.batch.snapshot()
    fly(env, recorder, calm[3:])
    before = recorder.flight
    rows = before.rows.tobytes()
    env.flights.batch.restore(instant)
    fly(env, recorder, wild)
    fly(straight, expected, wild)
    assert_same_flights(recorder.flight, expected.flight)
    assert before.rows.tobytes() == rows
    env.reset(seed=2)
    recorder.keep()
    env.flights.batch.restore(instant)  # of the episode before
    fly(env, recorder, wild[:1])
    assert recorder.flight.rows.tobytes() == expected.flight.rows[4:5].tobytes()
    assert (recorder.flight.scene.features_I == expected.flight.scene.features_I).all()


def test_rows_do_not_depend_on_when_they_are_read():
    """Episodes end during the run, so that copies of earlier episodes are dropped."""
    env = QuadVectorEnv(11, "circle", autoreset_mode="SameStep", max_episode_steps=9)
    at_once, at_the_end = (FlightRecorder(env.flights.batch, 10) for _ in range(2))
    env.reset(seed=1)
    for action in np.random.default_rng(0).uniform(-0.3, 0.3, (30, 11, 4)):
        for recorder in (at_once, at_the_end):
            recorder.keep()
        assert np.isfinite(at_once.flight["position"]).all()
        env.step(action)
    assert len(at_the_end.flight) == 3
    assert_same_flights(at_once.flight, at_the_end.flight)


def test_nothing_is_computed_for_frames_that_are_not_rendered(monkeypatch):
    """Stable-Baselines3 requests "rgb_array" in training and never renders."""
    monkeypatch.setattr("quad_gym.flights._fill", None)
    monkeypatch.setattr("quad_gym.rendering.renderer.Renderer", None)
    for render_mode in (None, "rgb_array"):
        env = QuadEnv("hover", render_mode=render_mode, max_episode_steps=5)
        for _ in range(2):
            env.reset(seed=0)
            for _ in range(5):
                env.step(np.zeros(4))
    with pytest.raises(TypeError):
        env.render()


def test_recording_a_missing_flight_raises_value_error():
    env = QuadEnv("hover")
    for flight, message in ((1, "at most 0, got 1"), (-1, "at least 0"), (0.5, "a whole number")):
        with pytest.raises(ValueError, match=f"flight must be {message}"):
            FlightRecorder(env.flights.batch, flight)
    with pytest.raises(ValueError, match="reset"):
        _ = FlightRecorder(env.flights.batch).flight


def test_recording_does_not_change_the_flight_of_a_policy():
    keywords = {"observation": "estimate", "sensors": "lab"}
    env = gymnasium.make("QuadGym/Waypoints-v0", **keywords)
    policy = PDPolicy(env)
    flight = record_flight(policy, "QuadGym/Waypoints-v0", seed=6, about={"by": "pd"}, **keywords)
    observation, _ = env.reset(seed=6)
    errors, over = [], False
    while not over:
        observation, _, terminated, truncated, info = env.step(policy.predict(observation)[0])
        errors.append(info["position_error"])
        over = terminated or truncated
    np.testing.assert_array_equal(flight["position_error"][1:], errors)
    assert flight.about == {"seed": 6, "env_id": "QuadGym/Waypoints-v0", "by": "pd"}
    with pytest.raises(ValueError, match="time limit"):
        record_flight(policy, "QuadGym/Waypoints-v0", duration=0.0)


SAVED = [{}, {"task": "waypoints"}, {"observation": "truth"}, {"camera": False}]
SAVED += [{"sensors": at_rates(gnss=10.0, camera=20.0)}]


@pytest.mark.parametrize("keywords", SAVED, ids=str)
def test_a_saved_flight_loads_bit_for_bit(tmp_path, keywords):
    _, flight, _ = recorded_flight(**keywords)
    file = flight.save(tmp_path / "new" / "flight.npz")
    assert [f.name for f in file.parent.iterdir()] == ["flight.npz"]
    assert_same_flights(Flight.load(file), flight)


def with_header(**changes):
    def change(entries):
        entries["header"] = np.array(json.dumps(json.loads(str(entries["header"])) | changes))

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_header(version=2), "version 2"),
        (with_header(format="other"), "not a flight"),
        (lambda e: e.pop("header"), "not a flight"),
        (lambda e: e.pop("columns/position"), "columns/position"),
        (lambda e: e.pop("scene/R_CB"), "R_CB"),
        (lambda e: e.update({"columns/nees": np.zeros(3)}), "column nees"),
        (lambda e: e.update({"columns/time": np.zeros(0)}), "no rows"),
        (lambda e: e.update({"columns/position": np.zeros((13, 3), "f4")}), "float64"),
    ],
)
def test_files_of_another_kind_are_refused(tmp_path, change, message):
    path = recorded_flight()[1].save(tmp_path / "flight.npz")
    with np.load(path) as archive:  # by NumPy alone
        entries = {name: archive[name] for name in archive.files}
    change(entries)
    np.savez_compressed(path, **entries)
    with pytest.raises(ValueError, match=rf"flight\.npz.*{message}"):
        Flight.load(path)


def test_damaged_files_are_refused(tmp_path):
    file = recorded_flight()[1].save(tmp_path / "flight.npz")
    whole = file.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 0xFF]) + whole[middle + 1 :]
    for content in (b"", b"hello", whole[:middle], whole[:-1], flipped):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"flight\.npz"):
            Flight.load(file)
    with pytest.raises(FileNotFoundError):
        Flight.load(tmp_path / "nowhere.npz")


def test_an_interrupted_save_leaves_the_old_file(tmp_path):
    _, flight, _ = recorded_flight()
    file = flight.save(tmp_path / "flight.npz")
    before = file.read_bytes()
    with pytest.raises(TypeError):
        dataclasses.replace(flight, about={"bad": object()}).save(file)
    assert file.read_bytes() == before
    assert [f.name for f in tmp_path.iterdir()] == ["flight.npz"]


def test_csv_keeps_every_number(tmp_path):
    _, flight, _ = recorded_flight(sensors=at_rates(gnss=10.0))
    with flight.to_csv(tmp_path / "flight.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(flight)
    for name, values in table(flight.rows).items():
        read = np.array([float(row[name] or "nan") for row in rows])
        np.testing.assert_array_equal(read, values, err_msg=name)
    assert rows[1]["gnss_position_x"] == ""


def test_the_table_names_every_number_once():
    _, flight, _ = recorded_flight()
    columns = table(flight.rows)
    numbers = sum(int(np.prod(flight[c.name].shape[1:])) for c in COLUMNS)
    assert len(columns) == numbers - 225 + 15  # only standard deviations of the covariance
    np.testing.assert_array_equal(columns["quaternion_w"], flight["quaternion"][:, 0])
    np.testing.assert_array_equal(columns["rotor_speeds_3"], flight["rotor_speeds"][:, 3])
    np.testing.assert_array_equal(columns["gnss_decision_velocity"], flight["gnss_decision"][:, 2])
    np.testing.assert_array_equal(columns["feature_decision_1"], flight["feature_decision"][:, 1])
    np.testing.assert_array_equal(columns["pixels_1_y"], flight["pixels"][:, 1, 1])
    sigma = np.sqrt(flight["covariance"][:, 4, 4])
    np.testing.assert_array_equal(columns["sigma_velocity_y"], sigma)


def test_pandas_gets_the_same_table(monkeypatch):
    pytest.importorskip("pandas")
    _, flight, _ = recorded_flight()
    frame = flight.to_pandas()
    assert frame.index.name == "time"
    np.testing.assert_array_equal(frame.index, flight["time"])
    for name, values in table(flight.rows).items():
        if name != "time":
            np.testing.assert_array_equal(frame[name], values)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"quad-gym\[pandas\]"):
        flight.to_pandas()
