"""Arms of a study of what becomes of a policy whose filter lies about its covariance.

    quad-gym study --arms-file baselines/arms_misled.py

All fly LookAround with the policy that ships, which was trained with a consistent filter. Nothing
is trained.
"""

from typing import Any

from baselines.arms import Arm
from quad_gym import sensor_suite

_SUITE = sensor_suite("one_wall")
_DOUBTING = "baselines.arm_tasks:Doubting"


_NOISES = (
    *("accel_noise_density", "gyro_noise_density", "accel_vibration", "gyro_vibration"),
    *("accel_bias_sigma", "gyro_bias_sigma", "accel_scale_sigma", "accel_misalignment_sigma"),
)
"""What the filter may be wrong about: all the errors that its IMU has."""


def _flown(name: str, label: str, custom: str = _DOUBTING, **environment: Any) -> Arm:
    return Arm(
        name=name,
        label=label,
        policy="pretrained",
        environment={"custom": custom, **environment},
    )


def _believing(name: str, label: str, factor: float) -> Arm:
    """A filter that takes the IMU for so many times as noisy, and as drifting, as it is."""
    imu = _SUITE.imu
    believed = imu.replace(**{each: factor * getattr(imu, each) for each in _NOISES})
    return _flown(name, label, sensors=_SUITE.replace(imu=believed), true_sensors=_SUITE)


ARMS = (
    _flown("consistent", "consistent filter"),
    *(
        _flown(
            f"told_{name.lower()}",
            f"told {number} its standard deviation",
            f"baselines.arm_tasks:TOLD_{name}",
        )
        for name, number in (
            ("A_QUARTER", "1/4 of"),
            ("HALF", "1/2 of"),
            ("TWICE", "twice"),
            ("FOURFOLD", "4 times"),
        )
    ),
    _believing("imu_a_quarter", "filter believes in 1/4 of the IMU's noise", 0.25),
    _believing("imu_half", "filter believes in 1/2 of the IMU's noise", 0.5),
    _believing("imu_twice", "filter believes in twice the IMU's noise", 2.0),
    _believing("imu_fourfold", "filter believes in 4 times the IMU's noise", 4.0),
    _flown(
        "report",
        "filter of the report's form",
        sensors=_SUITE.replace(
            estimator=sensor_suite("lab").estimator, imu=_SUITE.imu.replace(samples="instant")
        ),
    ),
)
"""Those of `QuadGym/LookAround-v0`."""
