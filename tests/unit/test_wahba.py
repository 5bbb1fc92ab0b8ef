"""Wahba's problem: the report's grid, SciPy's solution, and data without a unique solution."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quad_gym.estimation import solve_wahba
from quad_gym.kernels.filter.starts import wahba
from quad_gym.kernels.numbers.linalg import load33, store
from quad_gym.rotations import euler_to_dcm
from tests.unit.compiled import Compiled

seeds = st.integers(0, 2**32 - 1)


def loss(R_BI, weights, v_I, v_B):
    return weights @ ((v_B - v_I @ R_BI.T) ** 2).sum(axis=1)


def assert_proper(R):
    np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-14)


def noisy_problem(seed, count, noise):
    rng = np.random.default_rng(seed)
    R_BI = Rotation.random(rng=rng).as_matrix()
    v_I = rng.normal(size=(count, 3))
    v_B = v_I @ R_BI.T + noise * rng.normal(size=(count, 3))
    return rng.uniform(0.1, 2.0, count), v_I, v_B, R_BI


def test_rotation_is_exact_over_grid_of_all_euler_angles():
    rng = np.random.default_rng(2024)
    steps = np.pi * np.linspace(-1.0, 1.0, 21)
    eulers = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    worst = 0.0
    for R_BI in euler_to_dcm(eulers):
        v_I = rng.uniform(size=(10, 3))
        error = solve_wahba(np.ones(10), v_I, v_I @ R_BI.T) - R_BI
        worst = max(worst, np.linalg.norm(error, 2))
    assert len(eulers) == 9261
    assert worst <= 1e-13


@given(seeds, st.integers(3, 12), st.floats(1e-6, 1.0))
def test_noisy_vectors_give_scipys_and_the_best_rotation(seed, count, noise):
    weights, v_I, v_B, _ = noisy_problem(seed, count, noise)
    s = np.linalg.svd((weights[:, np.newaxis] * v_B).T @ v_I, compute_uv=False)
    assume(s[1] - s[2] > 1e-2 * s[0])
    R_BI = solve_wahba(weights, v_I, v_B)
    assert_proper(R_BI)
    expected, _ = Rotation.align_vectors(v_B, v_I, weights)
    np.testing.assert_allclose(R_BI, expected.as_matrix(), rtol=0.0, atol=1e-11)
    least = loss(R_BI, weights, v_I, v_B)
    rng = np.random.default_rng(seed)
    for size in (1e-4, 1e-2, 1.0):
        for turn in Rotation.from_rotvec(size * rng.normal(size=(10, 3))).as_matrix():
            assert loss(turn @ R_BI, weights, v_I, v_B) >= least - 1e-12


@given(seeds, st.integers(2, 5))
def test_vectors_in_a_plane_are_enough(seed, count):
    weights, v_I, _, R_BI = noisy_problem(seed, count, 0.0)
    v_I[:, 2] = 0.0
    turned = v_I @ Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    s = np.linalg.svd(np.sqrt(weights)[:, np.newaxis] * turned, compute_uv=False)
    assume(s[1] > 0.1 * s[0])
    found = solve_wahba(weights, turned, turned @ R_BI.T)
    assert_proper(found)
    np.testing.assert_allclose(found, R_BI, rtol=0.0, atol=1e-12)


def test_mirrored_vectors_still_give_a_proper_rotation():
    rng = np.random.default_rng(1)
    v_I = rng.normal(size=(6, 3)) * np.array([3.0, 2.0, 1.0])
    v_B = v_I * np.array([1.0, 1.0, -1.0])
    R_BI = solve_wahba(np.ones(6), v_I, v_B)
    assert_proper(R_BI)
    expected, _ = Rotation.align_vectors(v_B, v_I)
    np.testing.assert_allclose(R_BI, expected.as_matrix(), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-200, 1e-12, 1e-6, 1e6, 1e12, 1e200])
def test_the_size_of_the_weights_and_vectors_does_not_matter(scale):
    weights, v_I, v_B, _ = noisy_problem(3, 5, 0.1)
    expected = solve_wahba(weights, v_I, v_B)
    for found in (solve_wahba(scale * weights, v_I, v_B), solve_wahba(weights, v_I, scale * v_B)):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-13)


X, Y, Z = np.eye(3)
OPEN = "v_I and v_B"


@pytest.mark.parametrize(
    ("name", "weights", "v_I", "v_B"),
    [  # the first do not determine the rotation
        (OPEN, [1.0], [X], [Y]),
        (OPEN, [1.0, 1.0], [X, X], [Y, Y]),
        (OPEN, [1.0, 2.0, 1.0], [X, -2 * X, 3 * X], [Z, -2 * Z, 3 * Z]),
        (OPEN, [1.0, 1.0], [X, Y], [Z, Z]),
        (OPEN, [1.0, 0.0], [X, Y], [X, Y]),
        (OPEN, [1.0, 1.0], [0 * X, 0 * X], [X, Y]),
        (OPEN, [1.0, 1.0, 1.0], [X, Y, Z], [-X, -Y, -Z]),
        ("weights", [-1.0, 1.0], [X, Y], [X, Y]),
        ("weights", [0.0, 0.0], [X, Y], [X, Y]),
        ("weights", [], np.zeros((0, 3)), np.zeros((0, 3))),
        ("weights", [np.nan, 1.0], [X, Y], [X, Y]),
        ("weights", 1.0, [X], [X]),
        ("v_I", [1.0, 1.0], [X, Y, Z], [X, Y]),
        ("v_I", [1.0, 1.0], [X[:2], Y[:2]], [X, Y]),
        ("v_I", [1.0, 1.0], [X, np.inf * np.ones(3)], [X, Y]),
        ("v_B", [1.0, 1.0], [X, Y], [X]),
        ("v_B", [1.0, 1.0], [X, Y], [X, np.full(3, np.nan)]),
        ("v_B", [1.0, 1.0], [X, Y], "two"),
    ],
)
def test_bad_input_is_refused_by_name(name, weights, v_I, v_B):
    with pytest.raises(ValueError, match=rf"^{name} must"):
        solve_wahba(weights, v_I, v_B)


def solve(f, option):
    R_BI, f.uniqueness = wahba(load33(f.B))
    store(f.R, R_BI)


compiled = Compiled(solve, B=(3, 3), R=(3, 3), uniqueness=())


def test_lanes_and_floats_give_equal_rotations():
    rng = np.random.default_rng(5)
    B = rng.normal(size=(800, 3, 3))
    B[::8] = np.einsum("ni,nj->nij", *rng.normal(size=(2, 100, 3)))  # rank 1: no unique solution
    B[1::8] *= np.array([1.0, 1.0, 0.0])  # rank 2
    plain, lanes = compiled.on_floats(B=B), compiled.on_lanes(B=B)
    clear = plain["uniqueness"] > 1e-3
    assert clear[np.arange(800) % 8 > 1].mean() > 0.95
    np.testing.assert_allclose(plain["R"][clear], lanes["R"][clear], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(plain["uniqueness"], lanes["uniqueness"], rtol=0.0, atol=1e-13)
    u, s, vt = np.linalg.svd(B)
    d = np.linalg.det(u) * np.linalg.det(vt)
    gap = (s[:, 1] + d * s[:, 2]) / s[:, 0]
    np.testing.assert_allclose(lanes["uniqueness"], gap, rtol=0.0, atol=1e-12)
    for R in lanes["R"]:
        assert_proper(R)
