"""Functions with the same bits on every processor, and the parameters that they make."""

import json

import mpmath
import numpy as np
import pytest

from quad_gym.params import portable
from tests.builders import run_python
from tests.golden.other_library import digests

ANGLES = [*np.random.default_rng(0).uniform(-7.0, 7.0, 40).tolist(), np.pi, 1e-9, 1e3]
PAIRS = np.random.default_rng(1).normal(size=(40, 2)).tolist()


@pytest.fixture(autouse=True)
def _digits():
    with mpmath.workdps(60):
        yield


@pytest.mark.parametrize("name", ["exp", "sin", "cos", "erfc"])
def test_functions_are_rounded_once(name):
    rounded, exact = getattr(portable, name), getattr(mpmath, name)
    assert [rounded(x) for x in ANGLES] == [float(exact(mpmath.mpf(x))) for x in ANGLES]


@pytest.mark.parametrize("name", ["hypot", "atan2"])
def test_functions_of_two_numbers_are_rounded_once(name):
    rounded, exact = getattr(portable, name), getattr(mpmath, name)
    assert [rounded(*p) for p in PAIRS] == [float(exact(*map(mpmath.mpf, p))) for p in PAIRS]


@pytest.mark.parametrize("x", [1e-20, 1e-3, 0.4, 30.0])
def test_logarithm_and_approach_are_rounded_once(x):
    assert portable.log(x) == float(mpmath.log(mpmath.mpf(x)))
    assert portable.approached(x) == float(-mpmath.expm1(-mpmath.mpf(x)))


@pytest.mark.parametrize("beyond", [0.499, 0.1, 1e-4, 1e-12, 1e-200])
@pytest.mark.parametrize("freedoms", [1, 2, 3])
def test_limit_of_chi_square_is_exceeded_with_the_probability(freedoms, beyond):
    limit = portable.chi_square_limit(freedoms, beyond)
    near = (np.nextafter(limit, 0.0), limit, np.nextafter(limit, np.inf))
    least, found, most = (
        mpmath.gammainc(mpmath.mpf(freedoms) / 2, mpmath.mpf(x) / 2, regularized=True)
        for x in map(float, near)
    )
    assert abs(found - beyond) <= 0.5001 * (least - most) / 2


def test_exponentials_of_arrays_are_within_an_ulp_and_do_not_use_numpys(monkeypatch):
    x = np.append(np.random.default_rng(2).uniform(-40.0, 40.0, 500), [0.0, -745.0, 709.7])
    exact = np.array([float(mpmath.exp(mpmath.mpf(value))) for value in x.tolist()])
    monkeypatch.setattr(np, "exp", None)
    found = portable.exp_of(x)
    assert np.all(np.abs(found - exact) <= 1.5 * np.spacing(exact))
    assert found[500] == 1.0
    ends = portable.exp_of([[-np.inf, -1e300, 1e300, np.inf, np.nan]])
    np.testing.assert_array_equal(ends, [[0.0, 0.0, np.inf, np.inf, np.nan]])


def test_values_at_the_ends_are_exact():
    assert [portable.exp(x) for x in (-np.inf, -1e300, -0.0)] == [0.0, 0.0, 1.0]
    assert [portable.erfc(x) for x in (-np.inf, 0.0, 1e9, np.inf)] == [2.0, 1.0, 0.0, 0.0]
    assert portable.atan2(0.0, 0.0) == 0.0
    assert str(portable.approached(0.0)) == "0.0"


def test_parameters_of_golden_flights_do_not_depend_on_last_bits_of_other_functions():
    done = run_python("-m", "tests.golden.other_library")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [name for name, digest in digests().items() if digest != found[name]] == []
