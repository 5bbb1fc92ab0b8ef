"""Linear algebra in blocks of three against NumPy and SciPy."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from quad_gym.kernels.maths import linalg
from quad_gym.kernels.maths.factors import cholesky, solve_left_vector, solve_right
from quad_gym.kernels.maths.linalg import load3, load33, store
from quad_gym.kernels.maths.vectors import outer
from tests.unit.compiled import Compiled

LARGEST, ROWS = 18, 9


def factor_and_solve(f, n):
    f.least = cholesky(f.a, n, f.inverse)
    solve_right(f.x, ROWS, f.a, n, f.inverse, 0)
    solve_left_vector(f.a, f.b, n, f.inverse)


def small(f, option):
    u, v, m = load3(f.u), load3(f.v), load33(f.m)
    store(f.vectors[0], linalg.cross(u, v))
    store(f.vectors[1], m @ u)
    store(f.vectors[2], m.T @ u)
    store(f.vectors[3], linalg.unit_or(u, v))
    store(f.vectors[4], u + v - 2.0 * v)
    store(f.matrices[0], m @ m.T)
    store(f.matrices[1], outer(u, v) - outer(v, u))
    store(f.matrices[2], linalg.add_to_diagonal(2.0 * m, 3.0))
    store(f.matrices[3], m + (m + outer(u, u)))
    f.dot, f.norm = linalg.dot(u, v), linalg.norm(u)


SIZES = {"a": (LARGEST, LARGEST), "inverse": (LARGEST,), "x": (ROWS, LARGEST), "b": (LARGEST,)}
blocks = Compiled(factor_and_solve, **SIZES, least=())
RESULTS = {"vectors": (5, 3), "matrices": (4, 3, 3), "dot": (), "norm": ()}
threes = Compiled(small, u=(3,), v=(3,), m=(3, 3), **RESULTS)
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
def test_factor_and_solutions_are_those_of_scipy(instance, n, condition):
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


def test_a_failure_in_one_lane_leaves_the_others_alone():
    rng = np.random.default_rng(2)
    a = np.array([positive_definite(rng, LARGEST, 100.0) for _ in range(8)])
    b = rng.normal(size=(8, LARGEST))
    clean = blocks.on_lanes(LARGEST, a=a, b=b)
    corrupt = a.copy()
    corrupt[3] = -corrupt[3]
    corrupt[6] = np.nan
    got = blocks.on_lanes(LARGEST, a=corrupt, b=b)
    others = [0, 1, 2, 4, 5, 7]
    for name in ("a", "b", "least", "inverse"):
        assert clean[name][others].tobytes() == got[name][others].tobytes()
    assert not (got["least"][[3, 6]] > 0.0).any()


@given(st.integers(0, 2**32 - 1), st.sampled_from(range(3, LARGEST + 1, 3)), st.floats(0.0, 8.0))
def test_floats_and_lanes_give_the_same_factor(seed, n, log_condition):
    rng = np.random.default_rng(seed)
    a = positive_definite(rng, n, 10.0**log_condition)
    inputs = {"a": [embedded(a)], "x": rng.normal(size=(1, ROWS, LARGEST))}
    plain, lanes = blocks.on_floats(n, **inputs), blocks.on_lanes(n, **inputs)
    tolerance = 1e-15 * 10.0**log_condition
    for name in ("a", "least"):
        np.testing.assert_allclose(plain[name], lanes[name], rtol=0.0, atol=tolerance)
    factor = np.tril(plain["a"][0, :n, :n])
    np.testing.assert_allclose(factor @ factor.T, a, rtol=0.0, atol=4e-16 * n)


@pytest.mark.parametrize("instance", INSTANCES)
def test_vectors_and_matrices_of_three(instance):
    rng = np.random.default_rng(3)
    u, v, m = rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), rng.normal(size=(20, 3, 3))
    got = getattr(threes, instance)(u=u, v=v, m=m)
    for k in range(20):
        a, b, c = u[k], v[k], m[k]
        vectors = [np.cross(a, b), c @ a, c.T @ a, a / np.linalg.norm(a), a - b]
        matrices = [c @ c.T, np.outer(a, b) - np.outer(b, a)]
        matrices += [2.0 * c + 3.0 * np.eye(3), 2.0 * c + np.outer(a, a)]
        np.testing.assert_allclose(got["vectors"][k], vectors, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(got["matrices"][k], matrices, rtol=0.0, atol=1e-14)
        assert got["dot"][k] == pytest.approx(a @ b, abs=1e-14)
        assert got["norm"][k] == pytest.approx(np.linalg.norm(a), rel=1e-15)


@pytest.mark.parametrize("instance", INSTANCES)
def test_a_vector_without_direction_takes_the_fallback(instance):
    u = np.array([[0.0, 0.0, 0.0], [1e-31, 0.0, 0.0], [0.0, 1e-20, 0.0]])
    v = np.array([[1.0, 2.0, 3.0]] * 3)
    got = getattr(threes, instance)(u=u, v=v)["vectors"][:, 3]
    np.testing.assert_allclose(got, [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [0.0, 1.0, 0.0]], rtol=1e-15)
