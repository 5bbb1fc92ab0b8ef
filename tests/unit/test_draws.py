"""No two noises of an instant share a draw: all that is sampled from one stream is independent."""

import numpy as np
import pytest

import quad_gym
from quad_gym.kernels.entries import sense_features, sense_gnss, sense_imu, step_biases
from quad_gym.packing.flight import params_record
from quad_gym.records import FEATURE_SLICE, FLIGHT
from tests.unit.alarms import alarm_score

COUNT = 10_000


@pytest.fixture(scope="module")
def readings():
    """All sensors and biases of one flight at rest, over many instants: (COUNT, n), scaled."""
    # features spread over the image, straight ahead of a camera that looks along x
    features = [(10.0, y, z) for y in (-3.0, -1.0, 1.0, 3.0) for z in (-2.0, 0.0, 1.0, 2.0)]
    camera = quad_gym.CameraParams(attitude=np.radians((90.0, 0.0, 90.0)), features_I=features)
    suite = quad_gym.SensorSuite(camera=camera)
    flight, params = np.zeros(1, FLIGHT), params_record(quad_gym.VehicleParams(), suite)
    flight["q"], flight["key"] = (1.0, 0.0, 0.0, 0.0), (12, 34)
    rows = []
    for instant in range(COUNT):
        flight["instant"], flight["b_a"], flight["b_g"] = instant, 0.0, 0.0
        sense_imu(flight, params)
        sense_gnss(flight, params, True)
        sense_features(flight, params, len(features))
        step_biases(flight, params)
        names = ("accel", "gyro", "gnss_position", "gnss_baseline", "b_a", "b_g", "pixels")
        rows.append(np.concatenate([flight[name][0].ravel() for name in names]))
    assert flight["block_valid"][:, FEATURE_SLICE].sum() == len(features)
    noise = np.array(rows)
    return (noise - noise.mean(axis=0)) / noise.std(axis=0)


def test_different_noises_are_independent(readings):
    correlation = readings.T @ readings / COUNT
    # components of one GNSS vector are correlated in G, where its covariance is not diagonal
    same = np.eye(len(correlation), dtype=bool)
    same[6:9, 6:9] = same[9:12, 9:12] = True
    scores = correlation[~same] * np.sqrt(COUNT)
    assert np.abs(scores).max() < alarm_score(scores.size)


def test_noises_of_successive_instants_are_independent(readings):
    scores = readings[1:].T @ readings[:-1] / np.sqrt(COUNT)
    assert np.abs(scores).max() < alarm_score(scores.size)
