"""Gymnasium environments for quadrotor control on estimated state.

Importing the package registers its environments with Gymnasium. The kernels are imported, and
compiled or loaded from their cache, when the first environment is made.
"""

from typing import TYPE_CHECKING, Any

from quad_gym import faults
from quad_gym.envs import (
    IDS,
    make_sb3_vec_env,
    make_torch_vec_env,
    register_all,
    register_task,
)
from quad_gym.envs.config import EnvKeywords
from quad_gym.params import sensor_table
from quad_gym.params.filter import FilterParams
from quad_gym.params.imu import ImuParams
from quad_gym.params.randomization import LogUniform, Normal, Randomization, Uniform
from quad_gym.params.sensor_table import *  # noqa: F403
from quad_gym.params.suites import (
    InitialPoseParams,
    LogDelays,
    NoisyObservationParams,
    SensorSuite,
    sensor_suite,
)
from quad_gym.params.task import RewardParams, TaskParams
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.vehicle import ActionParams, PDGains, VehicleParams, pd_gains, vehicle_params
from quad_gym.params.world import (
    BatteryParams,
    Cylinder,
    GroundParams,
    Wall,
    WorldParams,
    world_params,
)
from quad_gym.records import Ending

if TYPE_CHECKING:  # _LAZY imports them on first use
    from quad_gym.batch.flight_batch import FlightBatch
    from quad_gym.batch.own_estimator import Estimator, Measurements
    from quad_gym.envs.single import QuadEnv
    from quad_gym.envs.spaces import observation_layout
    from quad_gym.envs.vector import QuadVectorEnv
    from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
    from quad_gym.flights import Flight, FlightRecorder
    from quad_gym.tasks import ObservationSpec, Task, TaskError, rewards
    from quad_gym.tasks.view import View

__version__ = "1.0.0"

register_all()


def __getattr__(name: str) -> Any:
    """Import names that need the kernels on first use, so that the package imports fast."""
    if name in _LAZY:
        import importlib

        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'quad_gym' has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, those that are imported on first use among them."""
    return sorted([*__all__, "__doc__", "__file__", "__name__", "__path__"])


_LAZY = {
    "Estimator": "quad_gym.batch.own_estimator",
    "ExtendedKalmanFilter": "quad_gym.estimation",
    "Flight": "quad_gym.flights",
    "FlightBatch": "quad_gym.batch.flight_batch",
    "FlightRecorder": "quad_gym.flights",
    "Measurements": "quad_gym.batch.own_estimator",
    "ObservationSpec": "quad_gym.tasks",
    "QuadEnv": "quad_gym.envs.single",
    "QuadVectorEnv": "quad_gym.envs.vector",
    "Task": "quad_gym.tasks",
    "TaskError": "quad_gym.tasks",
    "UnscentedKalmanFilter": "quad_gym.estimation",
    "View": "quad_gym.tasks.view",
    "observation_layout": "quad_gym.envs.spaces",
    "rewards": "quad_gym.tasks",
}

__all__ = [
    "IDS",
    "ActionParams",
    "BatteryParams",
    "Cylinder",
    "Ending",
    "EnvKeywords",
    "Estimator",
    "ExtendedKalmanFilter",
    "FilterParams",
    "Flight",
    "FlightBatch",
    "FlightRecorder",
    "GroundParams",
    "ImuParams",
    "InitialPoseParams",
    "LogDelays",
    "LogUniform",
    "Measurements",
    "NoisyObservationParams",
    "Normal",
    "ObservationSpec",
    "PDGains",
    "QuadEnv",
    "QuadVectorEnv",
    "Randomization",
    "RewardParams",
    "SensorSuite",
    "Task",
    "TaskError",
    "TaskParams",
    "Trajectory",
    "Uniform",
    "UnscentedKalmanFilter",
    "VehicleParams",
    "View",
    "Wall",
    "WorldParams",
    "__version__",
    "faults",
    "make_sb3_vec_env",
    "make_torch_vec_env",
    "observation_layout",
    "pd_gains",
    "register_task",
    "rewards",
    "sensor_suite",
    "vehicle_params",
    "world_params",
    *sensor_table.__all__,
]
