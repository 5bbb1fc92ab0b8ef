"""The elementary functions against the C library and arbitrary-precision arithmetic."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quad_gym.kernels.numbers.elementary import (
    approached,
    atan2,
    exp,
    log,
    sin_cos,
    sin_cos_minus_one,
)
from quad_gym.records import WIDTH
from tests.unit.compiled import Compiled

mpmath = pytest.importorskip("mpmath")


def functions(f, option):
    x = f.x
    f.sin, f.cos = sin_cos(x)
    (f.sin_small, f.cos_less_one), _, (f.sin_last, f.cos_less_one_last) = sin_cos_minus_one(
        (x, 0.0 * x, x)
    )
    f.exp = exp(x)
    f.approached = approached(x)
    f.log = log(x)
    f.angle = atan2(f.y, x)


NAMES = ("sin", "cos", "sin_small", "cos_less_one", "sin_last", "cos_less_one_last")
NAMES += ("exp", "approached", "log", "angle")
compiled = Compiled(functions, x=(), y=(), **dict.fromkeys(NAMES, ()))


@pytest.fixture(params=["on_floats", "on_lanes"])
def evaluate(request):
    run = getattr(compiled, request.param)

    def values(x, y=0.0):
        x = np.asarray(x, float)
        return run(x=x, y=np.broadcast_to(y, x.shape))

    return values


def ulps(got, expected):
    """Return the largest error in units in the last place of the truth."""
    got, expected = np.broadcast_arrays(np.asarray(got), np.asarray(expected))
    return np.max(np.abs(got - expected) / np.spacing(np.maximum(np.abs(expected), 2.3e-308)))


def precise_ulps(got, function, values):
    """Return the largest error in units in the last place of unrounded values of mpmath."""
    worst = 0.0
    with mpmath.workdps(60):
        for found, value in zip(got.tolist(), values.tolist(), strict=True):
            truth = function(mpmath.mpf(value))
            error = float(abs(found - truth))
            worst = max(worst, error / np.spacing(max(abs(float(truth)), 2.3e-308)))
    return worst


def in_precision(function, values):
    """Return a function of mpmath at every value, rounded to floats."""
    with mpmath.workdps(60):
        return np.array([float(function(mpmath.mpf(float(v)))) for v in values])


NORMAL = np.random.default_rng(1).normal(size=(2, 4000))


def near_quarter_turns():
    """Return the floats next to multiples of a quarter turn, and others near them."""
    turns = np.append(np.arange(-40, 41), np.geomspace(41, 636_000, 400).round())
    with mpmath.workdps(60):
        angles = np.array([float(turn * mpmath.pi / 2) for turn in turns.tolist()])
    beside = [np.nextafter(angles, sign * np.inf) for sign in (1, -1)]
    return np.concatenate([angles, *beside, *(angles + d for d in (1e-9, -1e-7, 1e-3))])


ANGLES = {
    "ordinary": 10 * NORMAL[0],
    "within an eighth of a turn": np.linspace(-np.pi / 4, np.pi / 4, 4001),
    "of any size": NORMAL[1, :1500] * np.geomspace(1e-300, 1e6, 1500),
    "up to the limit": np.linspace(-1e6, 1e6, 2001),
    "multiples of a quarter turn": near_quarter_turns(),
    # the floats up to 1e6 that are nearest to a multiple
    "hardest": np.array([45.553093477052, 91.106186954104, -364.424747816416, 321307.9594422229]),
}


@pytest.mark.parametrize("kind", ANGLES)
def test_sine_and_cosine_are_within_one_unit_in_the_last_place(evaluate, kind):
    x = ANGLES[kind]
    out = evaluate(x)
    assert precise_ulps(out["sin"], mpmath.sin, x) < 0.8
    assert precise_ulps(out["cos"], mpmath.cos, x) < 0.8


def test_sine_and_cosine_are_accurate_up_to_1e9_radians(evaluate):
    x = np.append([1e9, -1e9], np.geomspace(1e6, 1e9, 500))
    out = evaluate(x)
    assert np.abs(out["sin"] - in_precision(mpmath.sin, x)).max() <= 2.0**-53
    assert np.abs(out["cos"] - in_precision(mpmath.cos, x)).max() <= 2.0**-53
    out = evaluate([1.01e9, -1e22, 1.7e308])  # too large: as for an angle of zero
    assert (out["sin"] == 0.0).all()
    assert (out["cos"] == 1.0).all()


def test_sine_keeps_tiny_angles_and_the_sign_of_zero(evaluate):
    x = np.array([0.0, -0.0, 5e-324, -5e-324, 1e-310, -1e-160, 1e-9])
    out = evaluate(x)
    assert out["sin"].tobytes() == x.tobytes()
    assert (out["cos"] == 1.0).all()


def test_cosine_less_one_keeps_its_relative_accuracy(evaluate):
    rng = np.random.default_rng(3)
    special = [0.05, -0.05, np.nextafter(0.05, 0.0), 0.0499, 0.0501, 1e-150, 3.0, -6.0, 1e5]
    x = np.append(special, rng.normal(size=400) * 10 ** rng.uniform(-150, 0.5, 400))
    out = evaluate(x)
    expected = in_precision(lambda v: -2 * mpmath.sin(v / 2) ** 2, x)
    normal = np.abs(expected) > 1e-300
    assert np.abs(out["cos_less_one"][normal] / expected[normal] - 1.0).max() <= 1e-15
    assert (out["cos_less_one"][~normal] <= 0.0).all()
    assert ulps(out["sin_small"], in_precision(mpmath.sin, x)) <= 3


def test_exponential_and_logarithm_match_numpy(evaluate):
    rng = np.random.default_rng(4)
    limits = [0.0, -0.0, 1e-300, 709.78, -708.39]
    x = np.concatenate([limits, rng.uniform(-708, 709, 4000), rng.uniform(-1, 1, 4000)])
    found = evaluate(x)["exp"]
    assert ulps(found, np.exp(x)) <= 2
    assert found[0] == 1.0
    limits = [1.0, 2.3e-308, 1.7976931348623157e308, 2.0, 0.5, math.sqrt(2.0), math.sqrt(0.5)]
    near_one = 1.0 + rng.normal(size=4000).clip(-0.9) * 10 ** rng.uniform(-16, 0, 4000)
    x = np.concatenate([limits, 10 ** rng.uniform(-307, 308, 4000), near_one])
    found = evaluate(x)["log"]
    assert ulps(found, np.log(x)) <= 3
    assert found[0] == 0.0


def test_share_that_a_decay_has_lost_keeps_its_relative_accuracy(evaluate):
    rng = np.random.default_rng(5)
    limits = [0.0, 5e-324, 1e-300, 0.34, np.nextafter(0.34, 1.0), 0.35, 1.0, 40.0, 1e4, math.inf]
    x = np.concatenate([limits, rng.uniform(0, 2, 3000), 10 ** rng.uniform(-300, 2, 3000)])
    found = evaluate(x)["approached"]
    assert ulps(found, -np.expm1(-x)) <= 3
    assert np.isnan(evaluate([math.nan])["approached"]).all()


def test_functions_return_limits_or_nan_beyond_their_range(evaluate):
    inf, nan = math.inf, math.nan
    out = evaluate([709.79, 1e4, 1e308, inf, -709.0, -1e4, -1e308, -inf, nan])["exp"]
    np.testing.assert_array_equal(out, [inf] * 4 + [0.0] * 4 + [nan])
    out = evaluate([0.0, -0.0, -1.0, -inf, nan, inf])["log"]
    np.testing.assert_array_equal(out, [-inf, -inf, nan, nan, nan, inf])
    out = evaluate([nan, inf, -inf])
    assert all(np.isnan(out[name]).all() for name in NAMES[:4])
    assert np.isnan(evaluate([1.0, nan, nan], [nan, 1.0, nan])["angle"]).all()
    out = evaluate([0.0, -0.0])
    for name, value in (("sin", 0.0), ("cos", 1.0), ("cos_less_one", 0.0)):
        np.testing.assert_array_equal(out[name], value)


def test_atan2_matches_numpy(evaluate):
    rng = np.random.default_rng(6)
    x, y = rng.normal(size=(2, 8000)) * 10 ** rng.uniform(-100, 100, (2, 8000))
    x[:4000], y[:4000] = rng.normal(size=(2, 4000))
    assert ulps(evaluate(x, y)["angle"], np.arctan2(y, x)) <= 4


@pytest.mark.parametrize(
    ("y", "x", "angle"),
    [
        (0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (1.0, 0.0, math.pi / 2),
        (-1.0, 0.0, -math.pi / 2),
        (0.0, -1.0, math.pi),
        (1.0, 1.0, math.pi / 4),
        (1.0, -1.0, 3 * math.pi / 4),
        (-1.0, -1.0, -3 * math.pi / 4),
        (1.0, math.inf, 0.0),
        (1.0, -math.inf, math.pi),
        (math.inf, 1.0, math.pi / 2),
        (-math.inf, -1.0, -math.pi / 2),
        (1e-320, 1e308, 0.0),
    ],
)
def test_atan2_of_special_points_is_accurate(evaluate, y, x, angle):
    assert evaluate([x], y)["angle"][0] == pytest.approx(angle, rel=3e-16, abs=0.0)


@given(
    st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e8, 0.5]),
    st.integers(0, WIDTH - 1),
    st.lists(st.floats(-0.04, 0.04) | st.floats(-1e5, 1e5), min_size=WIDTH, max_size=WIDTH),
)
def test_extreme_value_in_one_lane_changes_no_other_lane(bad, where, values):
    x = np.array(values)
    corrupt = x.copy()
    corrupt[where] = bad
    clean = compiled.on_lanes(x=x)
    dirty = compiled.on_lanes(x=corrupt, y=np.where(x == corrupt, 0, bad))
    others = np.arange(WIDTH) != where
    for name in NAMES:
        assert clean[name][others].tobytes() == dirty[name][others].tobytes(), name
