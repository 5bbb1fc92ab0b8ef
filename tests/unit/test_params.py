"""The parameter classes: frozen, keyword-only, checked, and the field named in every complaint."""

import dataclasses

import numpy as np
import pytest

import quad_gym
from quad_gym.packing.flight import params_record
from quad_gym.params.clocks import Clocks
from quad_gym.records import MAX_FEATURES, MAX_GATES

CLASSES = [
    quad_gym.BarometerParams,
    quad_gym.MagnetometerParams,
    quad_gym.VehicleParams,
    quad_gym.ImuParams,
    quad_gym.GnssParams,
    quad_gym.CameraParams,
    quad_gym.FilterParams,
    quad_gym.InitialPoseParams,
    quad_gym.NoisyObservationParams,
    quad_gym.LogDelays,
    quad_gym.SensorSuite,
    quad_gym.PDGains,
    quad_gym.RewardParams,
    quad_gym.ActionParams,
    Clocks,
    quad_gym.TaskParams,
    quad_gym.WorldParams,
    quad_gym.Wall,
    quad_gym.Cylinder,
    quad_gym.BatteryParams,
    quad_gym.GroundParams,
]
NO_NUMBERS = ["fast", "3", b"3", True, np.True_, 3j, np.array([3.0]), 10**400]
NO_NUMBERS += [None, float("nan"), float("inf"), [1.0, 2.0]]
BELOW_ZERO = [-1.0, *NO_NUMBERS]
NOT_POSITIVE = [0.0, *BELOW_ZERO]
NO_PHASES = [-0.1, 1.0, "soon", float("nan")]
NO_VECTORS = [(1.0, 2.0), 1.0, "abc", None, (1.0, 2.0, float("nan")), (1.0, 2.0, 3.0, 4.0)]
NO_VECTORS += [("1", "2", "3"), (True, 1.0, 1.0), (None, 1.0, 1.0), np.ones(3, bool)]
NO_MATRICES = [np.zeros((3, 2)), np.zeros(3), "abc", None, np.full((3, 3), np.nan)]

