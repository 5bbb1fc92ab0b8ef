"""Parameter classes are frozen, keyword-only and checked; error messages name the field."""

from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest

import quad_gym
from quad_gym.packing import params_record
from quad_gym.params.checks import Checked
from quad_gym.params.vehicle import Clocks

NEEDY = ("Uniform", "LogUniform", "Normal", "Trajectory")
"""Classes of parameters without defaults."""
BAD_VALUES = {
    "Clocks": {
        "imu_rate": [0.0, -1.0, 1e6 + 1.0, "fast", None],
        "control_rate": [0.0, -1.0, 30.0, 400.0, 199.0, "fast", None],
    },
    "VehicleParams": {
        "inertia": [
            np.zeros((3, 3)),
            np.zeros((3, 2)),
            np.full((3, 3), np.nan),
            np.eye(3) + np.eye(3, k=1),
            np.diag([1.0, 1.0, 0.0]),
            np.diag([1.0, -1.0, 1.0]),
            np.diag([2600.0, 5000.0, 7000.0]),  # kg mm^2
        ],
        "rotor_positions_B": [
            np.zeros((4, 3)),
            np.zeros((3, 3)),
            np.full((4, 3), np.nan),
            [(x, 0.0, 0.0) for x in (-2.0, -1.0, 1.0, 2.0)],
        ],
    },
    "GnssParams": {
        "reference_antenna_G": [(30.29, -97.74, 100.0)],  # degrees
        "secondary_antenna_B": [(0.1013, -0.0004, 0.0472)],  # the primary one
    },
}
"""Invalid values of fields without a single limit; `tests/unit/test_limits.py` has all others."""
CLASSES = [
    Clocks,
    *(
        kind
        for kind in vars(quad_gym).values()
        if isinstance(kind, type) and issubclass(kind, Checked) and kind.__name__ not in NEEDY
    ),
]


@pytest.mark.parametrize("kind", CLASSES)
def test_parameters_are_frozen_keyword_only_values(kind):
    made = kind()
    assert made == kind() == made.replace()
    assert hash(made) == hash(kind())
    for f in fields(kind):
        assert f.kw_only, f.name
        with pytest.raises(FrozenInstanceError):
            setattr(made, f.name, getattr(made, f.name))
    for wrong in ((1.0,), {}), ((), {"colour": "red"}):
        with pytest.raises(TypeError):
            kind(*wrong[0], **wrong[1])


@pytest.mark.parametrize("kind", BAD_VALUES)
def test_invalid_value_is_refused_by_the_name_of_its_field(kind):
    make = Clocks if kind == "Clocks" else getattr(quad_gym, kind)
    for name, values in BAD_VALUES[kind].items():
        for bad in values:
            with pytest.raises(ValueError, match=rf"\b{name}\b"):
                make(**{name: bad})


def test_arrays_are_stored_as_immutable_tuples():
    inertia = np.diag([1.0, 2.0, 3.0])
    vehicle = quad_gym.VehicleParams(inertia=inertia)
    inertia[0, 0] = -1.0
    assert vehicle.inertia == ((1.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 3.0))


PRESETS = {"sensors": quad_gym.sensor_suite, "vehicle": quad_gym.vehicle_params}
PRESETS |= {"gains": quad_gym.pd_gains}


@pytest.mark.parametrize("argument", PRESETS)
def test_unknown_presets_are_refused_with_the_valid_names(argument):
    for unknown in ("garage", None, ["lab"]):
        with pytest.raises(ValueError, match=rf"^{argument} must be one of (standard, )?lab"):
            PRESETS[argument](unknown)


