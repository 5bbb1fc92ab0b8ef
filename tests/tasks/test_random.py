"""Random numbers of tasks: published answers, distributions, and a stream for each flight."""

import numpy as np
import pytest
from scipy import stats

from quad_gym.tasks.task import FlightRandom, threefry

ALARM = 1e-6  # probability that a correct generator fails one statistical test


def generator(flights, method=1, seed=0):
    keys = np.random.default_rng(seed).integers(0, 2**64, (flights, 2), np.uint64)
    return FlightRandom(keys, np.full(flights, 2**32, np.uint64), method)


def test_threefry_with_13_rounds_has_the_published_answers():
    # known answers of the Random123 library, threefry2x64 with 13 rounds
    ones = 2**64 - 1
    pi = (0x243F6A8885A308D3, 0x13198A2E03707344, 0xA4093822299F31D0, 0x082EFA98EC4E6C89)
    keys = np.array([(0, 0), (ones, ones), pi[2:]], np.uint64)
    counters = np.array([(0, 0), (ones, ones), pi[:2]], np.uint64)
    a, b = threefry(keys[:, 0], keys[:, 1], counters[:, 0], counters[:, 1])
    assert [hex(v) for v in a] == ["0xf167b032c3b480bd", "0xccdec5c917a874b1", "0xc3aac71561042993"]
    assert [hex(v) for v in b] == ["0xe91f9fee4b7a6fb5", "0x4df53abca26ceb01", "0x3fe7ae8801aff316"]


def test_draws_have_their_distributions():
    rng = generator(5000)
    for values, law in (
        (rng.random((5000, 4)), stats.uniform()),
        (rng.uniform(-2.0, 6.0, (5000, 4)), stats.uniform(-2.0, 8.0)),
        (rng.normal(1.0, 3.0, (5000, 4)), stats.norm(1.0, 3.0)),
    ):
        for column in values.T:
            assert stats.kstest(column, law.cdf).pvalue > ALARM
        assert np.abs(np.corrcoef(values.T)[0, 1]) < stats.norm.isf(ALARM) / np.sqrt(5000)
    counts = np.bincount(rng.integers(2, 7, (5000, 2)).ravel(), minlength=7)
    assert counts[:2].sum() == 0
    assert stats.chisquare(counts[2:]).pvalue > ALARM


@pytest.mark.parametrize("flights", [1, 3, 8])
def test_draws_of_a_flight_are_the_same_in_any_batch(flights):
    many, few = generator(50), generator(50)
    few._key0, few._key1 = few._key0[:flights], few._key1[:flights]
    few._instants = few._instants[:flights]
    for draw in ("random", "uniform", "normal"):
        alone, together = getattr(few, draw), getattr(many, draw)
        np.testing.assert_array_equal(alone(), together()[:flights])
        np.testing.assert_array_equal(
            alone(size=(flights, 2, 3)), together(size=(50, 2, 3))[:flights]
        )


def test_methods_instants_and_calls_draw_different_numbers():
    first, other = generator(4), generator(4, method=2)
    later = generator(4)
    later._instants = later._instants + np.uint64(1)
    drawn = [first.random(), first.random(), other.random(), later.random()]
    assert len(np.unique(np.concatenate(drawn))) == 16


@pytest.mark.parametrize("size", [4, np.int64(4), np.array(4)[()], [4], (np.int8(4), 2)])
def test_sizes_of_any_integer_type_are_accepted(size):
    expected = np.random.default_rng(0).random(size).shape
    assert generator(4).random(size).shape == expected


def test_invalid_sizes_and_names_are_refused():
    with pytest.raises(ValueError, match="size must begin with the number of flights, 4, got"):
        generator(4).normal(size=3)
    with pytest.raises(ValueError, match="high must be greater than low"):
        generator(4).integers(3, 3)
    with pytest.raises(AttributeError, match="random, uniform, normal and integers, not choice"):
        generator(4).choice([1, 2])
