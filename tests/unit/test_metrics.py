"""Errors, consistency and intervals against known distributions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from quad_gym.analysis import metrics
from quad_gym.rotations import euler_to_dcm


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    factor = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-3, 3, size=(n, 1))
    return factor @ factor.T


class TestTrackingSummary:
    @pytest.mark.parametrize("instants", [1, 2, 7])
    def test_means_over_the_flight_and_over_its_last_half(self, instants):
        errors = np.random.default_rng(0).exponential(size=(5, instants))
        running = metrics.RunningSummary(5, instants)
        for error in errors.T:
            running.add(error)
        found = running.result()
        last = errors[:, instants // 2 :]  # includes the middle one of an odd number
        np.testing.assert_allclose(found.mean, errors.mean(axis=1), rtol=1e-13)
        np.testing.assert_allclose(found.last_half, last.mean(axis=1), rtol=1e-13)

    def test_flights_that_have_ended_do_not_count(self):
        running = metrics.RunningSummary(2, 4)
        for error, counts in zip([1.0, 2.0, 3.0, np.nan], [True, True, True, False], strict=True):
            running.add([error, 1.0], [counts, True])
        assert running.result().mean.tolist() == [2.0, 1.0]
        assert running.result().last_half.tolist() == [3.0, 1.0]
        short = metrics.RunningSummary(1, 4)
        for counts in (True, False, False, False):
            short.add([1.0], [counts])
        assert np.isnan(short.result().last_half).all()

    def test_spreads_of_chosen_flights(self):
        found = metrics.TrackingSummary(np.array([1.0, 2.0, 9.0]), np.array([5.0, 5.0, np.nan]))
        spreads = found.spreads([True, True, False])
        assert (spreads["mean"].count, spreads["mean"].mean) == (2, 1.5)
        assert spreads["last_half"].mean == 5.0


def test_spread_of_known_numbers():
    found = metrics.spread([1.0, 2.0, 3.0, 4.0, 10.0])
    assert (found.count, found.mean, found.median, found.largest) == (5, 4.0, 3.0, 10.0)
    assert found.sd == pytest.approx(np.sqrt(50.0 / 4))
    assert (found.low, found.high) == pytest.approx((1.2, 8.8))
    equal = metrics.spread(np.full(1000, 0.1))
    assert (equal.mean, equal.sd) == (0.1, 0.0)
    one, none = metrics.spread([2.0]), metrics.spread([])
    assert (one.mean, none.count) == (2.0, 0)
    assert np.isnan([one.sd, none.mean]).all()


def test_chi_square_band_and_quantile_agree_with_tables():
    # 2.5 % and 97.5 % points of chi-square with 15 degrees of freedom
    assert metrics.chi_square_band(15) == pytest.approx((6.262, 27.488), abs=5e-4)
    assert metrics.chi_square_quantile(15, 0.999) == pytest.approx(37.697, abs=5e-4)
    means = np.random.default_rng(5).chisquare(15, size=(4000, 10)).mean(axis=1)
    band = metrics.chi_square_band(15, 10, 0.9)
    assert np.mean([band.holds(m) for m in means]) == pytest.approx(0.9, abs=0.015)


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        *((metrics.chi_square_band, bad, "must be") for bad in ((0,), (15, 0), (15, 1, 1.0))),
        *((metrics.chi_square_quantile, bad, "must be") for bad in ((0, 0.5), (15, 2.0))),
        *(
            (metrics.nees, (np.ones(2), P), r"covariances must have shape \(\.\.\., n, n\)")
            for P in (np.eye(3), np.ones(2), np.ones((2, 3)))
        ),
        (metrics.nees, (np.ones(2), np.zeros((2, 2))), "singular"),
    ],
)
def test_invalid_numbers_are_refused(function, arguments, message):
    with pytest.raises(ValueError, match=message):
        function(*arguments)


@pytest.mark.parametrize("vector", [False, True])
@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_estimate_plus_error_is_the_truth(shape, vector):
    names, rng = ("position", "velocity", "accel_bias", "gyro_bias"), np.random.default_rng(3)
    truth, estimate = (
        {name: rng.normal(size=(*shape, 3)) for name in names}
        | {"R_BI": euler_to_dcm(rng.uniform(-1, 1, size=(*shape, 3)))}
        for _ in range(2)
    )
    x = metrics.state_error(truth, estimate, rotation_vector=vector)
    assert x.shape == (*shape, 15)
    for name, first in zip(names, (0, 3, 9, 12), strict=True):
        error = x[..., first : first + 3]
        np.testing.assert_allclose(estimate[name] + error, truth[name], atol=1e-15)
    e = x[..., 6:9].reshape(-1, 3)  # SciPy rotates from B to I
    R = Rotation.from_rotvec(-e).as_matrix().reshape(*shape, 3, 3)
    R_BI = (R if vector else euler_to_dcm(x[..., 6:9])) @ estimate["R_BI"]
    np.testing.assert_allclose(R_BI, truth["R_BI"], atol=1e-14)


def test_nees_of_consistent_errors_is_chi_square():
    rng = np.random.default_rng(2)
    P = random_covariance(rng, 15)
    errors = rng.normal(size=(4000, 15)) @ np.linalg.cholesky(P).T
    values = metrics.nees(errors, np.broadcast_to(P, (4000, 15, 15)))
    assert values.shape == (4000,)
    assert kstest(values, "chi2", args=(15,)).pvalue > 0.01
    assert metrics.chi_square_band(15, 4000, 0.999).holds(values.mean())
    assert metrics.nees([2.0, 3.0], np.diag([4.0, 0.25])) == pytest.approx(1.0 + 36.0)
