"""Numerical parameters of a suite's filter, as JSON or a C header."""

import json
import re
from typing import Any

import numpy as np

import quad_gym
from quad_gym.analysis.reports import as_json
from quad_gym.packing.aids import slow_states
from quad_gym.packing.flight import params_record
from quad_gym.params.filter import FilterParams
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.vehicle import vehicle_params
from quad_gym.records.params import PARAMS_FIELDS

_FIELDS = {
    "any": (
        *("gravity", "dt", "accel_noise", "accel_error_noise", "gyro_noise"),
        *("accel_thrust_noise", "gyro_thrust_noise"),
        *("accel_bias_decay", "gyro_bias_decay", "accel_bias_drive", "gyro_bias_drive"),
        *("accel_bias_sigma", "gyro_bias_sigma"),
        *("imu_lever_arm", "sigma_spread", "sigma_beta", "sigma_kappa", "direction_floor"),
        *("position_sigma_I", "heading_sigma", "R_IG", "antenna", "velocity_sigma"),
        *("initial_velocity_variance", "initial_covariance_scale", "initial_tilt_sigma"),
        *("gate_position", "gate_direction", "gate_uncertainty", "max_rejections"),
    ),
    "baseline": (
        "baseline_sigma",
        "baseline_noise",
        "first_baseline_sigma",
        "baseline",
        "baseline_length",
    ),
    "camera": (
        *("camera", "R_CB", "focal_length", "half_image", "pixel_sigma"),
        *(
            "blur",
            "features",
            "noise_at_prediction",
            "noise_pinhole",
            "recursive_update_threshold",
        ),
    ),
}
"""Parameters read by the filter's kernels: for any suite, for suites with two antennas or with the
landing mark that replaces them, and for suites with a camera."""

_SLOW = ("slow_sigma", "slow_decay", "slow_drive")
_AIDS = ("aid_sigma", "aid_gate", "aid_numbers")
"""Parameters for suites with time-correlated errors in the state, and with aiding sensors, in the
order of `Aid`."""

_MEANINGS = {
    "accel_error_noise": "noise of a sample per m/s^2 of f_B - (0, 0, g), for scale and alignment",
    "accel_noise": "noise of a sample in hover that the filter models as white",
    "accel_thrust_noise": "noise per m/s^2 by which |f_B| differs from g: sigma^2 (f_B^2 - g^2)",
    "gyro_thrust_noise": "likewise",
    "gyro_noise": "noise of a sample that the filter models as white",
    "accel_bias_decay": "decay of the bias over a tick: exp(-dt/tau)",
    "gyro_bias_decay": "decay of the bias over a tick: exp(-dt/tau)",
    "accel_bias_drive": "standard deviation of the bias's driving noise over a tick",
    "gyro_bias_drive": "standard deviation of the bias's driving noise over a tick",
    "accel_bias_sigma": "standard deviation of the bias at the start",
    "gyro_bias_sigma": "standard deviation of the bias at the start",
    "baseline_length": "length of the baseline",
    "first_baseline_sigma": "direction noise of the first baseline",
    "baseline_sigma": "direction noise of a baseline, without constant errors",
    "heading_sigma": "standard deviation of the heading if the initial pose defines it",
    "velocity_sigma": "noise of a GNSS velocity per axis; 0: not measured",
    "slow_sigma": "standard deviation at the start, of each time-correlated error in the state",
    "slow_decay": "decay of each time-correlated error over a tick",
    "slow_drive": "standard deviation of the driving noise of each of them over a tick",
    "aid_numbers": "further numbers of each sensor; for the magnetometer, the field in I [T]",
    "camera": "projection center of the camera in B",
    "pixel_sigma": "noise of a pixel per axis",
    "blur": "noise of a pixel per body rate",
    "initial_velocity_variance": "variance of the velocity at the start",
    "initial_covariance_scale": "factor on the first fix's covariance at the start",
    "initial_tilt_sigma": "standard deviation of roll and pitch at the start; 0: Wahba's problem",
}
"""Meanings of parameters whose description in `PARAMS_FIELDS` depends on neighboring entries."""

