"""The random streams: published answers of Threefry, and the distribution of what is made of it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from quad_gym.kernels.maths.random import normal_pair, threefry, uniform_pair
from tests.unit.compiled import Compiled

ALARM = 1e-6  # probability that a sound generator fails one statistical test
Z = stats.norm.isf(ALARM / 2)


def draws(f, draw):
    key0, key1, instant = f.word_key[0], f.word_key[1], f.word_counter[0]
    f.word_out[0], f.word_out[1] = threefry(key0, key1, instant, f.word_counter[1])
    stream = (key0, key1, instant)
    f.normals[0], f.normals[1] = normal_pair(stream, draw)
    f.uniforms[0], f.uniforms[1] = uniform_pair(stream, draw)


generator = Compiled(
    draws, word_key=(2,), word_counter=(2,), word_out=(2,), normals=(2,), uniforms=(2,)
)
INSTANCES = ("on_floats", "on_lanes")
KEY = (0x0123456789ABCDEF, 0xFEDCBA9876543210)


def sample(name, *, count=400_000, key=KEY, draw=0, first=0):
    """(count, 2) numbers of successive instants of one stream."""
    counter = np.zeros((count, 2), np.uint64)
    counter[:, 0] = np.arange(first, first + count)
    keys = np.broadcast_to(np.array(key, np.uint64), (count, 2))
    return generator.on_lanes(draw, word_key=keys, word_counter=counter)[name]


def assert_uncorrelated(a, b):
    """Each column of a with each of b, and their squares."""
    for p, q in ((a, b), (a**2 - 1.0, b**2 - 1.0)):
        p, q = (v / np.sqrt((v**2).mean(axis=0)) for v in (p, q))
        scores = p.T @ q / np.sqrt(len(p))
        assert np.abs(scores).max() < Z


@pytest.mark.parametrize("instance", INSTANCES)
def test_threefry_of_13_rounds_has_the_published_answers(instance):
    # known answers of the Random123 library, threefry2x64 with 13 rounds
    ones = 2**64 - 1
    pi = (0x243F6A8885A308D3, 0x13198A2E03707344, 0xA4093822299F31D0, 0x082EFA98EC4E6C89)
    words = {
        "word_key": np.array([(0, 0), (ones, ones), pi[2:]], np.uint64),
        "word_counter": np.array([(0, 0), (ones, ones), pi[:2]], np.uint64),
    }
    got = getattr(generator, instance)(**words)["word_out"]
    assert [hex(v) for v in got[0]] == ["0xf167b032c3b480bd", "0xe91f9fee4b7a6fb5"]
    assert [hex(v) for v in got[1]] == ["0xccdec5c917a874b1", "0x4df53abca26ceb01"]
    assert [hex(v) for v in got[2]] == ["0xc3aac71561042993", "0x3fe7ae8801aff316"]


@given(st.tuples(*[st.integers(0, 2**64 - 1)] * 4), st.integers(0, 200))
def test_floats_and_lanes_draw_the_same(words, draw):
    inputs = {"word_key": np.array([words[:2]], np.uint64)}
    inputs["word_counter"] = np.array([words[2:]], np.uint64)
    plain, lanes = generator.on_floats(draw, **inputs), generator.on_lanes(draw, **inputs)
    np.testing.assert_array_equal(plain["word_out"], lanes["word_out"])
    np.testing.assert_array_equal(plain["uniforms"], lanes["uniforms"])
    np.testing.assert_allclose(plain["normals"], lanes["normals"], rtol=1e-14, atol=1e-15)


@given(st.tuples(*[st.integers(0, 2**64 - 1)] * 3), st.integers(0, 200))
def test_a_draw_is_named_by_the_second_counter_word(words, draw):
    key, instant = np.array([words[:2]], np.uint64), words[2]
    counter = np.array([(instant, draw)], np.uint64)
    got = generator.on_floats(draw, word_key=key, word_counter=counter)
    fractions = [(int(word) >> 12) / 2**52 for word in got["word_out"][0]]
    np.testing.assert_array_equal(got["uniforms"][0], fractions)
    assert ((got["uniforms"] >= 0.0) & (got["uniforms"] < 1.0)).all()
    # the Box-Muller transform of the same two numbers, in NumPy
    u, v = 1.0 - fractions[0], 2.0 * np.pi * fractions[1]
    expected = np.sqrt(-2.0 * np.log(u)) * np.array([np.cos(v), np.sin(v)])
    np.testing.assert_allclose(got["normals"][0], expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("column", [0, 1])
def test_uniform_numbers_are_uniform(column):
    u = sample("uniforms")[:, column]
    assert stats.kstest(u, "uniform").pvalue > ALARM
    assert stats.chisquare(np.bincount((u * 1024).astype(int), minlength=1024)).pvalue > ALARM


@pytest.mark.parametrize("column", [0, 1])
def test_normals_have_the_normal_distribution(column):
    n = sample("normals")[:, column]
    assert stats.kstest(n, "norm").pvalue > ALARM
    # E x^k and Var x^k of a standard normal
    for k, mean, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96), (6, 15, 10170)):
        assert abs((n**k).mean() - mean) < Z * np.sqrt(variance / len(n)), f"moment {k}"


def test_normals_have_the_right_tails():
    n = sample("normals", count=1_000_000, first=10**9).ravel()
    for bound in (2.0, 3.0, 4.0):
        for count in ((n > bound).sum(), (n < -bound).sum()):
            assert stats.binomtest(int(count), n.size, stats.norm.sf(bound)).pvalue > ALARM
    assert 4.0 < np.abs(n).max() < 8.6


def test_the_two_numbers_of_a_draw_are_independent():
    n, u = sample("normals"), sample("uniforms")
    assert_uncorrelated(n[:, :1], n[:, 1:])
    cells = (u * 32).astype(int)
    counts = np.bincount(cells[:, 0] * 32 + cells[:, 1], minlength=1024)
    assert stats.chisquare(counts).pvalue > ALARM
    angle, radius2 = np.arctan2(n[:, 1], n[:, 0]), (n**2).sum(axis=1)
    assert stats.kstest(angle / (2.0 * np.pi) + 0.5, "uniform").pvalue > ALARM
    assert stats.kstest(radius2, "chi2", args=(2,)).pvalue > ALARM


def test_draws_of_one_instant_are_independent():
    first = sample("normals", draw=0)
    for draw in (1, 2, 3, 64):
        assert_uncorrelated(first, sample("normals", draw=draw))


def test_successive_instants_are_independent():
    n = sample("normals")
    for lag in (1, 2, 8, 200):
        assert_uncorrelated(n[:-lag], n[lag:])


@pytest.mark.parametrize("other", [(1, 0), (0, 1), (2**63, 0), (1, 1)])
def test_streams_of_neighboring_keys_are_independent(other):
    assert_uncorrelated(sample("normals", key=(0, 0)), sample("normals", key=other))


def test_one_instant_of_many_keys_is_as_random_as_one_key():
    count = 400_000
    keys = np.zeros((count, 2), np.uint64)
    keys[:, 0] = np.arange(count)
    n = generator.on_lanes(5, word_key=keys, word_counter=np.full((count, 2), 7, np.uint64))
    assert stats.kstest(n["normals"][:, 0], "norm").pvalue > ALARM
    assert_uncorrelated(n["normals"][:-1], n["normals"][1:])
