"""Updates by images in steps equal one update if the model is linear, and are consistent if not."""

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.records import FEATURE_SLICE, GateDecision
from quad_gym.sensors import Camera
from tests.field_flights import fly, state_errors
from tests.filter_states import set_at_rest
from tests.unit.alarms import ALARM

INDOOR = quad_gym.sensor_suite("indoor").simplified()


def with_recursive(above, kind="ukf"):
    camera = INDOOR.camera.replace(phase=0.0)
    estimator = INDOOR.estimator.replace(recursive_update_threshold=above, kind=kind)
    return INDOOR.replace(camera=camera, estimator=estimator)


def started(above, sigma, gate=0.0):
    """A filter before its first image, with attitude uncertainty `sigma`, and that image."""
    suite = with_recursive(above)
    suite = suite.replace(estimator=suite.estimator.replace(false_alarm_probability=gate))
    ukf = quad_gym.UnscentedKalmanFilter(suite)
    P = np.diag(np.repeat([0.05, 0.03, sigma, 0.2, 0.01], 3) ** 2)
    set_at_rest(ukf, P, position=(0.5, -0.3, 1.2))
    camera = Camera(suite.camera, rng=np.random.default_rng(3))
    return ukf, camera.measure((0.53, -0.35, 1.22), np.eye(3))


def test_update_in_steps_equals_one_update_if_the_measurement_is_linear():
    whole, pixels = started(None, 1e-5)
    parts, _ = started(1e-6, 1e-5)
    before = whole.covariance
    whole.update(pixels=pixels)
    parts.update(pixels=pixels)
    scale = np.sqrt(np.diag(whole.covariance))
    assert (scale[:3] < 0.3 * np.sqrt(np.diag(before))[:3]).all()
    off = np.abs(parts.position - whole.position) / scale[:3]
    assert off.max() < 0.05  # the rest is the curvature of the position
    np.testing.assert_allclose(
        parts.covariance / np.outer(scale, scale),
        whole.covariance / np.outer(scale, scale),
        atol=0.02,
    )
    assert np.isfinite(whole.nis[0])
    assert np.isnan(parts.nis[0])
    np.testing.assert_array_equal(parts.block_nis, whole.block_nis)


def test_rejected_feature_is_left_out_of_every_step():
    clean, pixels = started(0.01, 0.03, gate=1e-4)
    wrong, _ = started(0.01, 0.03, gate=1e-4)
    seen = np.flatnonzero(np.isfinite(pixels[:, 0]))
    corrupt, without = pixels.copy(), pixels.copy()
    corrupt[seen[0]] += 900.0
    without[seen[0]] = np.nan
    wrong.update(pixels=corrupt)
    clean.update(pixels=without)
    assert (wrong.gate_decisions == GateDecision.REJECTED).sum() == 1
    np.testing.assert_allclose(wrong.position, clean.position, atol=1e-6)
    np.testing.assert_allclose(wrong.covariance, clean.covariance, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_vague_start_is_consistent_only_if_images_update_in_steps(kind):
    sums = {}
    for above in (0.01, None):
        batch = fly(with_recursive(above, kind), 2000, task="hover")
        errors, L = state_errors(batch), batch.record("L")
        white = np.linalg.solve(L, errors[..., np.newaxis])[..., 0]
        sums[above] = (white**2).sum()
        assert (batch.record("block_valid")[:, FEATURE_SLICE].sum(axis=1) > 0).mean() > 0.99
    expected = stats.chi2(15 * 2000)
    assert expected.cdf(sums[0.01]) < 1.0 - ALARM
    assert expected.cdf(sums[0.01]) > ALARM
    assert expected.sf(sums[None]) < ALARM


@pytest.mark.parametrize("distance", [3.0, 30.0])
def test_filter_without_a_gate_omits_features_of_uncertain_direction(distance):
    """With a position uncertain by 1 m, directions at 3 m are left out; at 30 m they are used."""
    suite = quad_gym.sensor_suite("standard")
    points = ((distance, 0.0, 0.0), (distance, 0.2, 0.0))
    camera = suite.camera.replace(features_I=points, attitude=INDOOR.camera.attitude)
    suite = suite.replace(camera=camera)
    ukf = quad_gym.UnscentedKalmanFilter(suite)
    covariance = np.diag(np.repeat([1.0, 0.1, 0.01, 0.2, 0.01], 3) ** 2)
    set_at_rest(ukf, covariance)
    pixels = Camera(camera, rng=np.random.default_rng(3)).measure((0.1, 0.4, 0.2), np.eye(3))
    assert np.isfinite(pixels).all()
    for name in ("innovation", "innovation_sigma", "block_nis"):
        ukf._engine.blocks[name] = 1.0  # from an earlier image
    ukf.update(pixels=pixels)
    left_out = distance < 10.0
    kept = ukf.last_update
    for values in (kept.innovation[-2:, 0], kept.sigma[-2:, 0], kept.nis[-2:]):
        assert (np.isnan(values) == left_out).all()
    assert (np.abs(ukf.covariance - covariance).max() < 1e-12) == left_out
    assert (np.abs(ukf.position).max() < 1e-9) == left_out