_CHOICES = ("kind", "integration", "attitude_reset", "bearing_noise_at", "delay_compensation")
"""Parameters of a filter that are words."""


def filter_numbers(suite: SensorSuite) -> dict[str, Any]:
    """Parameters with which the filter of a suite computes, in JSON types.

    Args:
        suite: Sensor suite with its filter.

    Returns:
        "choices", words; "rates" [Hz]; "latencies" [s]; "numbers", each with "value", "unit" and
        "meaning", in the form used in the equations (noise of a sample, not a density).
    """
    record = params_record(vehicle_params("lab"), suite)[0]
    names = _FIELDS["any"] + (_FIELDS["camera"] if suite.camera is not None else ())
    names += _FIELDS["baseline"] if suite.gnss is None or suite.gnss.has_baseline else ()
    names += (_SLOW if slow_states(suite).errors else ()) + (_AIDS if suite.aids else ())
    about = {field.name: field for field in PARAMS_FIELDS}
    numbers = {}
    for name in names:
        value = record[name]
        if name == "gravity":  # a stand-alone filter has its own
            value = np.float64(suite.estimator.gravity)
        if name in _SLOW:
            value = value[: slow_states(suite).estimated]
        if name == "features" and suite.camera is not None:
            value = value[: len(suite.camera.features_I)]
        if not np.isfinite(value).all():  # open gates, unlimited camera range
            continue
        numbers[name] = {
            "value": as_json(value),
            "unit": about[name].unit,
            "meaning": _MEANINGS.get(name, about[name].meaning),
        }
    estimator: FilterParams = suite.estimator
    sensors: dict[str, Any] = {"gnss": suite.gnss, "camera": suite.camera}
    sensors |= {aid.name.lower(): params for aid, params in suite.aids.items()}
    present = {name: sensor for name, sensor in sensors.items() if sensor is not None}
    return {
        "quad_gym": quad_gym.__version__,
        "choices": {name: getattr(estimator, name) for name in _CHOICES}
        | {
            "imu_samples": suite.imu.samples,
            "reuse_first_fix": estimator.reuse_first_fix,
            "estimates_gnss_drift": suite.drifts,
        },
        "rates": {"imu": suite.imu.rate, **{name: s.rate for name, s in present.items()}},
        "latencies": {name: s.latency for name, s in present.items()},
        "numbers": numbers,
    }


def filter_json(suite: SensorSuite) -> str:
    """Format `filter_numbers` as JSON text."""
    return json.dumps(filter_numbers(suite), indent=2, allow_nan=False) + "\n"


def filter_header(suite: SensorSuite, name: str) -> str:
    """Format `filter_numbers` as a C99 header, each number a constant with its unit and meaning.

    Args:
        suite: Sensor suite with its filter.
        name: Name of the suite, for the comment and the include guard.
    """
    found = filter_numbers(suite)
    guard = f"QUAD_GYM_FILTER_{re.sub(r'[^A-Z0-9]', '_', name.upper())}_H"
    lines = [
        f'/* The filter of the sensor suite "{name}"; quad_gym {quad_gym.__version__}.',
        " * SI units; I: inertial, east, north, up; B: body, x ahead, y left, z up; C: camera.",
        *(f" * {key}: {value}" for key, value in found["choices"].items()),
        *(f" * {key}: latency {value:g} s" for key, value in found["latencies"].items()),
        " */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
    ]
    for sensor, rate in found["rates"].items():
        lines.append(f"static const double {sensor}_rate = {rate!r}; /* Hz */")
    for key, number in found["numbers"].items():
        value = np.array(number["value"], np.float64)
        shape = "".join(f"[{n}]" for n in value.shape)
        said = f"{number['meaning']} [{number['unit']}]"
        lines.append(f"static const double {key}{shape} = {_braces(value.tolist())}; /* {said} */")
    return "\n".join([*lines, "", "#endif", ""])


def _braces(value: Any) -> str:
    if isinstance(value, list):
        return "{" + ", ".join(map(_braces, value)) + "}"
    return repr(value)
