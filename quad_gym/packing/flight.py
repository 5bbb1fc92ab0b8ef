"""Parameters as records: conversion of the dataclasses to numbers for kernels."""

import math
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.frames import ecef_to_enu
from quad_gym.packing.aids import decay_and_drive, gate_limit, pack_aids, slow_states
from quad_gym.params import portable
from quad_gym.params.aids import SlowError
from quad_gym.params.control import ActionParams, PDGains
from quad_gym.params.ground import GroundParams
from quad_gym.params.imu import ImuParams
from quad_gym.params.randomization import nominal_values
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.vehicle import VehicleParams
from quad_gym.params.world import BatteryParams, WorldParams
from quad_gym.records import (
    GROUP_FREEDOMS,
    PARAMETERS_DRAWN,
    PARAMS,
    PARAMS_BLOCK,
    PARAMS_FIELDS,
    FilterForm,
    aligned_zeros,
)

_NAMES = frozenset(field.name for field in PARAMS_FIELDS)


def _copy(p: Any, part: Any, prefix: str = "") -> None:
    """Copy the parameters that have a field with their name in the record; None stays zero."""
    for name in (field.name for field in fields(part)):
        if prefix + name in _NAMES and getattr(part, name) is not None:
            p[prefix + name] = getattr(part, name)


def params_record(
    vehicle: VehicleParams,
    sensors: SensorSuite,
    gains: PDGains | None = None,
    action_params: ActionParams | None = None,
    world: WorldParams | None = None,
) -> NDArray[Any]:
    """Return a vehicle, its sensors, gains and world as one scalar record, shape (1,)."""
    record = np.zeros(1, PARAMS)
    p = record[0]
    world = WorldParams() if world is None else world
    _copy(p, sensors.estimator)
    actions = action_params or ActionParams()
    for part in (vehicle, world, actions, sensors.imu, sensors.initial_pose):
        _copy(p, part)
    _copy(p, world.ground or GroundParams())
    _copy(p, world.battery or BatteryParams(), "battery_")
    _copy(p, gains or PDGains(), "gain_")
    drawable = nominal_values(vehicle, sensors, world)[:PARAMETERS_DRAWN]
    first = record.view(np.float64)[:PARAMETERS_DRAWN]
    np.copyto(first, drawable, where=~np.isnan(drawable))
    _pack_vehicle(p, vehicle)
    _pack_imu(p, sensors, vehicle)
    _pack_gnss(p, sensors)
    if sensors.camera is not None:
        camera = sensors.camera
        _copy(p, camera)
        p["camera"] = camera.position_B
        p["R_CB"] = portable.euler_dcm(camera.attitude)
        p["half_image"], p["blur"] = np.array(camera.image_size) / 2, camera.blur
        p["features"][: len(camera.features_I)] = camera.features_I
    pack_aids(p, sensors)
    pack_tick(p, sensors)
    _pack_filter(p, sensors)
    noisy = sensors.noisy
    p["noisy_sigma"] = (noisy.position, noisy.velocity, noisy.attitude, noisy.body_rates)
    return record


def _pack_vehicle(p: Any, vehicle: VehicleParams) -> None:
    """Write the numbers that are derived from the vehicle."""
    for name in ("effectiveness", "max_rotor_force", "hover_voltage"):
        p[name] = getattr(vehicle, name)
    p["sound_effectiveness"], p["torque_scale"] = vehicle.effectiveness, vehicle.hover_torques
    p["allocation"] = portable.inverse(vehicle.effectiveness)
    p["inertia_inverse"] = portable.inverse(vehicle.inertia)
    p["half_drag"] = 0.5 * vehicle.drag_coefficient * vehicle.disc_area * vehicle.air_density
    p["half_disc"] = 0.5 * vehicle.disc_area * vehicle.air_density


def _pack_imu(p: Any, sensors: SensorSuite, vehicle: VehicleParams) -> None:
    """Write the noise of the IMU's samples, and the noise due to vibration of the rotors."""
    imu = sensors.imu
    p["imu_lever_arm"] = imu.lever_arm_B
    hover_speed = vehicle.motor_speed_per_volt * vehicle.hover_voltage
    for sensor in ("accel", "gyro"):
        p[f"{sensor}_sigma"] = getattr(imu, f"{sensor}_noise_density") / math.sqrt(imu.dt)
        p[f"{sensor}_vibration"] = getattr(imu, f"{sensor}_vibration") / (hover_speed * hover_speed)


