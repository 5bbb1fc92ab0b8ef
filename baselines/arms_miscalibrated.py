"""Arms of a study of policies that fly with a miscalibrated covariance.

    quad-gym study --arms-file baselines/arms_miscalibrated.py

All fly LookAround with the pretrained policy, which was trained with a consistent filter. Nothing
is trained.
"""

from typing import Any

from baselines.arms import Arm
from quad_gym import sensor_suite

_SUITE = sensor_suite("one_wall")
_WITH_STD = "baselines.arm_tasks:WithStd"


_NOISES = (
    *("accel_noise_density", "gyro_noise_density", "accel_vibration", "gyro_vibration"),
    *("accel_bias_sigma", "gyro_bias_sigma", "accel_scale_sigma", "accel_misalignment_sigma"),
)
"""Parameters of the IMU that the filter may assume wrongly: all its errors."""

_FACTORS = {"1_4": "1/4", "1_2": "1/2", "2": "2", "4": "4"}
"""Factors of standard deviations as in names, and for people."""


def _flown(name: str, label: str, task: str = _WITH_STD, **environment: Any) -> Arm:
    return Arm(
        name=name,
        label=label,
        policy="pretrained",
        environment={"task": task, **environment},
    )


def _assuming(name: str, label: str, factor: float) -> Arm:
    """A filter that assumes the IMU's noise and drift to be so many times as large as they are."""
    imu = _SUITE.imu
    assumed = imu.replace(**{each: factor * getattr(imu, each) for each in _NOISES})
    return _flown(name, label, sensors=_SUITE.replace(imu=assumed), true_sensors=_SUITE)


ARMS = (
    _flown("consistent", "consistent filter"),
    *(
        _flown(
            f"reported_std_x{name}",
            f"reported standard deviation x {words}",
            f"baselines.arm_tasks:REPORTED_STD_X{name}",
        )
        for name, words in _FACTORS.items()
    ),
    *(
        _assuming(f"assumed_imu_noise_x{name}", f"filter assumes {words} the IMU noise", factor)
        for name, words, factor in (
            ("1_4", "1/4 of", 0.25),
            ("1_2", "1/2 of", 0.5),
            ("2", "2 times", 2.0),
            ("4", "4 times", 4.0),
        )
    ),
    _flown(
        "report",
        "filter of the report's form",
        sensors=_SUITE.replace(
            estimator=sensor_suite("lab").estimator, imu=_SUITE.imu.replace(samples="instant")
        ),
    ),
)
"""Those of `QuadGym/LookAround-v0`."""