BAD_VALUES = {
    ("VehicleParams", "mass"): NOT_POSITIVE,
    ("VehicleParams", "thrust_coefficient"): NOT_POSITIVE,
    ("VehicleParams", "torque_coefficient"): NOT_POSITIVE,
    ("VehicleParams", "motor_time_constant"): [*NOT_POSITIVE, 50.0],
    ("VehicleParams", "motor_speed_per_volt"): NOT_POSITIVE,
    ("VehicleParams", "max_voltage"): NOT_POSITIVE,
    ("VehicleParams", "gravity"): NOT_POSITIVE,
    ("VehicleParams", "disc_area"): BELOW_ZERO,
    ("VehicleParams", "drag_coefficient"): BELOW_ZERO,
    ("VehicleParams", "air_density"): BELOW_ZERO,
    ("VehicleParams", "inertia"): [
        *NO_MATRICES,
        np.zeros((3, 3)),
        np.diag([1.0, 1.0, 0.0]),
        np.diag([2600.0, 5000.0, 7000.0]),  # kg mm^2
        np.diag([1.0, -1.0, 1.0]),
        np.eye(3) + np.eye(3, k=1),
    ],
    ("VehicleParams", "rotor_positions_B"): [
        *NO_MATRICES,
        np.zeros((4, 3)),
        np.zeros((3, 3)),
        [(x, 0.0, 0.0) for x in (-2.0, -1.0, 1.0, 2.0)],
    ],
    ("VehicleParams", "rotor_spins"): [*NO_VECTORS[:5], (1.0, -1.0, 1.0), (1.0, -1.0, 1.0, 0.5)],
    ("ImuParams", "rate"): NOT_POSITIVE,
    ("ImuParams", "lever_arm_B"): NO_VECTORS,
    ("ImuParams", "samples"): ["mean", None, 1],
    ("ImuParams", "accel_noise_density"): NOT_POSITIVE,
    ("ImuParams", "gyro_noise_density"): NOT_POSITIVE,
    ("ImuParams", "accel_bias_sigma"): NOT_POSITIVE,
    ("ImuParams", "gyro_bias_sigma"): NOT_POSITIVE,
    ("ImuParams", "accel_bias_tau"): NOT_POSITIVE,
    ("ImuParams", "gyro_bias_tau"): NOT_POSITIVE,
    ("ImuParams", "accel_scale_sigma"): BELOW_ZERO,
    ("ImuParams", "gyro_scale_sigma"): BELOW_ZERO,
    ("ImuParams", "accel_misalignment_sigma"): BELOW_ZERO,
    ("ImuParams", "gyro_misalignment_sigma"): BELOW_ZERO,
    ("ImuParams", "accel_vibration"): BELOW_ZERO,
    ("ImuParams", "gyro_vibration"): BELOW_ZERO,
    ("GnssParams", "rate"): NOT_POSITIVE,
    ("GnssParams", "primary_antenna_B"): NO_VECTORS,
    ("GnssParams", "secondary_antenna_B"): [
        *(bad for bad in NO_VECTORS if bad is not None),
        (0.1013, -0.0004, 0.0472),
    ],
    ("GnssParams", "reference_antenna_G"): [*NO_VECTORS, (0.0, 0.0, 0.0), (30.29, -97.74, 100.0)],
    ("GnssParams", "position_sigma_I"): [*NO_VECTORS, (0.01, 0.01, 0.0), (0.01, -0.01, 0.01)],
    ("GnssParams", "baseline_sigma"): NOT_POSITIVE,
    ("GnssParams", "velocity_sigma"): [0.0, -1.0, "fast", float("nan")],
    ("GnssParams", "phase"): NO_PHASES,
    ("GnssParams", "latency"): BELOW_ZERO,
    ("GnssParams", "heading_error_sigma"): BELOW_ZERO,
    ("GnssParams", "drift_sigma_I"): [*NO_VECTORS, (0.1, -0.1, 0.1)],
    ("GnssParams", "drift_tau"): NOT_POSITIVE,
    **{
        (kind, name): bad
        for kind in ("BarometerParams", "MagnetometerParams")
        for name, bad in (("rate", NOT_POSITIVE), ("phase", NO_PHASES), ("latency", BELOW_ZERO))
    },
    ("BarometerParams", "noise_sigma"): NOT_POSITIVE,
    ("BarometerParams", "bias_sigma"): NOT_POSITIVE,
    ("BarometerParams", "bias_tau"): NOT_POSITIVE,
    ("MagnetometerParams", "noise_sigma"): NOT_POSITIVE,
    ("MagnetometerParams", "hard_iron_sigma"): NOT_POSITIVE,
    ("MagnetometerParams", "hard_iron_tau"): [0.0, -1.0, float("nan")],
    ("MagnetometerParams", "soft_iron_sigma"): BELOW_ZERO,
    ("MagnetometerParams", "strength"): [*NOT_POSITIVE, 46.0],
    ("MagnetometerParams", "declination"): [4.0, -4.0, *NO_NUMBERS],
    ("MagnetometerParams", "inclination"): [2.0, 1.5707, *NO_NUMBERS],
    ("MagnetometerParams", "declination_sigma"): NOT_POSITIVE,
    ("CameraParams", "phase"): NO_PHASES,
    ("CameraParams", "latency"): BELOW_ZERO,
    ("CameraParams", "exposure"): BELOW_ZERO,
    ("CameraParams", "max_range"): [0.0, -1.0, "far"],
    ("CameraParams", "rate"): NOT_POSITIVE,
    ("CameraParams", "position_B"): NO_VECTORS,
    ("CameraParams", "attitude"): NO_VECTORS,
    ("CameraParams", "focal_length"): NOT_POSITIVE,
    ("CameraParams", "image_size"): [(1.0, 2.0, 3.0), 1.0, (0.0, 1.0), (100.0, -1.0), None],
    ("CameraParams", "pixel_sigma"): NOT_POSITIVE,
    ("CameraParams", "features_I"): [
        (),
        np.zeros((2, 2)),
        [1.0, 2.0, 3.0],
        [[0.0, 0.0, float("nan")]],
        np.zeros((MAX_FEATURES + 1, 3)),
        None,
        5.0,
    ],
    ("FilterParams", "alpha"): NOT_POSITIVE,
    ("FilterParams", "beta"): BELOW_ZERO,
    ("FilterParams", "kappa"): [-14.5, *NO_NUMBERS],
    ("FilterParams", "direction_variance_floor"): NOT_POSITIVE,
    ("FilterParams", "kind"): ["UKF", "particle", None],
    ("FilterParams", "integration"): ["heun", None, 2],
    ("FilterParams", "attitude_reset"): ["turn", 1, None],
    ("FilterParams", "bearing_noise_at"): ["sideways", None, 1],
    ("FilterParams", "initial_velocity_variance"): NOT_POSITIVE,
    ("FilterParams", "initial_covariance_scale"): NOT_POSITIVE,
    ("FilterParams", "initial_tilt_sigma"): [0.0, -1.0, "fast", float("nan")],
    ("FilterParams", "false_alarm_probability"): [0.5, 1.0, *BELOW_ZERO],
    ("FilterParams", "max_direction_sigma"): NOT_POSITIVE,
    ("FilterParams", "recursive_update_threshold"): [0.0, -1.0, "fast", float("nan")],
    ("FilterParams", "delay_compensation"): ["drop", None, 1],
    ("FilterParams", "max_rejections"): [0, -1, 1.5, True, *NO_NUMBERS],
    ("InitialPoseParams", "position_sigma"): NOT_POSITIVE,
    ("InitialPoseParams", "heading_sigma"): NOT_POSITIVE,
    ("FilterParams", "gravity"): NOT_POSITIVE,
    ("NoisyObservationParams", "position"): BELOW_ZERO,
    ("NoisyObservationParams", "velocity"): BELOW_ZERO,
    ("NoisyObservationParams", "attitude"): BELOW_ZERO,
    ("NoisyObservationParams", "body_rates"): BELOW_ZERO,
    ("LogDelays", "gnss"): [-2.1, 2.1, *NO_NUMBERS],
    ("LogDelays", "camera"): [-2.1, 2.1, *NO_NUMBERS],
    ("LogDelays", "magnetometer"): [-2.1, 2.1, *NO_NUMBERS],
    ("LogDelays", "barometer"): [-2.1, 2.1, *NO_NUMBERS],
    ("PDGains", "position"): BELOW_ZERO,
    ("PDGains", "velocity"): BELOW_ZERO,
    ("PDGains", "attitude"): [*NO_VECTORS, (1.0, 1.0, -1.0)],
    ("PDGains", "body_rates"): [*NO_VECTORS, (1.0, 1.0, -1.0)],
    ("ActionParams", "rate_scale"): [*NO_VECTORS, (1.0, 0.0, 1.0)],
    ("ActionParams", "tilt_scale"): [*NOT_POSITIVE, np.pi / 2],
    ("ActionParams", "velocity_scale"): NOT_POSITIVE,
    ("ActionParams", "rate_bandwidth"): NOT_POSITIVE,
    ("ActionParams", "attitude_bandwidth"): NOT_POSITIVE,
    ("ActionParams", "velocity_bandwidth"): NOT_POSITIVE,
    ("Clocks", "imu_rate"): NOT_POSITIVE,
    ("Clocks", "control_rate"): [*NOT_POSITIVE, 60.0, 400.0, 199.0],
    ("Clocks", "gnss_rate"): [*NOT_POSITIVE, 30.0, 201.0],
    ("Clocks", "camera_rate"): [*NOT_POSITIVE, 30.0, 1000.0],
    ("Clocks", "substeps"): [0, -1, 1.5, True, *NO_NUMBERS],
    ("TaskParams", "kind"): ["square", None, 1],
    ("TaskParams", "start"): ["air", None],
    ("TaskParams", "reward_per"): ["episode", None, 1],
    ("TaskParams", "radius"): NOT_POSITIVE,
    ("TaskParams", "period"): NOT_POSITIVE,
    ("TaskParams", "height"): NOT_POSITIVE,
    ("TaskParams", "duration"): BELOW_ZERO,
    ("TaskParams", "out_of_bounds"): NOT_POSITIVE,
    ("TaskParams", "min_height"): NO_NUMBERS,
    ("TaskParams", "max_tilt"): [*NOT_POSITIVE, 3.2],
    ("TaskParams", "max_speed"): NOT_POSITIVE,
    ("TaskParams", "max_acceleration"): NOT_POSITIVE,
    ("TaskParams", "gate_count"): [0, MAX_GATES + 1, 2.5, *NO_NUMBERS],
    ("TaskParams", "gate_radius"): NOT_POSITIVE,
    ("WorldParams", "wind_I"): NO_VECTORS,
    ("WorldParams", "gust_wind_speed"): BELOW_ZERO,
    ("WorldParams", "linear_drag_B"): [*NO_VECTORS, (0.1, 0.1, -0.1)],
    ("WorldParams", "rotor_drag_B"): [*NO_VECTORS, (0.1, 0.1, -0.1)],
    ("WorldParams", "rotor_radius"): NOT_POSITIVE,
    ("WorldParams", "ground_height"): NO_NUMBERS,
    ("WorldParams", "battery"): ["full", 3.0],
    ("WorldParams", "obstacles"): ["wall", [1.0], quad_gym.Wall()],
    ("WorldParams", "vehicle_radius"): [*NOT_POSITIVE, 1e3],
    ("WorldParams", "geofence"): ["here", 1.0, ((0.0, 0.0, 0.0), (1.0, 0.0, 1.0))],
    **{
        (kind, name): [*NO_VECTORS, (0.0, 1e5, 0.0)]
        for kind in ("Wall", "Cylinder")
        for name in ("center_I", "shift_I")
    },
    ("Wall", "follows"): ["first", -1, 0.5],
    ("Cylinder", "follows"): ["first", -1, 0.5],
    ("Wall", "size"): [*NO_VECTORS, (1.0, 0.0, 1.0), (1.0, 1e5, 1.0)],
    ("Wall", "yaw"): NO_NUMBERS,
    ("Cylinder", "radius"): [*NOT_POSITIVE, 1e5],
    ("Cylinder", "height"): [*NOT_POSITIVE, 1e5],
    ("WorldParams", "ground"): [True, "contact", 1.0],
    ("GroundParams", "feet_B"): [*NO_MATRICES, np.zeros((4, 3)), np.full((4, 3), -0.1)],
    ("GroundParams", "friction"): BELOW_ZERO,
    ("GroundParams", "max_touchdown_speed"): [*NOT_POSITIVE, 0.1],
    ("GroundParams", "max_touchdown_tilt"): [*NOT_POSITIVE, 4.0],
    ("BatteryParams", "energy"): NOT_POSITIVE,
    ("BatteryParams", "charge"): [*NOT_POSITIVE, 1.1],
    ("BatteryParams", "empty_voltage"): [*NOT_POSITIVE, 1.1],
    ("BatteryParams", "resistance"): BELOW_ZERO,
    ("BatteryParams", "motor_efficiency"): [*NOT_POSITIVE, 1.1],
    **{
        ("RewardParams", field.name): BELOW_ZERO
        for field in dataclasses.fields(quad_gym.RewardParams)
    },
    ("TaskParams", "reward_params"): [None, 1.0, {"near": 1.0}],
    ("TaskParams", "preview"): [(0.2,), 0.2, (-0.1, 0.2), (0.1, float("nan")), None],
    ("TaskParams", "trajectory"): [3, [], "nowhere.csv", [None], float("nan")],
}


