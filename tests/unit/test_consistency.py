"""Consistency statistics on errors with a known distribution."""

import numpy as np
import pytest
from scipy import stats

from quad_gym import sensor_suite
from quad_gym.analysis.consistency import (
    InnovationRecorder,
    MeanSquare,
    NeesRecorder,
    flight_errors,
    verdict,
)
from quad_gym.analysis.metrics import mean_band
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import FEATURE_BLOCKS, MAX_BLOCKS, POSITION_BLOCK, GateDecision
from tests.consistent import start_matched
from tests.unit.alarms import assert_normal


def test_mean_band_matches_mean_of_chi_squares():
    low, high = mean_band(15, [1000])
    assert low[0] == pytest.approx(14.66, abs=5e-3)
    assert high[0] == pytest.approx(15.34, abs=5e-3)
    low, high = mean_band(3, [1000, 10, 1])
    assert (low[0], high[0]) == (pytest.approx(2.85, abs=5e-3), pytest.approx(3.15, abs=5e-3))
    assert (np.diff(high - low) > 0.0).all()
    rng = np.random.default_rng(1)
    means = rng.chisquare(3, (20_000, 10)).mean(axis=1)
    inside = ((means >= low[1]) & (means <= high[1])).sum()
    assert stats.binomtest(int(inside), len(means), 0.95).pvalue > 1e-6


@pytest.mark.parametrize(("dimension", "counts"), [(0, [1]), (3, [0]), (3, [])])
def test_invalid_arguments_of_mean_band_raise_value_error(dimension, counts):
    with pytest.raises(ValueError, match=r"^dimension and counts must be at least 1"):
        mean_band(dimension, counts)
    with pytest.raises(ValueError, match=r"^probability must be between 0 and 1"):
        mean_band(3, [1], 1.0)


def drawn(factor, instants=400, flights=500):
    """Return the mean NEES of a filter whose errors are `factor` times its standard deviations."""
    rng = np.random.default_rng(2)
    mean = factor**2 * rng.chisquare(15, (instants, flights)).mean(axis=1)
    low, high = mean_band(15, np.full(instants, flights))
    return MeanSquare("state", 15, np.arange(instants) * 0.05, mean, low, high)


def test_verdict_is_consistent_or_the_ratio_of_errors():
    consistent = drawn(1.0)
    assert consistent.consistent
    assert verdict(consistent).endswith("consistent.")
    part = consistent.since(10.0)
    assert part.mean.shape == part.low.shape == part.high.shape == part.time.shape == (200,)
    with pytest.raises(ValueError, match=r"^start must be before the last instant"):
        part.since(1e9)
    for factor, words in (
        (1.1, "overconfident, errors are 10"),
        (0.9, "too cautious, errors are 10"),
        (2.5, "overconfident, errors are 2.5 times as large as its covariance implies"),
    ):
        part = drawn(factor)
        assert not part.consistent
        assert part.share_inside < 0.05
        assert words in verdict(part)


def test_nees_recorder_computes_mean_nees_and_errors_of_a_batch():
    """The mean NEES equals its definition, the mean of e^T P^-1 e."""
    batch = FlightBatch(16, sensors=sensor_suite("lab").replace(camera=None))
    batch.reset(seeds=range(16))
    recorder = NeesRecorder()
    recorder.add(batch, 0.0)
    gap = batch.record("r") - batch.record("r_hat")
    P = batch.covariance()[:, :3, :3]
    expected = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(P), gap).mean()
    assert recorder.nees()["position"].mean[0] == pytest.approx(expected)
    assert recorder.nees()["state"].dimension == 15
    errors, sigmas = recorder.errors()
    np.testing.assert_allclose(errors[0, :3], np.sqrt((gap**2).mean(axis=0)))
    np.testing.assert_allclose(sigmas[0, :3] ** 2, np.diagonal(P, axis1=1, axis2=2).mean(axis=0))


