"""Statistics of consistency, on errors whose distribution is known."""

import numpy as np
import pytest
from scipy import stats

from quad_gym import FilterParams, sensor_suite
from quad_gym.consistency import (
    MeanSquare,
    NeesRecorder,
    flight_errors,
    mean_band,
    start_matched,
    verdict,
)
from quad_gym.simulation import FlightBatch
from tests.unit.alarms import assert_normal


def test_the_band_is_that_of_a_mean_of_chi_squares():
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
def test_a_band_of_nothing_is_refused(dimension, counts):
    with pytest.raises(ValueError, match=r"^dimension and counts must be at least 1"):
        mean_band(dimension, counts)
    with pytest.raises(ValueError, match=r"^probability must be between 0 and 1"):
        mean_band(3, [1], 1.0)


def drawn(factor, instants=400, flights=500):
    """The mean square of a filter whose errors are `factor` times what it claims."""
    rng = np.random.default_rng(2)
    mean = factor**2 * rng.chisquare(15, (instants, flights)).mean(axis=1)
    low, high = mean_band(15, np.full(instants, flights))
    return MeanSquare("state", 15, np.arange(instants) * 0.05, mean, low, high)


def test_an_honest_filter_is_called_honest_and_others_by_how_much_they_err():
    honest = drawn(1.0)
    assert honest.honest
    assert verdict(honest).endswith(": honest.")
    for factor, words in (
        (1.1, "overconfident, as errors are 10"),
        (0.9, "too cautious, as errors are 10"),
    ):
        part = drawn(factor)
        assert not part.honest
        assert part.share_inside < 0.05
        assert words in verdict(part)


def test_what_comes_before_an_instant_can_be_left_out():
    part = drawn(1.0).since(10.0)
    assert part.time[0] == 10.0
    assert part.mean.shape == part.low.shape == part.high.shape == part.time.shape == (200,)
    with pytest.raises(ValueError, match=r"^start must be before the last instant"):
        part.since(1e9)


def test_a_recorder_sees_the_errors_of_a_batch():
    """Against the definition: e^T P^-1 e from errors that were put there."""
    batch = FlightBatch(16, sensors=sensor_suite("lab").replace(camera=None))
    batch.reset(seeds=range(16))
    recorder = NeesRecorder()
    recorder.add(batch, 0.0)
    gap = batch.read("r") - batch.read("r_hat")
    P = batch.covariance()[:, :3, :3]
    expected = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(P), gap).mean()
    assert recorder.nees()["position"].mean[0] == pytest.approx(expected)
    assert recorder.nees()["state"].dimension == 15
    errors, sigmas = recorder.errors()
    np.testing.assert_allclose(errors[0, :3], np.sqrt((gap**2).mean(axis=0)))
    np.testing.assert_allclose(sigmas[0, :3] ** 2, np.diagonal(P, axis1=1, axis2=2).mean(axis=0))


def test_a_matched_start_has_errors_as_claimed_and_leaves_the_flights_alone():
    batch = FlightBatch(4000, sensors=sensor_suite("lab").replace(camera=None))
    batch.reset(seeds=range(4000))
    before = batch.snapshot()
    start_matched(batch, seed=3)
    errors, L = flight_errors(batch), batch.read("L")
    white = np.linalg.solve(L, errors[..., np.newaxis])[..., 0]
    assert_normal(white, np.zeros(15), np.eye(15))
    after = batch.snapshot()
    changed = {name for name in before.dtype.names if (before[name] != after[name]).any()}
    assert {"r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat"} >= changed - {"start_given"}
    assert {"r_hat", "R_hat"} <= changed


def test_the_defaults_are_the_reports_form():
    report = FilterParams()
    assert (report.kind, report.integration, report.covariance_reset) == ("ukf", "euler", "none")
