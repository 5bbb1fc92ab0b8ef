"""State estimation for one vehicle: Kalman filters, replay of logs, and Wahba's problem."""

from typing import TYPE_CHECKING, Any

from quad_gym.estimation.filters import (
    LONGEST_STEP,
    ExtendedKalmanFilter,
    Innovations,
    UnscentedKalmanFilter,
)
from quad_gym.estimation.starts import FirstFix, solve_wahba
from quad_gym.records.inputs import FARTHEST_FIX

if TYPE_CHECKING:  # _LAZY imports them on first use
    from quad_gym.logs.calibrating.calibration import Calibration, calibrate
    from quad_gym.logs.calibrating.search import Calibrated
    from quad_gym.logs.calibrating.vehicle_fit import FittedNumber, FittedVehicle, fit_vehicle
    from quad_gym.logs.formats import LOG_COLUMNS, Log, LogColumn, Reading, Stream, read_log
    from quad_gym.logs.replaying.replay import replay
    from quad_gym.logs.replaying.results import InnovationSeries, Replay, Smoothed
    from quad_gym.logs.smoothing import smooth


_LAZY = {  # of the wing of logs, which imports this package
    "Calibrated": "quad_gym.logs.calibrating.search",
    "Calibration": "quad_gym.logs.calibrating.calibration",
    "FittedNumber": "quad_gym.logs.calibrating.vehicle_fit",
    "FittedVehicle": "quad_gym.logs.calibrating.vehicle_fit",
    "LOG_COLUMNS": "quad_gym.logs.formats",
    "Log": "quad_gym.logs.formats",
    "LogColumn": "quad_gym.logs.formats",
    "InnovationSeries": "quad_gym.logs.replaying.results",
    "Reading": "quad_gym.logs.formats",
    "Replay": "quad_gym.logs.replaying.results",
    "Smoothed": "quad_gym.logs.replaying.results",
    "Stream": "quad_gym.logs.formats",
    "calibrate": "quad_gym.logs.calibrating.calibration",
    "fit_vehicle": "quad_gym.logs.calibrating.vehicle_fit",
    "read_log": "quad_gym.logs.formats",
    "replay": "quad_gym.logs.replaying.replay",
    "smooth": "quad_gym.logs.smoothing",
}

__all__ = [
    "FARTHEST_FIX",
    "LOG_COLUMNS",
    "LONGEST_STEP",
    "Calibrated",
    "Calibration",
    "ExtendedKalmanFilter",
    "FirstFix",
    "FittedNumber",
    "FittedVehicle",
    "InnovationSeries",
    "Innovations",
    "Log",
    "LogColumn",
    "Reading",
    "Replay",
    "Smoothed",
    "Stream",
    "UnscentedKalmanFilter",
    "calibrate",
    "fit_vehicle",
    "read_log",
    "replay",
    "smooth",
    "solve_wahba",
]


def __getattr__(name: str) -> Any:
    """Import names of the wing of logs on first use."""
    if name in _LAZY:
        import importlib

        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'quad_gym.estimation' has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, those that are imported on first use among them."""
    return sorted([*__all__, "__doc__", "__file__", "__name__", "__path__"])