@pytest.mark.parametrize("kind", CLASSES)
def test_parameters_are_frozen_and_keyword_only(kind):
    made = kind()
    for f in dataclasses.fields(kind):
        assert f.kw_only, f.name
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(made, f.name, getattr(made, f.name))
    with pytest.raises(TypeError):
        kind(1.0)
    with pytest.raises(TypeError):
        kind(colour="red")


@pytest.mark.parametrize("kind", CLASSES)
def test_parameters_are_values_that_compare_and_hash(kind):
    assert kind() == kind()
    assert hash(kind()) == hash(kind())
    assert kind().replace() == kind()


@pytest.mark.parametrize(("kind", "name"), BAD_VALUES, ids=lambda part: part)
def test_a_value_that_is_invalid_is_refused_by_the_name_of_its_field(kind, name):
    for bad in BAD_VALUES[kind, name]:
        with pytest.raises(ValueError, match=rf"\b{name}\b"):
            (Clocks if kind == "Clocks" else getattr(quad_gym, kind))(**{name: bad})


def test_every_field_but_flags_is_tried():
    tried = set(BAD_VALUES)
    for kind in set(CLASSES) - {quad_gym.SensorSuite}:
        fields = {(kind.__name__, f.name) for f in dataclasses.fields(kind) if f.type is not bool}
        missing = fields - tried
        assert not missing


