"""Arms of a study of policies with a miscalibrated covariance.

    python -m scripts.studies --arms-file scripts/studies/arms_miscalibrated.py

All arms fly LookAround with the pretrained policy, which was trained with a consistent filter. No
arm is trained.
"""

from typing import Any

from quad_gym import sensor_suite
from scripts.studies.arms import Arm

_SUITE = sensor_suite("one_wall")
_WITH_STD = "baselines.arm_tasks:WithStd"


_NOISES = (
    "accel_noise_density",
    "gyro_noise_density",
    "accel_vibration",
    "gyro_vibration",
    "accel_bias_sigma",
    "gyro_bias_sigma",
    "accel_scale_sigma",
    "accel_misalignment_sigma",
)
"""Parameters of all IMU errors, which the filter may assume wrongly."""

_FACTORS = {"1_4": "1/4", "1_2": "1/2", "2": "2", "4": "4"}
"""Factors of standard deviations, as in names and in labels."""


def _flown(name: str, label: str, task: str = _WITH_STD, **environment: Any) -> Arm:
    return Arm(name, label, policy="pretrained", environment={"task": task, **environment})


def _assuming(name: str, label: str, factor: float) -> Arm:
    """Make an arm whose filter assumes IMU noise and drift multiplied by a factor."""
    imu = _SUITE.imu
    assumed = imu.replace(**{each: factor * getattr(imu, each) for each in _NOISES})
    return _flown(name, label, sensors=_SUITE.replace(imu=assumed), true_sensors=_SUITE)


ARMS = (
    _flown("consistent", "consistent filter"),
    *(
        _flown(
            f"reported_std_x{name}",
            f"reported standard deviation x {words}",
            f"scripts.studies.arm_tasks:REPORTED_STD_X{name}",
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
"""Arms of `QuadGym/LookAround-v0`."""
