"""Recordings for the Rerun viewer, read back from a file, hold the data of the flight."""

import sys

import numpy as np
import pytest

import quad_gym
from quad_gym.rotations import quaternion_to_dcm
from tests.builders import recorded_flight
from tests.examples import example


def flown(task="hover", steps=30, **keywords):
    return recorded_flight(task, steps, seed=3, **keywords)[1]


@pytest.fixture
def read_back(tmp_path):
    """Return a function from a flight to the columns of its recording by entity."""
    pytest.importorskip("rerun")
    recording = example("rerun_flight").rerun_recording
    chunk = pytest.importorskip("rerun.chunk", reason="this rerun-sdk cannot read files")

    def entities(flight):
        file = tmp_path / "flight.rrd"
        recording(flight).save(file)
        found = {}
        for piece in chunk.RrdReader(file).stream().to_chunks():
            batch = piece.to_record_batch()
            columns = {name: batch.column(name) for name in batch.schema.names}
            found.setdefault(piece.entity_path, {}).update(columns)
        return found

    return entities


def numbers(column):
    """Return a column with one value per row as an array."""
    return np.array([np.array(row[0], np.float64) for row in column.to_pylist()])


def seconds(entity):
    return np.array(entity["flight"].cast("int64").to_pylist()) * 1e-9


def test_rerun_poses_equal_the_flight_on_its_time_line(read_back):
    flight = flown()
    entities = read_back(flight)
    for name, position, attitude in (
        ("truth", "position", "quaternion"),
        ("estimate", "estimated_position", "estimated_quaternion"),
    ):
        entity = entities[f"/world/{name}"]
        np.testing.assert_allclose(seconds(entity), flight["time"], atol=1e-9)
        found = numbers(entity["Transform3D:translation"])
        np.testing.assert_allclose(found, flight[position], atol=1e-6)
        # a quaternion (x, y, z, w) turns by v + 2 w (u x v) + 2 u x (u x v)
        q = numbers(entity["Transform3D:quaternion"])
        u, w = q[:, :3], q[:, 3:]
        for axis in np.eye(3):
            turned = axis + 2 * w * np.cross(u, axis) + 2 * np.cross(u, np.cross(u, axis))
            expected = np.einsum("nji,j->ni", quaternion_to_dcm(flight[attitude]), axis)
            np.testing.assert_allclose(turned, expected, atol=1e-6)


def test_ellipsoids_match_the_position_covariance(read_back):
    flight = flown(steps=5)
    entity = read_back(flight)["/world/ellipsoid"]
    half = numbers(entity["Ellipsoids3D:half_sizes"])
    q = numbers(entity["Ellipsoids3D:quaternions"])
    R = np.swapaxes(quaternion_to_dcm(np.roll(q, 1, axis=1)), 1, 2)  # axes of the ellipsoid to I
    P = np.einsum("nij,nj,nkj->nik", R, (half / 3.0) ** 2, R)
    expected = flight["covariance"][:, :3, :3]
    np.testing.assert_allclose(P, expected, atol=1e-5 * expected.max())


def test_image_shows_the_measured_pixels(read_back):
    flight = flown()
    entities = read_back(flight)
    camera = "/world/truth/camera/image"
    rows = entities[f"{camera}/measured"]["Points2D:positions"].to_pylist()
    seen = np.isfinite(flight["pixels"]).all(axis=2)
    assert [len(row) for row in rows] == seen.sum(axis=1).tolist()
    assert seen.any()
    expected = (flight["pixels"] + flight.scene.half_image)[seen]
    np.testing.assert_allclose(np.concatenate([row for row in rows if row]), expected, rtol=1e-6)
    rays = entities["/world/rays"]["LineStrips3D:strips"].to_pylist()
    assert [len(row) for row in rays] == seen.sum(axis=1).tolist()
    matrix = np.reshape(entities[camera]["Pinhole:image_from_camera"].to_pylist()[0], (3, 3)).T
    ahead = matrix @ (0.1, 0.0, 1.0)  # a tenth off the axis: a tenth of the focal length
    found = ahead[:2] / ahead[2] - flight.scene.half_image
    np.testing.assert_allclose(found, [0.1 * flight.scene.focal_length, 0.0], rtol=1e-5)


def test_gnss_fixes_appear_only_at_measurement_times(read_back):
    flight = flown(sensors=quad_gym.sensor_suite("standard").with_rates(gnss=10.0))
    entity = read_back(flight)["/world/gnss"]
    measured = np.isfinite(flight["gnss_position"]).all(axis=1)
    assert measured.sum() == 7
    np.testing.assert_allclose(seconds(entity), flight["time"][measured], atol=1e-9)
    found = numbers(entity["Points3D:positions"])
    np.testing.assert_allclose(found, flight["gnss_position"][measured], atol=1e-6)


def test_plots_keep_every_bit(read_back):
    flight = flown()
    entities = read_back(flight)
    error = flight["estimated_position"] - flight["position"]
    for name, expected in (
        ("errors/tracking", flight["position_error"]),
        ("errors/estimation", flight["estimation_error"]),
        ("consistency/nees", flight["nees"]),
        ("position/up/error", error[:, 2]),
        ("position/up/upper", 3.0 * np.sqrt(flight["covariance"][:, 2, 2])),
        ("rotors/3", flight["rotor_speeds"][:, 3]),
        ("actions/0", flight["action"][:, 0]),
    ):
        found = numbers(entities[f"/plots/{name}"]["Scalars:scalars"])
        np.testing.assert_array_equal(found, expected, err_msg=name)


@pytest.mark.parametrize(
    ("keywords", "there", "missing"),
    [
        ({"observation": "truth"}, "/world/truth", "/world/estimate"),
        ({"camera": False}, "/world/estimate", "/world/features"),
        ({"sensors": "indoor"}, "/world/rays", "/world/gnss"),
        ({"task": "waypoints"}, "/world/gates", "/world/reference/path"),
    ],
)
def test_entities_without_data_are_left_out(read_back, keywords, there, missing):
    entities = read_back(flown(steps=3, **keywords))
    assert there in entities
    assert missing not in entities


def test_a_saved_flight_becomes_a_recording_on_disk(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    flown(steps=2).save(tmp_path / "flight.npz")
    files = [str(tmp_path / name) for name in ("flight.npz", "flight.rrd")]
    monkeypatch.setattr(sys, "argv", ["rerun_flight.py", *files])
    example("rerun_flight").main()
    assert (tmp_path / "flight.rrd").read_bytes()[:4] == b"RRF2"