def test_the_laboratory_presets_hold_the_laboratorys_numbers():
    suite, vehicle, gains = (preset("lab") for preset in PRESETS.values())
    assert (vehicle.mass, vehicle.gravity, vehicle.max_voltage) == (0.78, 9.8, 12.0)
    assert np.diag(vehicle.inertia).tolist() == [1.7565e-3, 3.5723e-3, 4.7134e-3]
    assert (gains.position, gains.velocity) == (5.0, 3.1)
    assert gains.attitude + gains.body_rates == (1.0, 0.95, 0.21, 0.25, 0.25, 0.12)
    assert suite.gnss.position_sigma_I == (0.006, 0.006, 0.012)
    assert np.linalg.norm(suite.gnss.baseline_B) == pytest.approx(0.19, rel=1e-12)
    assert suite.camera.features_I == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.7))
    record = params_record(vehicle, suite)[0]
    dt = 0.005
    assert record["accel_sigma"] ** 2 == pytest.approx((9.8e-3) ** 2 * 0.1**2 / dt)
    assert record["gyro_sigma"] ** 2 == pytest.approx((np.pi / 180) ** 2 * 0.05**2 / dt)
    assert record["accel_bias_decay"] == pytest.approx(np.exp(-dt / 100.0), rel=1e-15)
    stationary = (100 * 9.8e-3) ** 2
    drive = stationary * (1 - np.exp(-2 * dt / 100.0))
    assert record["accel_bias_drive"] ** 2 == pytest.approx(drive, rel=1e-10)


def test_sensors_take_other_rates():
    suite = quad_gym.sensor_suite("lab").with_rates(gnss=10.0, camera=20.0)
    assert (suite.imu.rate, suite.gnss.rate, suite.camera.rate) == (200.0, 10.0, 20.0)
    assert suite.with_rates() == suite
    blind = quad_gym.SensorSuite(camera=None).with_rates(imu=100.0, gnss=50.0)
    assert (blind.imu.rate, blind.gnss.rate, blind.camera) == (100.0, 50.0, None)
    fast = quad_gym.sensor_suite("lab").with_rates(imu=400.0)  # sensors at every tick follow
    assert (fast.imu.rate, fast.gnss.rate, fast.camera.rate) == (400.0, 400.0, 400.0)
    slow = quad_gym.sensor_suite("lab").with_rates(gnss=10.0).with_rates(imu=100.0)
    assert (slow.gnss.rate, slow.camera.rate) == (10.0, 100.0)
    assert Clocks(control_rate=50.0).ticks_per_step == 4


@pytest.mark.parametrize("rate", [30.0, 400.0, 0.0, -10.0, float("nan"), "often"])
@pytest.mark.parametrize("sensor", ["gnss", "camera", "imu"])
def test_rate_without_a_whole_number_of_ticks_is_refused(sensor, rate):
    suite = quad_gym.sensor_suite("lab").with_rates(gnss=10.0, camera=20.0)
    if sensor == "imu" and rate == 400.0:
        return
    with pytest.raises(ValueError, match=r"rate must"):
        suite.with_rates(**{sensor: rate})


def test_scaled_noise_and_clocks_of_a_suite():
    with pytest.raises(ValueError, match=r"^GnssParams\.rate must"):
        quad_gym.SensorSuite(gnss=quad_gym.GnssParams(rate=30.0))
    with pytest.raises(ValueError, match=r"^CameraParams\.rate must"):
        quad_gym.SensorSuite(camera=quad_gym.CameraParams(rate=150.0))
    lab = quad_gym.sensor_suite("lab")
    loud = lab.scaled_noise(3.0)
    assert loud.gnss.position_sigma_I == pytest.approx((0.018, 0.018, 0.036))
    assert loud.gnss.baseline_sigma == pytest.approx(0.15)
    assert loud.camera.pixel_sigma == pytest.approx(60.0)
    assert loud.imu.accel_noise_density == pytest.approx(3.0 * lab.imu.accel_noise_density)
    assert loud.imu.gyro_noise_density == pytest.approx(3.0 * lab.imu.gyro_noise_density)
    assert loud.imu.accel_bias_sigma == lab.imu.accel_bias_sigma
    with pytest.raises(ValueError, match=r"^factor must"):
        lab.scaled_noise(0.0)
