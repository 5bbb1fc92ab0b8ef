"""Environments that every interface must fly in the same way: base and keywords, by name."""

import numpy as np

import quad_gym
from quad_gym import LogUniform, Normal, Randomization, Uniform, WorldParams
from quad_gym.faults import RotorLoss, faults_of
from tests.estimators import Certain, Simple
from tests.golden.flights import AIDED
from tests.tasks.tasks import Chase, Near

LAB, STANDARD, RTK = (quad_gym.sensor_suite(name) for name in ("lab", "standard", "rtk"))
AVERAGES = LAB.replace(
    imu=LAB.imu.replace(samples="average"), estimator=LAB.estimator.replace(integration="midpoint")
)
LATE = RTK.replace(gnss=RTK.gnss.replace(latency=0.1), camera=RTK.camera.replace(latency=0.04))
GROUND = WorldParams(ground=quad_gym.GroundParams(), wind_I=(2.0, 0.0, 0.0))
OBSTACLES = WorldParams(
    obstacles=(
        quad_gym.Wall(center_I=(5.5, 0.0, 1.0), size=(0.2, 6.0, 3.0), shift_I=(0.4, 0.0, 0.0)),
        quad_gym.Cylinder(center_I=(2.0, 0.5, 1.0), radius=0.3, shift_I=(0.3, 0.3, 0.0)),
    ),
    geofence=((-1.0, -2.0, -1.0), (9.0, 2.0, 5.0)),
)
GAP = [(-3, 0, 1.5), (0, 0, 1.5), (3, 1, 1.5)]
PATHS = [
    quad_gym.Trajectory.through(GAP, max_speed=1.5),
    quad_gym.Trajectory.through(GAP, max_speed=1.5, yaw="along", minimize="jerk"),
    quad_gym.Trajectory.through([*GAP, (0, 3, 2)], closed=True, look_at=(0.2, 5.0)),
]
FEATURES = {
    "features_yaw": Uniform(-np.pi, np.pi),
    "features_shift_I": (Uniform(-1.0, 1.0), Uniform(0.0, 2.0), Uniform(-0.2, 0.2)),
    "feature_offsets_I": (Uniform(-0.3, 0.3), None, Uniform(-0.4, 0.4)),
}
DRAWS = {
    "mass": Uniform(0.8, 1.2, relative=True),
    "inertia": LogUniform(0.7, 1.4, relative=True),
    "center_of_mass_B": Uniform(-0.005, 0.005),
    "rotor_efficiency": Uniform(0.9, 1.0),
    "motor_time_constant": LogUniform(0.5, 2.0, relative=True),
    "wind_speed": Uniform(0.0, 5.0),
    "wind_direction": Uniform(-np.pi, np.pi),
    "gust_wind_speed": Uniform(0.0, 5.0),
    "battery_charge": Uniform(0.3, 1.0),
    "accel_noise_density": LogUniform(0.5, 5.0, relative=True),
    "position_sigma_I": LogUniform(0.5, 5.0, relative=True),
    "primary_antenna_B": Normal(0.0, 0.005, offset=True),
    "camera_rotation": Normal(0.0, 0.005),
    "start_velocity_I": Normal(0.0, 0.5),
}
DRAWN = {"world": "fresh_breeze", "privileged": True, "randomization": DRAWS}
FAULTY = {
    "sensors": "rtk",
    "faults": tuple(type(fault)(rate=4.0, duration=(0.02, 0.2)) for fault in faults_of("all", RTK)),
    "world": "breeze",
    "randomization": {"rotor_efficiency": Uniform(0.9, 1.0)},
}

CONFIGURATIONS = {
    **{task: (task, {}) for task in quad_gym.IDS.values()},
    "noisy": (
        "random_trajectory",
        {"observation": "noisy", "action": "attitude", "privileged": True, "include_std": True},
    ),
    "measurements": (
        "hover",
        {
            "observation": "measurements",
            "sensors": STANDARD.with_rates(gnss=10.0, camera=25.0),
            "action": "motor",
        },
    ),
    "truth": (
        "circle",
        {"observation": "truth", "action": "velocity", "randomize_reference": True},
    ),
    "truth with a filter": ("random_trajectory", {"observation": "truth", "run_filter": True}),
    "absolute": ("circle", {"include_std": True, "layout": "absolute", "action": "wrench"}),
    "fast control": ("circle", {"camera": False, "control_rate": 100}),
    "averages": ("circle", {"sensors": AVERAGES.with_rates(gnss=20.0)}),
    "ground": ("circle", {"world": GROUND, "start": "mixed", "action": "motor"}),
    "action delay": ("hover", {"action_delay": 1.75}),
    "drawn action delay": ("hover", {"randomization": {"action_delay": Uniform(0.0, 3.0)}}),
    "warm": ("circle", {"sensors": "rtk", "filter_start": "warm", "start": "moving"}),
    "late": ("hover", {"sensors": LATE, "innovations": True, "truncate_when_diverged": True}),
    "aided": ("circle", {"sensors": AIDED, "innovations": True, "observation": "measurements"}),
    "ekf": ("hover", {"sensors": "crazyflie", "vehicle": "crazyflie", "estimator": "ekf"}),
    "drawn": ("hover", DRAWN),
    "drawn and known": ("waypoints", {**DRAWN, "randomization": Randomization(DRAWS, known=True)}),
    "faults": ("hover", {**FAULTY, "innovations": True}),
    "faults on a course": ("waypoints", FAULTY),
    "weak rotors": ("hover", {"faults": RotorLoss(rate=4.0, duration=0.2, share=(0.2, 0.6))}),
    "obstacles": ("hover", {"world": OBSTACLES, "task": Near()}),
    "paths among obstacles": (
        "trajectory",
        {
            "trajectory": PATHS,
            "randomize_reference": True,
            "world": OBSTACLES.replace(geofence=None),
            "sensors": "indoor",
        },
    ),
    "drawn features": (
        "hover",
        {"sensors": "indoor", "randomization": FEATURES, "privileged": True, "task": Near()},
    ),
    "own estimator": ("circle", {"estimator": Simple(), "sensors": LATE, "action": "attitude"}),
    "own estimator with faults": (
        "waypoints",
        FAULTY | {"estimator": Certain, "include_std": True, "control_rate": 100, "task": Near()},
    ),
    "own task": ("hover", {"task": Chase(), "innovations": True}),
}
