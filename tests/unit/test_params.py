"""Parameter classes are frozen, keyword-only and checked; error messages name the field."""

from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest

import quad_gym
from quad_gym.packing import params_record
from quad_gym.params.suites import SENSOR_PARAMS
from quad_gym.params.vehicle import Clocks
from quad_gym.records import MAX_FEATURES, MAX_GATES

NO_NUMBERS = ["fast", "3", b"3", True, np.True_, 3j, np.array([3.0]), 10**400]
NO_NUMBERS += [None, float("nan"), float("inf"), [1.0, 2.0]]
BELOW_ZERO = [-1.0, *NO_NUMBERS]
NOT_POSITIVE = [0.0, *BELOW_ZERO]
NO_PHASES = [-0.1, 1.0, "soon", float("nan")]
NO_VECTORS = [(1.0, 2.0), 1.0, "abc", None, (1.0, 2.0, float("nan")), (1.0, 2.0, 3.0, 4.0)]
NO_VECTORS += [("1", "2", "3"), (True, 1.0, 1.0), (None, 1.0, 1.0), np.ones(3, bool)]
NO_MATRICES = [np.zeros((3, 2)), np.zeros(3), "abc", None, np.full((3, 3), np.nan)]
MAYBE = [0.0, -1.0, "fast", float("nan")]
"""Invalid values of numbers that may be None."""
SENSOR = {"rate": NOT_POSITIVE, "phase": NO_PHASES, "latency": BELOW_ZERO}
OBSTACLE = {"center_I shift_I": [*NO_VECTORS, (0.0, 1e5, 0.0)], "follows": ["first", -1, 0.5]}
FAR = 1e5
BAD_VALUES = {
    "VehicleParams": {
        "mass thrust_coefficient torque_coefficient": NOT_POSITIVE,
        "motor_speed_per_volt max_voltage gravity": NOT_POSITIVE,
        "motor_time_constant": [*NOT_POSITIVE, 50.0],
        "disc_area drag_coefficient air_density": BELOW_ZERO,
        "inertia": [
            *NO_MATRICES,
            np.zeros((3, 3)),
            np.eye(3) + np.eye(3, k=1),
            np.diag([1.0, 1.0, 0.0]),
            np.diag([1.0, -1.0, 1.0]),
            np.diag([2600.0, 5000.0, 7000.0]),  # kg mm^2
        ],
        "rotor_positions_B": [
            *NO_MATRICES,
            np.zeros((4, 3)),
            np.zeros((3, 3)),
            [(x, 0.0, 0.0) for x in (-2.0, -1.0, 1.0, 2.0)],
        ],
        "rotor_spins": [*NO_VECTORS[:5], (1.0, -1.0, 1.0), (1.0, -1.0, 1.0, 0.5)],
    },
    "ImuParams": {
        "rate accel_noise_density gyro_noise_density accel_bias_sigma": NOT_POSITIVE,
        "gyro_bias_sigma accel_bias_tau gyro_bias_tau": NOT_POSITIVE,
        "accel_scale_sigma gyro_scale_sigma accel_misalignment_sigma": BELOW_ZERO,
        "gyro_misalignment_sigma accel_vibration gyro_vibration": BELOW_ZERO,
        "lever_arm_B": NO_VECTORS,
        "samples": ["mean", None, 1],
    },
    "GnssParams": SENSOR
    | {
        "primary_antenna_B": NO_VECTORS,
        "secondary_antenna_B": [
            *(bad for bad in NO_VECTORS if bad is not None),
            (0.1013, -0.0004, 0.0472),
        ],
        "reference_antenna_G": [*NO_VECTORS, (0.0, 0.0, 0.0), (30.29, -97.74, 100.0)],
        "position_sigma_I": [*NO_VECTORS, (0.01, 0.01, 0.0), (0.01, -0.01, 0.01)],
        "baseline_sigma drift_tau": NOT_POSITIVE,
        "velocity_sigma": MAYBE,
        "heading_error_sigma": BELOW_ZERO,
        "drift_sigma_I": [*NO_VECTORS, (0.1, -0.1, 0.1)],
    },
    "BarometerParams": SENSOR | {"noise_sigma bias_sigma bias_tau": NOT_POSITIVE},
    "MagnetometerParams": SENSOR
    | {
        "noise_sigma hard_iron_sigma declination_sigma": NOT_POSITIVE,
        "hard_iron_tau": [0.0, -1.0, float("nan")],
        "soft_iron_sigma": BELOW_ZERO,
        "strength": [*NOT_POSITIVE, 46.0],
        "declination": [4.0, -4.0, *NO_NUMBERS],
        "inclination": [2.0, 1.5707, *NO_NUMBERS],
    },
    "CameraParams": SENSOR
    | {
        "exposure": BELOW_ZERO,
        "max_range": [0.0, -1.0, "far"],
        "position_B attitude": NO_VECTORS,
        "focal_length pixel_sigma": NOT_POSITIVE,
        "image_size": [(1.0, 2.0, 3.0), 1.0, (0.0, 1.0), (100.0, -1.0), None],
        "features_I": [
            (),
            np.zeros((2, 2)),
            [1.0, 2.0, 3.0],
            [[0.0, 0.0, float("nan")]],
            None,
            5.0,
            np.zeros((MAX_FEATURES + 1, 3)),
        ],
    },
    "FilterParams": {
        "alpha direction_variance_floor initial_velocity_variance": NOT_POSITIVE,
        "initial_covariance_scale max_direction_sigma gravity": NOT_POSITIVE,
        "initial_tilt_sigma recursive_update_threshold": MAYBE,
        "beta": BELOW_ZERO,
        "kappa": [-14.5, *NO_NUMBERS],
        "ground_height": NO_NUMBERS,
        "kind integration bearing_noise_at delay_compensation": ["other", None, 1],
        "attitude_reset": ["turn", 1, None],
        "false_alarm_probability": [0.5, 1.0, *BELOW_ZERO],
        "max_rejections": [0, -1, 1.5, True, *NO_NUMBERS],
        "reset_timeout glitch_timeout": NOT_POSITIVE,
    },
    "InitialPoseParams": {"position_sigma heading_sigma": NOT_POSITIVE},
    "NoisyObservationParams": {"position velocity attitude body_rates": BELOW_ZERO},
    "LogDelays": {" ".join(SENSOR_PARAMS): [-2.1, 2.1, *NO_NUMBERS]},
    "PDGains": {
        "position velocity": BELOW_ZERO,
        "attitude body_rates": [*NO_VECTORS, (1.0, 1.0, -1.0)],
    },
    "ActionParams": {
        "rate_scale": [*NO_VECTORS, (1.0, 0.0, 1.0)],
        "tilt_scale": [*NOT_POSITIVE, np.pi / 2],
        "velocity_scale rate_bandwidth attitude_bandwidth velocity_bandwidth": NOT_POSITIVE,
    },
    "Clocks": {
        "imu_rate": NOT_POSITIVE,
        "control_rate": [*NOT_POSITIVE, 30.0, 400.0, 199.0],
        "substeps": [0, -1, 1.5, True, *NO_NUMBERS],
    },
    "TaskParams": {
        "kind start reward_per": ["other", None, 1],
        "radius period height out_of_bounds max_speed max_acceleration gate_radius": NOT_POSITIVE,
        "duration": BELOW_ZERO,
        "min_height": NO_NUMBERS,
        "max_tilt": [*NOT_POSITIVE, 3.2],
        "gate_count": [0, MAX_GATES + 1, 2.5, *NO_NUMBERS],
        "reward_params": [None, 1.0, {"near": 1.0}],
        "preview": [(0.2,), 0.2, (-0.1, 0.2), (0.1, float("nan")), None],
        "trajectory": [3, [], "nowhere.csv", [None], float("nan")],
    },
    "RewardParams": {" ".join(f.name for f in fields(quad_gym.RewardParams)): BELOW_ZERO},
    "WorldParams": {
        "wind_I": NO_VECTORS,
        "gust_wind_speed": BELOW_ZERO,
        "linear_drag_B rotor_drag_B": [*NO_VECTORS, (0.1, 0.1, -0.1)],
        "rotor_radius": NOT_POSITIVE,
        "ground_height": NO_NUMBERS,
        "battery": ["full", 3.0],
        "obstacles": ["wall", [1.0], quad_gym.Wall()],
        "vehicle_radius": [*NOT_POSITIVE, 1e3],
        "geofence": ["here", 1.0, ((0.0, 0.0, 0.0), (1.0, 0.0, 1.0))],
        "ground": [True, "contact", 1.0],
    },
    "Wall": OBSTACLE | {"size": [*NO_VECTORS, (1.0, 0.0, 1.0), (1.0, FAR, 1.0)], "yaw": NO_NUMBERS},
    "Cylinder": OBSTACLE | {"radius height": [*NOT_POSITIVE, FAR]},
    "GroundParams": {
        "feet_B": [*NO_MATRICES, np.zeros((4, 3)), np.full((4, 3), -0.1)],
        "friction": BELOW_ZERO,
        "max_touchdown_speed": [*NOT_POSITIVE, 0.1],
        "max_touchdown_tilt": [*NOT_POSITIVE, 4.0],
    },
    "BatteryParams": {
        "energy": NOT_POSITIVE,
        "charge empty_voltage motor_efficiency": [*NOT_POSITIVE, 1.1],
        "resistance": BELOW_ZERO,
    },
}
CASES = {
    (kind, name): bad
    for kind, table in BAD_VALUES.items()
    for names, bad in table.items()
    for name in names.split()
}
CLASSES = [Clocks if kind == "Clocks" else getattr(quad_gym, kind) for kind in BAD_VALUES]
CLASSES += [quad_gym.SensorSuite]


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


@pytest.mark.parametrize(("kind", "name"), CASES, ids=lambda part: part)
def test_invalid_value_is_refused_by_the_name_of_its_field(kind, name):
    for bad in CASES[kind, name]:
        with pytest.raises(ValueError, match=rf"\b{name}\b"):
            (Clocks if kind == "Clocks" else getattr(quad_gym, kind))(**{name: bad})


def test_every_field_but_flags_is_tried():
    for kind in set(CLASSES) - {quad_gym.SensorSuite}:
        names = {(kind.__name__, f.name) for f in fields(kind) if f.type is not bool}
        assert not names - set(CASES)


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