def test_matched_start_draws_errors_from_the_filter_covariance():
    batch = FlightBatch(4000, sensors=sensor_suite("lab").replace(camera=None))
    batch.reset(seeds=range(4000))
    before = batch.snapshot()
    start_matched(batch, seed=3)
    errors, L = flight_errors(batch), batch.record("L")
    white = np.linalg.solve(L, errors[..., np.newaxis])[..., 0]
    assert_normal(white, np.zeros(15), np.eye(15))
    after = batch.snapshot()
    changed = {
        name for name in before.dtype.names if before[name].tobytes() != after[name].tobytes()
    }
    assert changed <= {"r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat"}
    assert {"r_hat", "R_hat"} <= changed


class Measured:
    """A substitute for a batch, with given innovations."""

    count = 300

    def __init__(self, innovations, nis, seen):
        blocks = (self.count, MAX_BLOCKS)
        self.fields = {
            "block_valid": seen,
            "innovation": np.repeat(innovations[:, np.newaxis], MAX_BLOCKS, axis=1),
            "innovation_sigma": np.full((*blocks, 3), 2.0),
            "block_nis": np.repeat(nis[:, np.newaxis], MAX_BLOCKS, axis=1),
            "gate": np.full(blocks, float(GateDecision.NONE)),
        }

    def record(self, name):
        return self.fields[name]


def recorded(memory, factor=1.0, instants=200):
    """Record innovations with correlation `memory` between successive ones; 30 % are missing."""
    rng = np.random.default_rng(5)
    seen = np.zeros((Measured.count, MAX_BLOCKS))
    recorder = None
    now = rng.normal(size=(Measured.count, 3))
    for k in range(1, instants + 1):
        fresh = rng.normal(size=now.shape)
        has = rng.random(Measured.count) < 0.7
        following = memory * now + np.sqrt(1.0 - memory**2) * fresh
        now = np.where(has[:, np.newaxis], following, now)
        seen[:, POSITION_BLOCK] = has
        batch = Measured(2.0 * factor * now, factor**2 * (now**2).sum(axis=1), seen)
        recorder = recorder or InnovationRecorder(batch, np.linspace(0.0, 10.0, 21), lags=5)
        recorder.add(batch, 0.05 * k)
    return recorder


def test_white_innovations_are_white_and_have_a_consistent_nis():
    recorder = recorded(0.0)
    assert set(recorder.nis()) == set(recorder.whiteness()) == {"position"}
    white = recorder.whiteness()["position"]
    assert white.white
    assert (np.abs(white.correlation) < 3.0 * white.band).all()
    # 300 flights, 70 % of 200 instants, 3 components, minus the first lags
    assert white.band[0] == pytest.approx(1.96 / np.sqrt(300 * 0.7 * 200 * 3), rel=0.02)
    nis = recorder.nis()["position"]
    assert nis.time[0] == pytest.approx(0.25)
    assert nis.consistent


def test_correlated_innovations_are_not_white():
    white = recorded(0.3).whiteness()["position"]
    assert not white.white
    np.testing.assert_allclose(white.correlation, 0.3 ** np.arange(1, 6), atol=0.02)
    assert white.largest == white.correlation[0]


def test_large_innovations_are_white_and_have_a_large_nis():
    recorder = recorded(0.0, factor=1.2)
    assert recorder.nis()["position"].overall == pytest.approx(1.44 * 3.0, rel=0.02)
    assert not recorder.nis()["position"].consistent
    assert recorder.whiteness()["position"].white


def test_nis_of_an_image_uses_its_first_visible_feature():
    seen = np.zeros((Measured.count, MAX_BLOCKS))
    seen[:, FEATURE_BLOCKS + 2 : FEATURE_BLOCKS + 5] = 1.0
    batch = Measured(np.ones((Measured.count, 3)), np.ones(Measured.count), seen)
    batch.fields["block_nis"] = np.tile(np.arange(MAX_BLOCKS, dtype=float), (Measured.count, 1))
    recorder = InnovationRecorder(batch, [0.0, 1.0])
    recorder.add(batch, 0.5)
    nis = recorder.nis()["feature"]
    assert nis.dimension == 2
    assert nis.overall == FEATURE_BLOCKS + 2
