"""State estimation for one vehicle: Kalman filters, replay of logs, and Wahba's problem."""

from quad_gym.estimation.calibrating.calibration import Calibration, calibrate
from quad_gym.estimation.calibrating.search import Calibrated
from quad_gym.estimation.calibrating.vehicle_fit import FittedNumber, FittedVehicle, fit_vehicle
from quad_gym.estimation.filtering.estimate import Innovations
from quad_gym.estimation.filtering.filters import (
    LONGEST_STEP,
    ExtendedKalmanFilter,
    UnscentedKalmanFilter,
)
from quad_gym.estimation.filtering.first_fix import FirstFix
from quad_gym.estimation.filtering.starts import solve_wahba
from quad_gym.estimation.logs import LOG_COLUMNS, Log, LogColumn, Reading, Stream, read_log
from quad_gym.estimation.replaying.replay import replay
from quad_gym.estimation.replaying.results import Measured, Replay, Smoothed
from quad_gym.estimation.smoothing import smooth
from quad_gym.records.inputs import FARTHEST_FIX

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
    "Innovations",
    "Log",
    "LogColumn",
    "Measured",
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