def test_arrays_become_tuples_so_that_nobody_can_change_them():
    inertia = np.diag([1.0, 2.0, 3.0])
    vehicle = quad_gym.VehicleParams(inertia=inertia)
    inertia[0, 0] = -1.0
    assert vehicle.inertia == ((1.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 3.0))


@pytest.mark.parametrize(
    ("preset", "argument"),
    [
        (quad_gym.sensor_suite, "sensors"),
        (quad_gym.vehicle_params, "vehicle"),
        (quad_gym.pd_gains, "gains"),
    ],
)
def test_presets_are_known_by_name(preset, argument):
    assert preset("lab") == preset("lab")
    for unknown in ("garage", None, ["lab"]):
        with pytest.raises(ValueError, match=rf"^{argument} must be one of (standard, )?lab"):
            preset(unknown)


def test_the_laboratory_presets_hold_the_laboratorys_numbers():
    suite, vehicle, gains = (
        preset("lab")
        for preset in (quad_gym.sensor_suite, quad_gym.vehicle_params, quad_gym.pd_gains)
    )
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
    clocks = Clocks.of(suite, control_rate=50.0)
    assert [clocks.ticks_between(n) for n in ("control", "gnss", "camera")] == [4, 20, 10]


def test_sensors_that_measure_at_every_tick_follow_a_new_tick():
    suite = quad_gym.sensor_suite("lab").with_rates(imu=400.0)
    assert (suite.imu.rate, suite.gnss.rate, suite.camera.rate) == (400.0, 400.0, 400.0)
    slow = quad_gym.sensor_suite("lab").with_rates(gnss=10.0).with_rates(imu=100.0)
    assert (slow.gnss.rate, slow.camera.rate) == (10.0, 100.0)


