"""Linear algebra in blocks of three against NumPy and SciPy."""

import numpy as np
import pytest
import scipy.linalg

from quad_gym.kernels.numbers.factors import cholesky, solve_left_vector, solve_right
from tests.unit.compiled import Compiled

LARGEST, ROWS = 18, 9


def factor_and_solve(f, n):
    f.least = cholesky(f.a, n, f.inverse)
    solve_right(f.x, ROWS, f.a, n, f.inverse, 0)
    solve_left_vector(f.a, f.b, n, f.inverse)


SIZES = {"a": (LARGEST, LARGEST), "inverse": (LARGEST,), "x": (ROWS, LARGEST), "b": (LARGEST,)}
blocks = Compiled(factor_and_solve, **SIZES, least=())
INSTANCES = ("on_floats", "on_lanes")


def positive_definite(rng, n, condition):
    """A random symmetric matrix with eigenvalues from 1 / condition to 1."""
    q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    eigenvalues = np.geomspace(1.0 / condition, 1.0, n)
    return q @ np.diag(eigenvalues) @ q.T


def embedded(matrix):
    """The matrix in the corner of an array of the largest size, which is otherwise NaN."""
    array = np.full((LARGEST, LARGEST), np.nan)
    array[: len(matrix), : len(matrix)] = matrix
    return array


@pytest.mark.parametrize("instance", INSTANCES)
@pytest.mark.parametrize("n", range(3, LARGEST + 1, 3))
@pytest.mark.parametrize("condition", [10.0, 1e6])
def test_factor_and_solutions_agree_with_scipy(instance, n, condition):
    rng = np.random.default_rng(n)
    a = np.array([positive_definite(rng, n, condition) for _ in range(5)])
    x, b = rng.normal(size=(5, ROWS, LARGEST)), rng.normal(size=(5, LARGEST))
    lower = np.array([embedded(np.tril(one) + np.triu(np.full((n, n), np.nan), 1)) for one in a])
    got = getattr(blocks, instance)(n, a=lower, x=x, b=b)
    for k in range(5):
        factor = scipy.linalg.cholesky(a[k], lower=True)
        mine = np.tril(got["a"][k, :n, :n])
        np.testing.assert_allclose(mine @ mine.T, a[k], rtol=0.0, atol=4e-16 * n)
        np.testing.assert_allclose(mine, factor, rtol=0.0, atol=1e-15 * condition)
        np.testing.assert_allclose(got["inverse"][k, :n] * np.diag(mine), 1.0, rtol=1e-15)
        assert got["least"][k] == pytest.approx(np.diag(factor).min() ** 2, rel=1e-14 * condition)
        right = scipy.linalg.solve_triangular(mine, x[k, :, :n].T, lower=True).T
        np.testing.assert_allclose(got["x"][k, :, :n], right, rtol=0.0, atol=1e-13 * condition**0.5)
        left = scipy.linalg.solve_triangular(mine, b[k, :n], lower=True)
        np.testing.assert_allclose(got["b"][k, :n], left, rtol=0.0, atol=1e-13 * condition**0.5)


def test_only_the_part_that_is_asked_for_is_touched():
    rng = np.random.default_rng(1)
    a = positive_definite(rng, 6, 10.0)
    x, b = rng.normal(size=(ROWS, LARGEST)), rng.normal(size=LARGEST)
    got = blocks.on_lanes(6, a=[embedded(a)], x=[x], b=[b])
    np.testing.assert_array_equal(got["a"][0][np.triu_indices(6, 1)], a[np.triu_indices(6, 1)])
    assert np.isnan(got["a"][0, 6:]).all()
    np.testing.assert_array_equal(got["x"][0, :, 6:], x[:, 6:])
    np.testing.assert_array_equal(got["b"][0, 6:], b[6:])


@pytest.mark.parametrize("instance", INSTANCES)
@pytest.mark.parametrize("n", [3, 9, 15, 18])
def test_indefinite_matrix_shows_in_the_pivot(instance, n):
    rng = np.random.default_rng(n)
    bad = []
    for k in range(n):
        q, _ = np.linalg.qr(rng.normal(size=(n, n)))
        eigenvalues = np.ones(n)
        eigenvalues[k] = -0.01
        bad.append(q @ np.diag(eigenvalues) @ q.T)
        diagonal = np.eye(n)
        diagonal[k, k] = 0.0 if k % 2 else -1.0
        bad.append(diagonal)
        corrupt = positive_definite(rng, n, 10.0)
        corrupt[k, k] = np.nan
        bad.append(corrupt)
    got = getattr(blocks, instance)(n, a=[embedded(one) for one in bad])
    assert not (got["least"] > 0.0).any()
