"""Statistics over few seeds, against closed forms and SciPy."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, norm

from quad_gym.analysis.robust import (
    Estimated,
    estimated,
    interquartile_mean,
    probability_of_improvement,
    worst_tenth,
)


def test_the_interquartile_mean_of_five_is_that_of_the_middle_three():
    assert interquartile_mean([100.0, 1.0, 2.0, 3.0, -50.0]) == 2.0
    assert interquartile_mean([7.0]) == 7.0
    assert interquartile_mean([1.0, 3.0]) == 2.0
    np.testing.assert_allclose(interquartile_mean([[1.0, 2, 3, 4], [5, 6, 7, 80]]), [2.5, 6.5])


def test_the_interquartile_mean_of_an_exponential_distribution():
    # the mean of -log(1 - p) for p from 1/4 to 3/4, where the integral of -log(u) is u - u log(u)
    exact = 2.0 * ((0.75 - 0.75 * np.log(0.75)) - (0.25 - 0.25 * np.log(0.25)))
    found = interquartile_mean(np.random.default_rng(0).exponential(size=400_000))
    np.testing.assert_allclose(found, exact, rtol=5e-3)


def test_the_worst_tenth_is_the_mean_of_the_lowest_numbers():
    assert worst_tenth(np.arange(20.0)[::-1]) == 0.5
    assert worst_tenth(np.array([3.0, 1.0])) == 1.0
    np.testing.assert_array_equal(worst_tenth(np.arange(40.0).reshape(2, 20)), [0.5, 20.5])


def test_the_worst_tenth_of_a_normal_distribution():
    exact = -norm.pdf(norm.ppf(0.1)) / 0.1
    found = worst_tenth(np.random.default_rng(1).standard_normal(200_000))
    np.testing.assert_allclose(found, exact, atol=0.02)


def test_the_interval_of_a_fixed_rule_is_that_of_a_mean_over_episodes():
    values = np.random.default_rng(2).normal(3.0, 2.0, 400)
    found = estimated([values])
    half = norm.ppf(0.975) * values.std() / np.sqrt(400)
    np.testing.assert_allclose(found.value, values.mean())
    np.testing.assert_allclose(
        [found.low, found.high], values.mean() + half * np.array([-1, 1]), atol=0.03
    )


def test_the_interval_holds_the_spread_of_trainings():
    levels = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    values = levels[:, np.newaxis] + np.zeros((5, 50))
    found = estimated(values)
    assert found.value == 2.0
    rng = np.random.default_rng(3)  # resampled without the code under test
    middle = [np.sort(rng.choice(levels, 5))[1:4].mean() for _ in range(20_000)]
    np.testing.assert_allclose(
        [found.low, found.high], np.percentile(middle, [2.5, 97.5]), atol=0.2
    )


def test_intervals_of_normal_samples_hold_their_mean_as_often_as_they_say():
    rng = np.random.default_rng(4)
    held = 0
    for k in range(200):
        found = estimated(rng.standard_normal((1, 100)), resamples=400, seed=k)
        held += found.low <= 0.0 <= found.high
    assert 176 <= held <= 199  # of 200 with 95 %: outside this with a probability below 1e-4


def test_resampling_in_parts_is_reproducible():
    values = np.random.default_rng(5).normal(size=(3, 3000))
    assert estimated(values, seed=1) == estimated(values, seed=1)
    assert estimated(values, seed=1) != estimated(values, seed=2)


def test_the_probability_of_improvement_is_the_statistic_of_mann_and_whitney():
    rng = np.random.default_rng(6)
    a, b = rng.normal(0.5, 1.0, 9).round(1), rng.normal(0.0, 1.0, 7).round(1)
    found = probability_of_improvement(a, b)
    np.testing.assert_allclose(found.value, mannwhitneyu(a, b).statistic / 63)
    assert found.low <= found.value <= found.high


def test_the_probability_of_improvement_at_its_limits():
    assert probability_of_improvement([2.0, 3.0], [0.0, 1.0]) == (1.0, 1.0, 1.0)
    assert probability_of_improvement([0.0], [1.0, 2.0]) == (0.0, 0.0, 0.0)
    assert probability_of_improvement([1.0, 1.0], [1.0]) == (0.5, 0.5, 0.5)


def test_intervals_are_apart_or_not():
    low, high = Estimated(1.0, 0.5, 1.5), Estimated(3.0, 1.6, 4.0)
    assert low.apart(high)
    assert high.apart(low)
    assert not low.apart(Estimated(2.0, 1.5, 2.5))


@pytest.mark.parametrize("bad", [[], [[]], [[1.0, np.nan]], [[np.inf]], np.zeros((2, 2, 2))])
def test_what_is_not_finite_numbers_of_seeds_and_episodes_is_refused(bad):
    with pytest.raises(ValueError, match="values must be finite numbers"):
        estimated(bad)
