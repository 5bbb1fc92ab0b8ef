"""Sensors of one vehicle do what their parameters say beside noise and bias.

Two sensors of the same seed, one with an effect and one without it, differ by the effect alone.
"""

import math

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.sensors import Camera, GnssReceiver, Imu
from tests.body_states import random_state

VEHICLE = quad_gym.VehicleParams()
LAB = quad_gym.sensor_suite("lab")
HOVER_SPEED = VEHICLE.hover_voltage * VEHICLE.motor_speed_per_volt


def pair(kind, plain, seed, **changes):
    return [
        kind(params, np.random.default_rng(seed)) for params in (plain, plain.replace(**changes))
    ]


def test_effects_on_fixes_and_images_reach_the_classes():
    """Their sizes are those of the kernels: test_imperfect_sensors.py."""
    place, R_BI = np.array([0.0, 0.0, 6.0]), np.eye(3)
    true, turned = pair(GnssReceiver, LAB.gnss, 1, heading_error_sigma=0.05)
    (fix, baseline), (same, other) = (gnss.measure(place, R_BI) for gnss in (true, turned))
    np.testing.assert_array_equal(fix, same)
    assert (baseline != other).any()
    camera = quad_gym.sensor_suite("rtk").camera
    free, near = pair(Camera, camera.replace(max_range=math.inf), 1, max_range=7.7)
    seen = np.isfinite(free.measure(place, R_BI)).sum()
    assert 0 < np.isfinite(near.measure(place, R_BI)).sum() < seen
    below, upward = np.array([0.0, 0.0, -6.0]), np.diag([1.0, -1.0, -1.0])
    free, hidden = pair(Camera, camera.replace(ground_hides=False), 1, ground_hides=True)
    assert np.isfinite(free.measure(below, upward)).any()
    assert np.isnan(hidden.measure(below, upward)).all()
    sharp, blurred = pair(Camera, camera.replace(exposure=0.0), 1, exposure=0.01)
    rates = np.array([0.0, 2.0, 1.0])
    gap = blurred.measure(place, R_BI, rates) - sharp.measure(place, R_BI)
    assert 0.0 < np.nanmax(abs(gap)) <= 0.005 * camera.focal_length * np.linalg.norm(rates)
    with pytest.raises(ValueError, match="body_rates must have shape"):
        blurred.measure(place, R_BI, np.zeros(2))


@pytest.mark.parametrize("samples", ["instant", "average"])
def test_errors_of_scale_and_alignment_have_their_sizes(samples):
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
            now = random_state(rng)
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
def test_vibration_grows_with_the_square_of_the_rotor_speeds(speeds):
    rng = np.random.default_rng(2)
    still, shaken = pair(Imu, LAB.imu, 3, accel_vibration=0.2, gyro_vibration=0.01)
    now = random_state(rng) | {"rotor_speeds": np.full(4, speeds * HOVER_SPEED)}
    gaps = np.array([np.subtract(shaken.measure(now), still.measure(now)) for _ in range(600)])
    for gap, size in ((gaps[:, 0], 0.01), (gaps[:, 1], 0.2)):
        total = np.sum(np.square(gap / (size * speeds**2)))
        low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], gap.size)
        assert low < total < high
