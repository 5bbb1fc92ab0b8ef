"""Features with drawn positions in each episode, and a filter with the drawn map."""

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym import Cylinder, FlightBatch, Randomization, TaskParams, Uniform, Wall, WorldParams
from quad_gym.batch.starts import hidden_points
from quad_gym.flights import FlightRecorder
from quad_gym.records import FEATURE_SLICE
from quad_gym.rotations import quaternion_to_dcm
from tests.contract.configurations import FEATURES
from tests.field_flights import nees
from tests.unit.alarms import alarm_score

INDOOR = quad_gym.sensor_suite("indoor").simplified()
NOMINAL = np.array(INDOOR.camera.features_I)
TASK = TaskParams(kind="circle", start="hover", duration=0.0)


def batch(count=4, **options):
    options = {"sensors": INDOOR, "randomization": FEATURES, "task": TASK} | options
    flights = FlightBatch(count, **options)
    flights.reset(seeds=range(count))
    return flights


def places(drawn, nominal=NOMINAL):
    """Return feature positions (n, m, 3) by the formula."""
    yaw, zero = drawn["features_yaw"], np.zeros(len(drawn["features_yaw"]))
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]])
    moved = nominal + drawn["feature_offsets_I"]
    return np.einsum("ijn,nmj->nmi", R, moved) + drawn["features_shift_I"][:, None]


def test_drawn_features_follow_their_distributions():
    flights = batch(2000, run_filter=False, source=quad_gym.records.Source.TRUTH)
    drawn = flights.drawn()
    offsets = drawn["feature_offsets_I"]
    assert offsets.shape == (2000, len(NOMINAL), 3)
    samples = {
        "yaw": (drawn["features_yaw"], stats.uniform(-np.pi, 2.0 * np.pi)),
        "north": (drawn["features_shift_I"][:, 1], stats.uniform(0.0, 2.0)),
        "first": (offsets[:, 0, 0], stats.uniform(-0.3, 0.6)),
        "last": (offsets[:, -1, 2], stats.uniform(-0.4, 0.8)),
    }
    for name, (values, distribution) in samples.items():
        assert stats.kstest(values, distribution.cdf).pvalue > 1e-6, name
    assert (offsets[:, :, 1] == 0.0).all()
    both = np.hstack([offsets[:, :, 0], offsets[:, :, 2], drawn["features_shift_I"]])
    correlation = np.corrcoef(both.T) - np.eye(both.shape[1])
    assert np.abs(correlation).max() < 6.0 / np.sqrt(2000)
    np.testing.assert_allclose(flights.feature_places(), places(drawn), atol=1e-12)


@pytest.mark.parametrize("known", [False, True])
def test_flight_with_drawn_features_equals_flight_with_given_features(known):
    flights = batch(3, randomization=Randomization(FEATURES, known=known))
    for _ in range(100):
        flights.step()
    place = tuple(map(tuple, flights.feature_places()[1]))
    told = INDOOR.replace(camera=INDOOR.camera.replace(features_I=place))
    alone = batch(2, sensors=told, randomization=None)
    for _ in range(100):
        alone.step()
    for name in ("pixels", "r", "r_hat", "R_hat", "b_a_hat", "L"):
        np.testing.assert_allclose(
            flights.record(name)[1], alone.record(name)[1], rtol=1e-7, atol=1e-9, err_msg=name
        )


def test_each_episode_draws_its_own_and_seeds_repeat_them():
    flights = batch()
    first = flights.feature_places()
    recorder = FlightRecorder(flights, 2)
    recorder.keep()
    np.testing.assert_array_equal(recorder.flight.scene.features_I, first[2])
    flights.reset()
    assert (flights.feature_places() != first).any(axis=(1, 2)).all()
    flights.reset(mask=[True, False, False, True])
    flights.reset(seeds=range(4))
    assert (flights.feature_places() == first).all()
    assert (batch(9).feature_places()[:4] == first).all()


