"""State estimation for one vehicle: Wahba's problem, an unscented and an extended Kalman filter."""

from quad_gym.estimation.filters import (
    ExtendedKalmanFilter,
    UnscentedKalmanFilter,
)
from quad_gym.estimation.first_fix import FARTHEST_FIX
from quad_gym.estimation.wahba import solve_wahba

__all__ = ["FARTHEST_FIX", "ExtendedKalmanFilter", "UnscentedKalmanFilter", "solve_wahba"]
