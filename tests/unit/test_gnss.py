"""GNSS: the rank-2 covariance of a baseline of known length, and the noise of the position."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.frames import ecef_to_enu
from quad_gym.kernels.numbers.linalg import load3, store
from quad_gym.kernels.sensors.gnss import noisy_baseline
from quad_gym.packing import params_record
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


@given(
    directions,
    st.tuples(*[st.floats(-8.0, 8.0)] * 3),
    st.floats(0.005, 0.5),
    st.sampled_from([0.0, FLOOR, 1e-4]),
    st.floats(0.05, 5.0),
)
def test_noisy_baseline_has_the_reports_covariance_and_its_length(u, normals, sigma_b, floor, l_b):
    """The reference applies the symmetric root of the covariance, then scales to the length."""
    R_bG = (l_b * sigma_b) ** 2 * (np.eye(3) - np.outer(u, u)) + floor * np.eye(3)
    values, vectors = np.linalg.eigh(R_bG)
    noisy = l_b * u + vectors @ (np.sqrt(values.clip(0.0)) * (vectors.T @ normals))
    expected = l_b * noisy / np.linalg.norm(noisy)
    for run in (kernels.on_floats, kernels.on_lanes):
        measured = run(
            r_b=[l_b * u], normals=[normals], sigma_b=[sigma_b], floor=[floor], length=[l_b]
        )["measured"][0]
        np.testing.assert_allclose(measured, expected, rtol=0.0, atol=1e-7 * l_b)
        assert np.linalg.norm(measured) == pytest.approx(l_b, rel=1e-15)


def measurements(params, position, R_BI, count=SAMPLES):
    receiver = GnssReceiver(params, np.random.default_rng(1))
    pairs = [receiver.measure(position, R_BI) for _ in range(count)]
    return (np.array(column) for column in zip(*pairs, strict=True))


@pytest.fixture(scope="module")
def flight():
    """Return a position, an attitude, and many measurements with a precise baseline."""
    position, R_BI = np.array([3.0, -2.0, 1.5]), Rotation.random(rng=3).as_matrix()
    params = LAB.replace(baseline_sigma=0.004)
    return (params, position, R_BI, *measurements(params, position, R_BI))


def test_position_noise_is_normal_in_the_east_north_up_frame(flight):
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
    # the floor of the covariance remains: 0.1 mm
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
    with pytest.raises(ValueError, match=r"^rng must"):
        GnssReceiver(LAB, 1)


def test_assumed_noise_of_a_baseline_leaves_its_constant_error_after_a_minute():
    """Averaged over the baselines of 60 s, the white noise that the filter assumes is the constant
    error of the heading and the average of the true white noise, as the page says. The kernels
    have this number."""
    suite = quad_gym.sensor_suite("rtk")
    gnss = suite.gnss.replace(rate=10.0, baseline_sigma=0.04, heading_error_sigma=0.01)
    suite, count = suite.replace(gnss=gnss), 600.0
    record = params_record(quad_gym.vehicle_params("lab"), suite)[0]
    averaged = float(record["baseline_noise"]) / np.sqrt(count)
    np.testing.assert_allclose(averaged, np.hypot(0.01, 0.04 / np.sqrt(count)), rtol=1e-12)
    np.testing.assert_allclose(float(record["baseline_sigma"]), 0.04, rtol=1e-12)
    np.testing.assert_allclose(
        float(record["first_baseline_sigma"]), np.hypot(0.01, 0.04), rtol=1e-12
    )
    without = suite.replace(gnss=gnss.replace(heading_error_sigma=0.0))
    record = params_record(quad_gym.vehicle_params("lab"), without)[0]
    np.testing.assert_allclose(float(record["baseline_noise"]), 0.04, rtol=1e-12)