def test_a_suite_without_a_camera_takes_other_rates():
    blind = quad_gym.SensorSuite(camera=None).with_rates(imu=100.0, gnss=50.0)
    assert blind.camera is None
    assert (blind.imu.rate, blind.gnss.rate) == (100.0, 50.0)


@pytest.mark.parametrize("rate", [30.0, 400.0, 0.0, -10.0, float("nan"), "often"])
@pytest.mark.parametrize("sensor", ["gnss", "camera"])
def test_a_rate_that_is_no_whole_number_of_ticks_is_refused_by_name(sensor, rate):
    with pytest.raises(ValueError, match=f"^{sensor}_rate must"):
        quad_gym.sensor_suite("lab").with_rates(**{sensor: rate})


@pytest.mark.parametrize("rate", [0.0, -200.0, float("inf"), "often"])
def test_a_bad_imu_rate_is_refused_by_name(rate):
    with pytest.raises(ValueError, match=r"^imu_rate must"):
        quad_gym.sensor_suite("lab").with_rates(imu=rate)


def test_a_suite_whose_clocks_do_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"^GnssParams\.rate must"):
        quad_gym.SensorSuite(gnss=quad_gym.GnssParams(rate=30.0))
    with pytest.raises(ValueError, match=r"^CameraParams\.rate must"):
        quad_gym.SensorSuite(camera=quad_gym.CameraParams(rate=150.0))


def test_scaled_noise_scales_every_white_noise_and_nothing_else():
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
