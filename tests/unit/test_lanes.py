"""The number type: eight lanes compute the values of eight floats, independently."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quad_gym.kernels.numbers.elementary import clip, is_finite, maximum, minimum
from quad_gym.kernels.numbers.lanes import (
    all_of,
    any_of,
    fused_multiply_add,
    logical_not,
    one_to_two,
    rotate_left,
    round_to_even,
    select,
    zero_like,
)
from quad_gym.kernels.numbers.linalg import load3, load33, store
from quad_gym.records import WIDTH
from tests.unit.compiled import Compiled

ONE, MANY = np.uint64(1), np.uint64(0x9E3779B97F4A7C15)


def arithmetic(f, option):
    x, y = f.x, f.y
    f.out[0] = x + y
    f.out[1] = x - y
    f.out[2] = x * y
    f.out[3] = x / y
    f.out[4] = -x
    f.out[5] = abs(x)
    f.out[6] = math.sqrt(abs(x))
    f.out[7] = 2.0 * x
    f.out[8] = x / 3
    f.out[9] = 1 - x
    f.out[10] = option + x
    f.out[11] = round_to_even(x)
    f.out[12] = minimum(x, y)
    f.out[13] = maximum(x, y)
    f.out[14] = clip(x, -1.0, 1.0)
    f.out[15] = fused_multiply_add(x, y, 1.0)
    total = x
    total += y
    f.out[16] = total


def truth_of_arithmetic(x, y, option):
    chosen = [np.where(x < y, x, y), np.where(x > y, x, y)]
    return [
        x + y,
        x - y,
        x * y,
        x / y,
        -x,
        np.abs(x),
        np.sqrt(np.abs(x)),
        2.0 * x,
        x / 3,
        1 - x,
        option + x,
        np.rint(x),
        *chosen,
        np.minimum(np.where(x > -1.0, x, -1.0), 1.0),
    ]


def asking(f, option):
    x, y = f.x, f.y
    less, least = x < y, y <= x
    masks = (
        less,
        x <= y,
        x > y,
        x >= y,
        x == y,
        x < 1,
        0.5 >= x,  # noqa: SIM300 (the plain number on the left is the case)
        less & (x > 0.0),
        less | (y < 0.0),
        logical_not(less),
        is_finite(x),
        (option == 1) & least,
        (option == 1) | least,
        select(less, x == 0.0, y == 0.0),
    )
    for i in range(len(masks)):
        f.out[i] = select(masks[i], 1.0, 0.0)
    f.out[14] = select(less, x, y)
    f.out[15] = select(less, 1, y)
    f.out[16] = select(less, x, math.nan)
    f.out[17] = select(less, 3, 4)
    f.any_less = 1.0 if any_of(less) else 0.0
    f.all_less = 1.0 if all_of(less) else 0.0


def truth_of_asking(x, y, option):
    less, one = x < y, option == 1
    masks = [
        less,
        x <= y,
        x > y,
        x >= y,
        x == y,
        x < 1,
        x <= 0.5,
        less & (x > 0.0),
        less | (y < 0.0),
        ~less,
        np.isfinite(x),
        one & (y <= x),
        one | (y <= x),
        np.where(less, x == 0.0, y == 0.0),
    ]
    chosen = [np.where(less, a, b) for a, b in ((x, y), (1.0, y), (x, math.nan), (3.0, 4.0))]
    return [m.astype(float) for m in masks] + chosen


def bits(f, option):
    a, b = f.word_a, f.word_b
    f.word_out[0] = a + b
    f.word_out[1] = a ^ b
    f.word_out[2] = a & b
    f.word_out[3] = a | b
    f.word_out[4] = a + MANY
    f.word_out[5] = MANY ^ a
    f.word_out[6] = rotate_left(a, 13)
    f.word_out[7] = rotate_left(a, 63)
    f.word_out[8] = select(a == b, a, b + ONE)
    f.x = one_to_two(a)


arithmetic_on = Compiled(arithmetic, x=(), y=(), out=(17,))
asking_on = Compiled(asking, x=(), y=(), out=(18,), any_less=(), all_less=())
bits_on = Compiled(bits, word_a=(), word_b=(), word_out=(9,), x=())
INSTANCES = ("on_floats", "on_lanes")


def awkward_pairs():
    """Every pair of zeros, ones, infinities, NaN and some ordinary numbers."""
    rng = np.random.default_rng(1)
    values = [0.0, -0.0, 1.0, -1.0, 0.5, 1.5, 2.5, math.inf, -math.inf, math.nan, 1e300, 5e-324]
    x, y = np.meshgrid([*values, *rng.normal(0.0, 10.0, 12)], [*values, *rng.normal(0.0, 10.0, 12)])
    return x.ravel(), y.ravel()


@pytest.mark.parametrize("instance", INSTANCES)
def test_arithmetic_equals_ieee_floats_bit_for_bit(instance):
    x, y = awkward_pairs()
    out = getattr(arithmetic_on, instance)(3, x=x, y=y)["out"]
    with np.errstate(all="ignore"):
        expected = truth_of_arithmetic(x, y, 3)
    for column, values in enumerate(expected):
        np.testing.assert_array_equal(out[:, column], values, err_msg=f"column {column}")
    known = ~np.isnan(x)
    np.testing.assert_array_equal(np.signbit(out[known, 4]), ~np.signbit(x[known]))
    np.testing.assert_array_equal(out[:, 16], out[:, 0])


@pytest.mark.parametrize("instance", INSTANCES)
def test_a_fused_multiply_add_rounds_once(instance):
    x = np.array([1.0 + 2.0**-30])
    out = getattr(arithmetic_on, instance)(x=x, y=-1.0 + np.array([2.0**-30]))["out"]
    # x y = -1 + 2^-60 is not a float, yet x y + 1 = 2^-60 is
    assert out[0, 15] == 2.0**-60


@pytest.mark.parametrize("instance", INSTANCES)
@pytest.mark.parametrize("option", [0, 1])
def test_comparisons_and_selections_equal_floats(instance, option):
    x, y = awkward_pairs()
    out = getattr(asking_on, instance)(option, x=x, y=y)["out"]
    for column, values in enumerate(truth_of_asking(x, y, option)):
        np.testing.assert_array_equal(out[:, column], values, err_msg=f"column {column}")


def test_any_of_and_all_of_combine_all_lanes():
    pattern = np.arange(256)[:, np.newaxis] >> np.arange(WIDTH) & 1
    asked = asking_on.on_lanes(x=-pattern.ravel().astype(float), y=np.zeros(256 * WIDTH))
    any_less = asked["any_less"].reshape(256, WIDTH)
    all_less = asked["all_less"].reshape(256, WIDTH)
    np.testing.assert_array_equal(any_less, np.repeat(pattern.any(axis=1)[:, np.newaxis], WIDTH, 1))
    np.testing.assert_array_equal(all_less, np.repeat(pattern.all(axis=1)[:, np.newaxis], WIDTH, 1))


@pytest.mark.parametrize("instance", INSTANCES)
def test_words_are_added_and_rotated_modulo_2_to_the_64(instance):
    rng = np.random.default_rng(2)
    a = rng.integers(0, 2**64, 100, np.uint64)
    b = rng.integers(0, 2**64, 100, np.uint64)
    a[:3], b[:3] = [0, 2**64 - 1, 2**63], [0, 2**64 - 1, 2**63]
    got = getattr(bits_on, instance)(word_a=a, word_b=b)
    pairs = [(int(i), int(j)) for i, j in zip(a, b, strict=True)]
    wrap = 2**64
    expected = [
        [
            (i + j) % wrap,
            i ^ j,
            i & j,
            i | j,
            (i + int(MANY)) % wrap,
            i ^ int(MANY),
            (i << 13 | i >> 51) % wrap,
            (i << 63 | i >> 1) % wrap,
            i if i == j else (j + 1) % wrap,
        ]
        for i, j in pairs
    ]
    np.testing.assert_array_equal(got["word_out"], np.array(expected, np.uint64))
    np.testing.assert_array_equal(got["x"], [1.0 + (i >> 12) / 2**52 for i, _ in pairs])


@given(
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, 0.0]),
    st.integers(0, WIDTH - 1),
    st.lists(st.floats(-1e3, 1e3), min_size=WIDTH, max_size=WIDTH),
)
def test_invalid_value_in_one_lane_leaves_other_lanes_unchanged(bad, where, values):
    x, y = np.array(values), np.linspace(-1.0, 2.0, WIDTH)
    corrupt_x, corrupt_y = x.copy(), y.copy()
    corrupt_x[where] = corrupt_y[where] = bad
    others = np.arange(WIDTH) != where
    for compiled in (arithmetic_on, asking_on):
        clean = compiled.on_lanes(x=x, y=y)["out"]
        corrupt = compiled.on_lanes(x=corrupt_x, y=corrupt_y)["out"]
        assert clean[others].tobytes() == corrupt[others].tobytes()


def zeros(f, option):
    f.number, f.integer = zero_like(f.x), zero_like(option) / 2
    store(f.three, zero_like((f.x, 1.0 + f.x, 2.0)))
    m = zero_like(load33(f.m))
    for i in range(3):
        store(f.m[i], m[i])
    store(f.v, zero_like(load3(f.v)))


threes = {"three": (3,), "v": (3,), "m": (3, 3)}
zeros_on = Compiled(zeros, x=(), number=(), integer=(), **threes)


@pytest.mark.parametrize("instance", INSTANCES)
def test_zero_of_a_number_vector_or_matrix_is_zero_where_it_is_not_nan(instance):
    x, v = np.array([2.0, -1e300, math.nan]), np.array([[1.0, math.nan, -3.0]] * 3)
    m = v[:, np.newaxis] * [[1.0], [2.0], [-3.0]]
    got = getattr(zeros_on, instance)(3, x=x, v=v, m=m)
    np.testing.assert_array_equal(got["number"], [0.0, 0.0, math.nan])
    np.testing.assert_array_equal(got["integer"], 0.0)
    np.testing.assert_array_equal(got["three"], [[0, 0, 0], [0, 0, 0], [math.nan, math.nan, 0]])
    np.testing.assert_array_equal(got["v"], 0.0 * v)
    np.testing.assert_array_equal(got["m"], 0.0 * m)
