"""The random streams: published answers of Threefry, and the draws made from its words."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quad_gym.kernels.numbers.random import normal_pair, threefry, uniform_pair
from tests.unit.alarms import assert_normal
from tests.unit.compiled import Compiled


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
def test_second_counter_word_selects_the_draw(words, draw):
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


def test_normals_of_consecutive_keys_are_independent():
    """The computation of normals from words is tested above."""
    keys = np.zeros((400_000, 2), np.uint64)
    keys[:, 0] = np.arange(len(keys))
    counter = np.full((len(keys), 2), 7, np.uint64)
    n = generator.on_lanes(5, word_key=keys, word_counter=counter)["normals"]
    assert_normal(np.hstack([n[:-1], n[1:]]), np.zeros(4), np.eye(4))
