"""Gymnasium environments for quadrotor control on estimated state."""

from quad_gym.params import (
    ActionParams,
    CameraParams,
    Clocks,
    FilterParams,
    GnssParams,
    ImuParams,
    NoisyObservationParams,
    PDGains,
    SensorSuite,
    TaskParams,
    VehicleParams,
    pd_gains,
    sensor_suite,
    vehicle_params,
)

__version__ = "0.1.0"

__all__ = [
    "ActionParams",
    "CameraParams",
    "Clocks",
    "FilterParams",
    "GnssParams",
    "ImuParams",
    "NoisyObservationParams",
    "PDGains",
    "SensorSuite",
    "TaskParams",
    "VehicleParams",
    "__version__",
    "pd_gains",
    "sensor_suite",
    "vehicle_params",
]