def pack_tick(p: Any, sensors: SensorSuite) -> None:
    """Write the numbers that depend on the duration of a tick, after gravity."""
    imu, dt = sensors.imu, sensors.imu.dt
    p["dt"], p["accel_error_noise"] = dt, imu.accel_error_noise
    biases = slow_errors_of(sensors)
    for sensor, error in zip(("accel", "gyro"), biases, strict=False):
        p[f"{sensor}_noise"] = getattr(imu, f"{sensor}_noise")
        # the vibration is given for rotors in hover, whose specific force is g
        p[f"{sensor}_thrust_noise"] = getattr(imu, f"{sensor}_vibration") / p["gravity"]
        p[f"{sensor}_bias_decay"], p[f"{sensor}_bias_drive"] = decay_and_drive(error, dt)
    for k, error in enumerate(biases[2:]):
        p["slow_decay"][k], p["slow_drive"][k] = decay_and_drive(error, dt)


def slow_errors_of(sensors: SensorSuite) -> list[SlowError]:
    """Return the bias of accelerometer and gyro, and the slow errors among the filter's states."""
    imu = sensors.imu
    biases = [
        SlowError(getattr(imu, f"{sensor}_bias_sigma"), getattr(imu, f"{sensor}_bias_tau"))
        for sensor in ("accel", "gyro")
    ]
    return [*biases, *slow_states(sensors).errors]


def _pack_gnss(p: Any, sensors: SensorSuite) -> None:
    """Write the GNSS; without one, write the initial pose as if GNSS had measured it."""
    gnss, pose = sensors.gnss, sensors.initial_pose
    if gnss is None:  # the antenna is at the center, the baseline along the x axis
        p["R_IG"], p["position_sigma_I"] = np.eye(3), pose.position_sigma
    else:
        _copy(p, gnss)
        p["R_IG"] = ecef_to_enu(gnss.reference_antenna_G)
        p["antenna"] = gnss.primary_antenna_B
        drift = SlowError(1.0, gnss.rate * gnss.drift_tau)  # in measurements
        p["drift_decay"], drive = decay_and_drive(drift, 1.0)
        p["drift_drive"] = np.array(gnss.drift_sigma_I) * drive
    if gnss is not None and gnss.has_baseline:
        p["baseline"], p["baseline_length"] = gnss.baseline_B, portable.norm(gnss.baseline_B)
        p["first_baseline_sigma"] = gnss.first_baseline_sigma
        p["baseline_noise"] = gnss.baseline_noise
    else:  # with GNSS a vertical one, which does not observe the heading either
        p["baseline"] = (1.0, 0.0, 0.0) if gnss is None else (0.0, 0.0, 1.0)
        p["baseline_length"] = 1.0
        for name in ("baseline_sigma", "first_baseline_sigma", "baseline_noise"):
            p[name] = pose.heading_sigma
    p["secondary_antenna_B"] = p["antenna"] + p["baseline"]


def _pack_filter(p: Any, sensors: SensorSuite) -> None:
    """Write the sigma points, noise models and gates of the filter."""
    estimator = sensors.estimator
    p["sigma_spread"], p["sigma_beta"] = estimator.alpha, estimator.beta
    p["sigma_kappa"] = estimator.kappa
    p["direction_floor"] = estimator.direction_variance_floor
    p["noise_at_prediction"] = estimator.bearing_noise_at != "measured"
    p["noise_pinhole"] = estimator.bearing_noise_at == "pinhole"
    alarm = estimator.false_alarm_probability
    p["gate"] = [gate_limit(freedoms, alarm) for freedoms in GROUP_FREEDOMS]
    sigma = math.inf if sensors.gnss is None else estimator.max_direction_sigma
    p["gate_uncertainty"] = sigma * sigma


def form_of(sensors: SensorSuite, innovations: bool = False, lever_arm: int = 0) -> FilterForm:
    """Return the options of a filter as flags; it may store innovations, and model a lever arm."""
    estimator = sensors.estimator
    options = {
        FilterForm.INNOVATIONS: innovations,
        FilterForm.EKF: estimator.kind == "ekf",
        FilterForm.MIDPOINT: estimator.integration == "midpoint",
        FilterForm.TURN: estimator.attitude_reset,
        FilterForm.FIRST_ESTIMATES: sensors.flow_alone,
        FilterForm.GATE: estimator.false_alarm_probability > 0.0,
        FilterForm.GRADUAL: estimator.recursive_update_threshold is not None,
    }
    return FilterForm(sum(flag for flag, on in options.items() if on) | lever_arm)


def lever_form(imu: ImuParams, drawn: bool = False) -> FilterForm:
    """Return flags for the lever arm of the assumed accelerometer, known or drawn; 0: none."""
    if not (drawn or any(imu.lever_arm_B)):
        return FilterForm(0)
    averages = imu.samples == "average"
    return FilterForm.LEVER_AVERAGES if averages else FilterForm.LEVER_SAMPLES


def params_block(record: NDArray[Any]) -> NDArray[Any]:
    """Return a scalar parameter record repeated for the flights of a block, shape (1,)."""
    block = aligned_zeros(1, PARAMS_BLOCK)
    for name in PARAMS.names or ():
        block[name][...] = record[name][..., np.newaxis]
    return block
