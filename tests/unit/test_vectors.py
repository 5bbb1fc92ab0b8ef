"""Operators of vectors and matrices against NumPy, and their rounding against exact fractions."""

from fractions import Fraction

import numpy as np
import pytest

from quad_gym.kernels.numbers import linalg
from quad_gym.kernels.numbers.linalg import (
    load3,
    load4,
    load33,
    load44,
    outer,
    rounded,
    store,
    store_column3,
    vector,
)
from tests.unit.compiled import Compiled

INSTANCES = ("on_floats", "on_lanes")


def combine(f, option):
    u, v, m = load3(f.u), load3(f.v), load33(f.m)
    store(f.vectors[0], 2 * u - v * f.s)
    store(f.vectors[1], m @ u)
    store(f.vectors[2], -(m.T @ u))
    store(f.vectors[3], (1.0, 2.0, f.s) - u)
    store(f.vectors[4], vector(f.s, 0.0, 1.0) + vector(0.0, f.s, 0.0))
    for axis in (u, v):  # vectors are iterated over, indexed and unpacked like other tuples
        x, y, z = axis
        store(f.vectors[5], load3(f.vectors[5]) + vector(x, y, axis[2] + 0.0 * z))
    store(f.vectors[6], linalg.cross(u, v))
    store(f.vectors[7], linalg.unit_or(u, v))
    store(f.matrices[0], m @ m.T - f.s * m)
    rows = (u, v, (0.0, 1.0, f.s))
    store(f.matrices[1], outer(u, v) + rows)
    store(f.matrices[2], -m)
    store_column3(f.matrices[2], 0, option, u)
    store(f.matrices[3], linalg.add_to_diagonal(2.0 * m, 3.0))
    q, w = load4(f.q), load44(f.w)
    store(f.fours[0], w @ q + f.s * q)
    store(f.fours[1], (w @ w.T) @ q)
    f.dot, f.norm = linalg.dot(u, v), linalg.norm(u)


def add_products(f, option):
    a, b, s = load3(f.a), load3(f.b), f.s
    m = (a, b, a)
    store(f.sums[0], a + s * b)
    store(f.sums[1], a - s * b)
    store(f.sums[2], s * b + a)
    store(f.sums[3], a + rounded(s * b))
    store(f.sums[4], s * a - s * b)
    store(f.outers[0], m + outer(a, b))
    store(f.outers[1], outer(a, b) + m)


threes = {"u": (3,), "v": (3,), "vectors": (8, 3), "m": (3, 3), "matrices": (4, 3, 3)}
combined = Compiled(combine, s=(), q=(4,), w=(4, 4), fours=(2, 4), dot=(), norm=(), **threes)
summed = Compiled(add_products, a=(3,), b=(3,), s=(), sums=(5, 3), outers=(2, 3, 3))


@pytest.mark.parametrize("instance", INSTANCES)
def test_operators_agree_with_numpy(instance):
    rng = np.random.default_rng(1)
    shapes = {"u": (3,), "v": (3,), "m": (3, 3), "s": (), "q": (4,), "w": (4, 4)}
    given = {name: rng.normal(size=(20, *shape)) for name, shape in shapes.items()}
    got = getattr(combined, instance)(1, **given)
    for k in range(20):
        u, v, m, s, q, w = (values[k] for values in given.values())
        changed = -m
        changed[:, 1] = u
        vectors = [2 * u - s * v, m @ u, -m.T @ u, (1.0, 2.0, s) - u, (s, s, 1.0), u + v]
        vectors += [np.cross(u, v), u / np.linalg.norm(u)]
        matrices = [m @ m.T - s * m, np.outer(u, v) + np.array([u, v, (0.0, 1.0, s)]), changed]
        matrices.append(2.0 * m + 3.0 * np.eye(3))
        np.testing.assert_allclose(got["vectors"][k], vectors, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(got["matrices"][k], matrices, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(got["fours"][k], [w @ q + s * q, w @ w.T @ q], atol=3e-14)
        np.testing.assert_allclose(got["dot"][k], u @ v, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(got["norm"][k], np.linalg.norm(u), rtol=1e-15)


@pytest.mark.parametrize("instance", INSTANCES)
def test_normalizing_vector_of_almost_zero_length_returns_fallback(instance):
    u = np.array([[0.0, 0.0, 0.0], [1e-31, 0.0, 0.0], [0.0, 1e-20, 0.0]])
    got = getattr(combined, instance)(u=u, v=np.array([[1.0, 2.0, 3.0]] * 3))["vectors"][:, 7]
    np.testing.assert_allclose(got, [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [0.0, 1.0, 0.0]], rtol=1e-15)


@pytest.mark.parametrize("instance", INSTANCES)
def test_lanes_fuse_the_product_on_the_right_of_a_sum_only(instance):
    rng = np.random.default_rng(2)
    a, b, s = rng.normal(size=(50, 3)), rng.normal(size=(50, 3)), rng.normal(size=50)
    got = getattr(summed, instance)(a=a, b=b, s=s)

    def fused(x, y, z):
        if instance == "on_floats":
            return x * y + z
        return float(Fraction(x) * Fraction(y) + Fraction(z))

    for k in range(50):
        rounded_sum = s[k] * b[k] + a[k]
        sums = [
            [fused(s[k], y, x) for x, y in zip(a[k], b[k], strict=True)],
            [fused(-s[k], y, x) for x, y in zip(a[k], b[k], strict=True)],
            rounded_sum,
            rounded_sum,
            [fused(-s[k], y, s[k] * x) for x, y in zip(a[k], b[k], strict=True)],
        ]
        m = np.array([a[k], b[k], a[k]])
        outers = [
            [[fused(a[k, i], b[k, j], m[i, j]) for j in range(3)] for i in range(3)],
            np.outer(a[k], b[k]) + m,
        ]
        np.testing.assert_array_equal(got["sums"][k], sums)
        np.testing.assert_array_equal(got["outers"][k], outers)
