"""Arms of a study of the standard deviations that matter to a policy.

    python -m scripts.studies stale_race --arms-file scripts/studies/arms_masked.py

All arms fly StaleRace with the pretrained policy, which was trained with all fifteen standard
deviations in its observation. No arm is trained. Masked standard deviations are replaced by their
constant medians.
"""

from scripts.studies.arms import Arm

_BLOCKS = {
    "POSITION": "the position's",
    "VELOCITY": "the velocity's",
    "ATTITUDE": "the attitude's",
    "ACCEL_BIAS": "the accelerometer bias's",
    "GYRO_BIAS": "the gyro bias's",
}


def _flown(task: str, label: str) -> Arm:
    return Arm(
        task.lower(),
        label,
        policy="pretrained",
        environment={"task": f"scripts.studies.arm_tasks:{task}"},
    )


ARMS = (
    _flown("ALL_SHOWN", "all 15 standard deviations"),
    *(_flown(f"{name}_MASKED", f"all but {label}") for name, label in _BLOCKS.items()),
    *(_flown(f"ONLY_{name}", f"only {label}") for name, label in _BLOCKS.items()),
    _flown("NONE_SHOWN", "none"),
)
"""Arms of `QuadGym/StaleRace-v0`."""