def test_map_error_rotates_with_the_drawn_map():
    """All markers are 0.2 m from the filter's map, and the camera measures the true ones."""
    wrong = NOMINAL + np.array([0.2, 0.0, 0.0])
    camera = INDOOR.camera.replace(features_I=tuple(map(tuple, wrong)), pixel_sigma=1e-3)
    flights = batch(6, true_sensors=INDOOR.replace(camera=camera))
    for _ in range(10):
        flights.step()
    seen = flights.record("block_valid")[:, FEATURE_SLICE][:, : len(NOMINAL)] > 0.0
    assert seen.any()
    true = places(flights.drawn(), wrong)
    R_BI = quaternion_to_dcm(flights.record("q"))
    v_B = np.einsum("nij,nmj->nmi", R_BI, true - flights.record("r")[:, None])
    v_C = (v_B - INDOOR.camera.position_B) @ np.array(flights._model["R_CB"][0, ..., 0]).T
    pixels = INDOOR.camera.focal_length * v_C[..., :2] / v_C[..., 2:]
    np.testing.assert_allclose(
        flights.record("pixels")[:, : len(NOMINAL)][seen], pixels[seen], atol=0.01
    )
    np.testing.assert_allclose(flights.feature_places(), places(flights.drawn()), atol=1e-12)


@pytest.mark.parametrize("drawn", [False, True])
def test_filter_with_known_sensors_uses_the_true_feature_map(drawn):
    wrong = NOMINAL + np.array([0.2, 0.0, 0.0])
    true = INDOOR.replace(camera=INDOOR.camera.replace(features_I=tuple(map(tuple, wrong))))
    for known, map_I in ((True, wrong), (False, NOMINAL)):
        randomization = Randomization(FEATURES if drawn else {}, known=known)
        flights = batch(3, true_sensors=true, randomization=randomization)
        expected = places(flights.drawn(), map_I) if drawn else [map_I] * 3
        np.testing.assert_allclose(flights.feature_places(), expected, atol=1e-12)


@pytest.mark.parametrize(
    "options",
    [{}, {"sensors": "indoor"}, {"filter_start": "warm"}, {"sensors": INDOOR.replace(
        estimator=INDOOR.estimator.replace(kind="ekf"))}],
    ids=["cold", "late and imperfect", "warm", "ekf"],
)  # fmt: skip
def test_filter_stays_consistent_with_drawn_features(options):
    """The mean over 400 flights of a NEES with 15 degrees of freedom is 15 +- 0.27."""
    flights = batch(400, **options)
    for _ in range(600):
        flights.step()
    found = nees(flights).mean()
    assert 12.0 < found < 15.0 + alarm_score(1) * np.sqrt(30.0 / 400), found


def test_features_behind_obstacles_are_not_seen():
    world = WorldParams(
        obstacles=(
            Wall(center_I=(5.0, 0.0, 1.0), size=(0.2, 6.0, 4.0), shift_I=(0.0, 2.0, 0.0)),
            Cylinder(center_I=(-6.0, 2.0, 1.5), radius=0.6),
        ),
        vehicle_radius=0.1,
    )
    flights, hid, saw = batch(64, world=world), 0, 0
    for _ in range(60):
        flights.step()
        R_BI, r = quaternion_to_dcm(flights.record("q")), flights.record("r")
        eyes = r + np.einsum("nji,j->ni", R_BI, np.array(INDOOR.camera.position_B))
        centers = flights.record("obstacle_center")[:, :2]
        hidden = hidden_points(world.obstacles, centers, eyes, flights.feature_places())
        seen = flights.record("block_valid")[:, FEATURE_SLICE][:, : len(NOMINAL)] > 0.0
        assert not (seen & hidden).any()
        hid, saw = hid + int(hidden.sum()), saw + int(seen.sum())
    assert hid > 100
    assert saw > 100


@pytest.mark.parametrize(
    ("draws", "options", "message"),
    [
        ({"features_yaw": Uniform(-1.0, 1.0)}, {"sensors": INDOOR.replace(camera=None)}, "camera"),
        ({"feature_offsets_I": (Uniform(0, 1), None)}, {}, "feature_offsets_I.*3 of them"),
        ({"features_shift_I": Uniform(0.0, 1e6)}, {}, "features_shift_I.*at most"),
        ({"features_yaw": Uniform(-90.0, 90.0)}, {}, "features_yaw' must be in rad"),
        ({"start_yaw": Uniform(0.0, 45.0)}, {}, r"start_yaw' must be in rad.*mean 0\.7854"),
        ({"features_yaw": Uniform(0.5, 1.0, relative=True)}, {}, "features_yaw.*relative"),
    ],
)
def test_invalid_feature_draws_raise_value_error(draws, options, message):
    with pytest.raises(ValueError, match=message):
        FlightBatch(1, **{"sensors": INDOOR, **options}, randomization=draws)
