"""Sensors of one vehicle do what their parameters say beside noise and bias.

Two sensors of the same seed, one with an effect and one without it, differ by the effect alone.
"""

import math

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.sensors import Camera, GnssReceiver, Imu

VEHICLE = quad_gym.VehicleParams()
LAB = quad_gym.sensor_suite("lab")
HOVER_SPEED = VEHICLE.hover_voltage * VEHICLE.motor_speed_per_volt


def state(rng):
    return {
        "position": np.zeros(3),
        "velocity": rng.normal(0.0, 3.0, 3),
        "R_BI": Rotation.random(rng=rng).as_matrix(),
        "body_rates": rng.normal(0.0, 3.0, 3),
        "rotor_speeds": rng.uniform(500.0, 1500.0, 4),
    }


def pair(kind, plain, seed, **changes):
    return [
        kind(params, np.random.default_rng(seed)) for params in (plain, plain.replace(**changes))
    ]


@pytest.mark.parametrize("samples", ["instant", "average"])
def test_imu_errors_of_scale_and_alignment_last_and_have_the_sizes_asked_for(samples):
    errors = {
        "accel_scale_sigma": 0.004,
        "accel_misalignment_sigma": 0.002,
        "gyro_scale_sigma": 0.01,
        "gyro_misalignment_sigma": 0.005,
    }
    found = {name: [] for name in errors}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        exact, erring = pair(Imu, LAB.imu.replace(samples=samples), seed, **errors)
        rows = []
        for _ in range(8):
            now = state(rng)
            since = {"since": now} if samples == "average" else {}
            rows.append((*exact.measure(now, **since), *erring.measure(now, **since)))
        gyro, accel, bad_gyro, bad_accel = (np.array(part) for part in zip(*rows, strict=True))
        for name, good, bad, rest in (
            ("accel", accel, bad_accel, [0.0, 0.0, VEHICLE.gravity]),
            ("gyro", gyro, bad_gyro, np.zeros(3)),
        ):
            D = np.linalg.lstsq(good - rest, bad - good, rcond=None)[0].T
            np.testing.assert_allclose(bad, good + (good - rest) @ D.T, rtol=0.0, atol=1e-10)
            found[f"{name}_scale_sigma"].append(np.diag(D))
            found[f"{name}_misalignment_sigma"].append(D[~np.eye(3, dtype=bool)])
    for name, values in found.items():
        total = np.sum(np.square(np.array(values) / errors[name]))
        low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], np.array(values).size)
        assert low < total < high, name


@pytest.mark.parametrize("speeds", [1.0, 1.5], ids=["hovering", "faster"])
def test_vibration_of_the_imu_grows_with_the_square_of_the_rotor_speeds(speeds):
    rng = np.random.default_rng(2)
    still, shaken = pair(Imu, LAB.imu, 3, accel_vibration=0.2, gyro_vibration=0.01)
    now = state(rng) | {"rotor_speeds": np.full(4, speeds * HOVER_SPEED)}
    gaps = np.array([np.subtract(shaken.measure(now), still.measure(now)) for _ in range(600)])
    for gap, size in ((gaps[:, 0], 0.01), (gaps[:, 1], 0.2)):
        total = np.sum(np.square(gap / (size * speeds**2)))
        low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], gap.size)
        assert low < total < high


def test_a_constant_heading_error_turns_every_baseline_about_the_body_z_axis():
    angles = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        true, turned = pair(GnssReceiver, LAB.gnss, seed, heading_error_sigma=0.05)
        own = []
        for _ in range(3):
            R_BI = Rotation.random(rng=rng).as_matrix()
            R_GB = quad_gym.frames.ecef_to_enu(LAB.gnss.reference_antenna_G).T @ R_BI.T
            place, baseline = true.measure(np.zeros(3), R_BI)
            same_place, other = turned.measure(np.zeros(3), R_BI)
            np.testing.assert_array_equal(place, same_place)
            before, after = R_GB.T @ baseline, R_GB.T @ other
            own.append(math.atan2(after[1], after[0]) - math.atan2(before[1], before[0]))
            assert after[2] == pytest.approx(before[2], abs=1e-12)
        own = (np.array(own) + np.pi) % (2.0 * np.pi) - np.pi
        np.testing.assert_allclose(own, own[0], rtol=0.0, atol=1e-9)
        angles.append(own[0])
    low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], 60)
    assert low < np.sum(np.square(np.array(angles) / 0.05)) < high


def looking_down(height):
    camera = quad_gym.sensor_suite("rtk").camera
    features = np.array(camera.features_I)
    return camera, np.array([0.0, 0.0, height]), features


def test_a_camera_sees_no_farther_than_its_range():
    camera, position, features = looking_down(6.0)
    distances = np.linalg.norm(features - position - camera.position_B, axis=1)
    seen = Camera(camera.replace(max_range=math.inf), np.random.default_rng(1)).measure(
        position, np.eye(3)
    )
    visible = np.isfinite(seen).all(axis=1)
    limit = float(np.median(distances[visible])) + 1e-6
    near = Camera(camera.replace(max_range=limit), np.random.default_rng(1)).measure(
        position, np.eye(3)
    )
    assert 0 < (visible & (distances > limit)).sum() < visible.sum()
    assert np.isnan(near[distances > limit]).all()
    np.testing.assert_array_equal(near[distances <= limit], seen[distances <= limit])


def test_a_camera_below_the_ground_sees_nothing():
    camera, _, _ = looking_down(1.0)
    upward = np.diag([1.0, -1.0, -1.0])  # the body on its back, the camera looks up
    below = np.array([0.0, 0.0, -6.0])
    free, hidden = pair(Camera, camera.replace(ground_hides=False), 1, ground_hides=True)
    assert np.isfinite(free.measure(below, upward)).any()
    assert np.isnan(hidden.measure(below, upward)).all()


def test_a_turning_camera_blurs_its_image_as_far_as_the_smear_reaches():
    camera, position, _ = looking_down(6.0)
    sharp, blurred = pair(Camera, camera.replace(exposure=0.0), 1, exposure=0.01)
    rates, shifts = np.array([0.0, 2.0, 1.0]), []
    np.testing.assert_array_equal(
        sharp.measure(position, np.eye(3)), blurred.measure(position, np.eye(3))
    )
    for _ in range(200):
        gap = blurred.measure(position, np.eye(3), rates) - sharp.measure(position, np.eye(3))
        shifts.append(gap[np.isfinite(gap)])
    smear = camera.focal_length * np.linalg.norm(rates) * 0.01
    shifts = np.concatenate(shifts) / smear + 0.5
    assert stats.kstest(shifts, "uniform").pvalue > 1e-6
    with pytest.raises(ValueError, match="body_rates must have shape"):
        blurred.measure(position, np.eye(3), np.zeros(2))
