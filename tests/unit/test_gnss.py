"""GNSS: the rank-2 covariance of a baseline of known length, and the noise of the position."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.frames import ecef_to_enu
from quad_gym.kernels.maths.linalg import load3, store
from quad_gym.kernels.sensors.gnss_baseline import noisy_baseline
from quad_gym.sensors import GnssReceiver
from tests.unit.alarms import assert_normal
from tests.unit.compiled import Compiled

LAB = quad_gym.GnssParams()
FLOOR = 1e-8
SAMPLES = 8_000

directions = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 3)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)


def measure_baseline(f, option):
    store(f.measured, noisy_baseline(load3(f.r_b), load3(f.normals), f.sigma_b, f.floor, f.length))


kernels = Compiled(
    measure_baseline, r_b=(3,), normals=(3,), sigma_b=(), floor=(), length=(), measured=(3,)
)


def noise_map(r_b, sigma_b, floor):
    """The Jacobian of the measured baseline with respect to the three normals, at zero noise."""
    h = 1e-6 / max(sigma_b, np.sqrt(floor) / np.linalg.norm(r_b))
    normals = h * np.concatenate([np.eye(3), -np.eye(3)])
    measured = kernels.on_lanes(
        r_b=np.tile(r_b, (6, 1)),
        normals=normals,
        sigma_b=np.full(6, sigma_b),
        floor=np.full(6, floor),
        length=np.full(6, np.linalg.norm(r_b)),
    )["measured"]
    return (measured[:3] - measured[3:]).T / (2.0 * h)


@given(directions, st.floats(0.05, 5.0), st.floats(0.005, 0.2))
def test_noise_of_a_baseline_has_a_covariance_of_rank_two(u, length, sigma_b):
    R_bG = noise_map(length * u, sigma_b, 0.0)
    R_bG = R_bG @ R_bG.T
    unit = (length * sigma_b) ** 2
    np.testing.assert_allclose(R_bG, unit * (np.eye(3) - np.outer(u, u)), rtol=0, atol=1e-8 * unit)
    eigenvalues = np.linalg.eigvalsh(R_bG) / unit
    np.testing.assert_allclose(eigenvalues, [0.0, 1.0, 1.0], rtol=0.0, atol=1e-8)
    assert eigenvalues.min() > -1e-15  # positive semidefinite
    assert np.linalg.matrix_rank(R_bG, tol=1e-6 * unit) == 2


@given(directions, st.floats(0.05, 5.0))
def test_the_floor_adds_to_the_variance_across_the_baseline(u, length):
    noise = noise_map(length * u, 0.05, FLOOR)
    across = (length * 0.05) ** 2 + FLOOR
    expected = across * (np.eye(3) - np.outer(u, u))
    np.testing.assert_allclose(noise @ noise.T, expected, rtol=0.0, atol=1e-8 * across)


@given(directions, st.tuples(*[st.floats(-8.0, 8.0)] * 3), st.floats(0.1, 3.0))
def test_the_measured_baseline_has_its_known_length(u, normals, length):
    for run in (kernels.on_floats, kernels.on_lanes):
        measured = run(
            r_b=[length * u], normals=[normals], sigma_b=[0.05], floor=[FLOOR], length=[length]
        )["measured"][0]
        assert np.linalg.norm(measured) == pytest.approx(length, rel=1e-15)


@given(directions, st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.floats(0.1, 0.5))
def test_large_noise_is_drawn_before_scaling(u, normals, sigma_b):
    length, floor = 0.19, 1e-4
    R_bG = (length * sigma_b) ** 2 * (np.eye(3) - np.outer(u, u)) + floor * np.eye(3)
    values, vectors = np.linalg.eigh(R_bG)
    noisy = length * u + vectors @ (np.sqrt(values) * (vectors.T @ normals))
    measured = kernels.on_floats(
        r_b=[length * u], normals=[normals], sigma_b=[sigma_b], floor=[floor], length=[length]
    )["measured"][0]
    expected = length * noisy / np.linalg.norm(noisy)
    np.testing.assert_allclose(measured, expected, rtol=0.0, atol=1e-12)


def measurements(params, position, R_BI, count=SAMPLES):
    receiver = GnssReceiver(params, np.random.default_rng(1))
    pairs = [receiver.measure(position, R_BI) for _ in range(count)]
    return (np.array(column) for column in zip(*pairs, strict=True))


@pytest.fixture(scope="module")
def flight():
    """A place, an attitude, and many measurements there with a well-known baseline."""
    position, R_BI = np.array([3.0, -2.0, 1.5]), Rotation.random(rng=3).as_matrix()
    params = LAB.replace(baseline_sigma=0.004)
    return (params, position, R_BI, *measurements(params, position, R_BI))


def test_the_position_noise_is_that_of_the_east_north_up_frame(flight):
    params, position, R_BI, positions, _ = flight
    R_IG = ecef_to_enu(params.reference_antenna_G)
    antenna = position + R_BI.T @ params.primary_antenna_B
    variances = np.array([0.006, 0.006, 0.012]) ** 2
    assert_normal(positions @ R_IG.T, antenna, np.diag(variances))


def test_sampled_baselines_have_the_reports_covariance(flight):
    params, _, R_BI, _, baselines = flight
    length = np.linalg.norm(params.baseline_B)
    u = R_BI.T @ params.baseline_B / length
    # two directions across the baseline; the third variance is zero as the length is known
    across = np.linalg.svd(u[np.newaxis])[2][1:]
    sideways = baselines @ ecef_to_enu(params.reference_antenna_G).T @ across.T
    variance = length**2 * params.baseline_sigma**2 + FLOOR
    assert_normal(sideways, np.zeros(2), variance * np.eye(2))
    np.testing.assert_allclose(np.linalg.norm(baselines, axis=1), length, rtol=1e-14)


def test_position_and_baseline_noise_are_independent(flight):
    *_, positions, baselines = flight
    noise = np.concatenate([positions - positions.mean(0), baselines - baselines.mean(0)], axis=1)
    correlation = np.corrcoef(noise.T)[:3, 3:]
    assert np.abs(correlation).max() < 5.5 / np.sqrt(SAMPLES)
    serial = (noise[1:] * noise[:-1]).mean(axis=0) / noise.var(axis=0)
    assert np.abs(serial).max() < 5.5 / np.sqrt(SAMPLES)


@given(st.integers(0, 2**32 - 1))
def test_without_noise_the_geometry_is_exact(seed):
    rng = np.random.default_rng(seed)
    position, R_BI = rng.normal(size=3), Rotation.random(rng=rng).as_matrix()
    params = quad_gym.GnssParams(
        position_sigma_I=(1e-12, 1e-12, 1e-12),
        baseline_sigma=1e-9,
        primary_antenna_B=rng.normal(size=3),
        secondary_antenna_B=rng.normal(size=3),
        reference_antenna_G=rng.normal(size=3) * 4e6 + np.array([6.4e6, 0.0, 0.0]),
    )
    r_pG, r_bG = GnssReceiver(params, rng).measure(position, R_BI)
    R_IG = ecef_to_enu(params.reference_antenna_G)
    expected = position + R_BI.T @ params.primary_antenna_B
    np.testing.assert_allclose(R_IG @ r_pG, expected, rtol=0.0, atol=1e-10)
    # the floor of the covariance stays: 0.1 mm
    np.testing.assert_allclose(R_IG @ r_bG, R_BI.T @ params.baseline_B, rtol=0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "position", "R_BI"),
    [
        ("position", [1.0, 2.0], np.eye(3)),
        ("position", [1.0, 2.0, np.nan], np.eye(3)),
        ("R_BI", [1.0, 2.0, 3.0], np.eye(2)),
        ("R_BI", [1.0, 2.0, 3.0], np.full((3, 3), np.inf)),
    ],
)
def test_bad_input_is_refused_by_name(name, position, R_BI):
    with pytest.raises(ValueError, match=f"^{name} must"):
        GnssReceiver(LAB, np.random.default_rng(1)).measure(position, R_BI)


def test_equal_generators_give_equal_measurements():
    first, again, other = (
        GnssReceiver(LAB, np.random.default_rng(seed)).measure(np.zeros(3), np.eye(3))[0]
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()
    with pytest.raises(ValueError, match=r"^rng must"):
        GnssReceiver(LAB, 1)
