"""Parameters as records: from the dataclasses that users write to the numbers that kernels read."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.frames import ecef_to_enu
from quad_gym.params import STARTS, TASKS, ActionParams, Clocks, PDGains, TaskParams, VehicleParams
from quad_gym.records import (
    PARAMS,
    PARAMS_BLOCK,
    SETTINGS,
    Autoreset,
    Control,
    FilterForm,
    Layout,
    Source,
    aligned_zeros,
)
from quad_gym.rotations import euler_to_dcm
from quad_gym.sensor_params import FilterParams, SensorSuite


def params_record(
    vehicle: VehicleParams,
    sensors: SensorSuite,
    gains: PDGains | None = None,
    actions: ActionParams | None = None,
) -> NDArray[Any]:
    """The numbers of a vehicle, its sensors and its gains as one scalar record, shape (1,)."""
    gains = PDGains() if gains is None else gains
    actions = ActionParams() if actions is None else actions
    imu, gnss, estimator = sensors.imu, sensors.gnss, sensors.estimator
    record = np.zeros(1, PARAMS)
    p = record[0]

    p["gravity"], p["mass"] = vehicle.gravity, vehicle.mass
    p["inertia"], p["inertia_inverse"] = vehicle.inertia, np.linalg.inv(vehicle.inertia)
    p["half_drag"] = 0.5 * vehicle.drag_coefficient * vehicle.disc_area * vehicle.air_density
    p["kF"] = vehicle.thrust_coefficient
    p["effectiveness"] = vehicle.effectiveness
    p["allocation"] = np.linalg.inv(vehicle.effectiveness)
    p["motor_tau"], p["motor_gain"] = vehicle.motor_time_constant, vehicle.motor_speed_per_volt
    p["max_voltage"], p["max_rotor_force"] = vehicle.max_voltage, vehicle.max_rotor_force
    p["hover_voltage"] = vehicle.hover_voltage
    p["gain_k"], p["gain_kd"] = gains.position, gains.velocity
    p["gain_K"], p["gain_Kd"] = gains.attitude, gains.body_rates

    p["rate_bandwidth"], p["attitude_bandwidth"] = (
        actions.rate_bandwidth,
        actions.attitude_bandwidth,
    )
    p["velocity_bandwidth"], p["velocity_scale"] = (
        actions.velocity_bandwidth,
        actions.velocity_scale,
    )
    p["rate_scale"], p["tilt_scale"] = actions.rate_scale, actions.tilt_scale
    p["torque_scale"] = vehicle.hover_torques

    p["dt"], p["imu_lever_arm"] = imu.dt, imu.lever_arm_B
    p["accel_sigma"] = imu.accel_noise_density / np.sqrt(imu.dt)
    p["gyro_sigma"] = imu.gyro_noise_density / np.sqrt(imu.dt)
    for sensor in ("accel", "gyro"):
        sigma, tau = getattr(imu, f"{sensor}_bias_sigma"), getattr(imu, f"{sensor}_bias_tau")
        p[f"{sensor}_bias_sigma"] = sigma
        p[f"{sensor}_bias_decay"] = np.exp(-imu.dt / tau)
        p[f"{sensor}_bias_drive"] = sigma * np.sqrt(-np.expm1(-2.0 * imu.dt / tau))

    p["R_IG"] = ecef_to_enu(gnss.reference_antenna_G)
    p["antenna"], p["baseline"] = gnss.primary_antenna_B, gnss.baseline_B
    p["baseline_length"] = np.linalg.norm(gnss.baseline_B)
    p["gnss_sigma"], p["baseline_sigma"] = gnss.position_sigma_I, gnss.baseline_sigma

    if sensors.camera is not None:
        camera = sensors.camera
        p["camera"], p["R_CB"] = camera.position_B, euler_to_dcm(camera.attitude)
        p["pixel_size"], p["focal_length"] = camera.pixel_size, camera.focal_length
        p["half_image"] = np.array(camera.image_size) / 2
        p["pixel_sigma"] = camera.pixel_sigma
        p["features"][: len(camera.features_I)] = camera.features_I

    p["sigma_spread"], p["sigma_beta"] = estimator.alpha, estimator.beta
    p["sigma_kappa"] = estimator.kappa
    p["direction_floor"] = estimator.direction_variance_floor
    p["noise_at_prediction"] = estimator.feature_noise_across == "predicted"
    p["initial_velocity_variance"] = estimator.initial_velocity_variance
    p["initial_scale"] = estimator.initial_scale
    noisy = sensors.noisy
    p["noisy_sigma"] = (noisy.position, noisy.velocity, noisy.attitude, noisy.body_rates)
    return record


def form_of(estimator: FilterParams) -> FilterForm:
    """How a filter differs from the report's, for the kernels."""
    form = FilterForm(0)
    if estimator.kind == "ekf":
        form |= FilterForm.EKF
    if estimator.integration == "midpoint":
        form |= FilterForm.MIDPOINT
    if estimator.covariance_reset == "turn":
        form |= FilterForm.TURN
    return form


def params_block(record: NDArray[Any]) -> NDArray[Any]:
    """A scalar parameter record repeated for the eight flights of a block, shape (1,)."""
    block = aligned_zeros(1, PARAMS_BLOCK)
    for name in PARAMS.names or ():
        block[name][...] = record[name][..., np.newaxis]
    return block


def settings_record(
    task: TaskParams,
    clocks: Clocks,
    sensors: SensorSuite,
    *,
    source: Source,
    control: Control,
    layout: Layout,
    include_covariance: bool,
    privileged: bool,
    autoreset: Autoreset,
    run_filter: bool,
) -> NDArray[Any]:
    """What a batch does, as one scalar record, shape (1,)."""
    record = np.zeros(1, SETTINGS)
    s = record[0]
    s["substeps"], s["ticks_per_step"] = clocks.substeps, clocks.ticks_between("control")
    s["gnss_ticks"] = clocks.ticks_between("gnss")
    s["form"] = form_of(sensors.estimator)
    s["imu_averages"] = sensors.imu.samples == "average"
    if sensors.camera is not None:
        s["camera_ticks"] = clocks.ticks_between("camera")
        s["feature_count"] = len(sensors.camera.features_I)
    s["source"], s["control"], s["layout"] = source, control, layout
    s["include_covariance"], s["privileged"] = include_covariance, privileged
    s["autoreset"], s["run_filter"] = autoreset, run_filter
    s["task"], s["start"] = 1 + TASKS.index(task.kind), STARTS.index(task.start)
    s["randomize"] = task.randomize
    s["max_steps"] = round(task.duration * clocks.control_rate)
    s["out_of_bounds"], s["ground"] = task.out_of_bounds, task.ground
    s["least_up"] = np.cos(task.max_tilt)
    s["radius"], s["period"], s["height"] = task.radius, task.period, task.height
    s["max_speed"], s["max_acceleration"] = task.max_speed, task.max_acceleration
    s["gate_count"], s["gate_radius"] = task.gate_count, task.gate_radius
    s["preview"] = task.preview
    return record
