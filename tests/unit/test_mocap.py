"""The suite `mocap` is consistent on a Crazyflie."""

import gymnasium
import numpy as np

from baselines import PDPolicy
from quad_gym.analysis.consistency import flight_errors
from quad_gym.analysis.metrics import nees


def test_filter_of_motion_capture_is_consistent():
    """Mean NEES of 192 flights, 15 expected; false alarms in 1 of 10,000 runs."""
    envs = gymnasium.make_vec(
        "QuadGym/Circle-v0", 192, sensors="mocap", vehicle="crazyflie", start="hover"
    )
    observations, _ = envs.reset(seed=0)
    policy, batch = PDPolicy(envs, gains="tuned"), envs.unwrapped.flights.batch
    for _ in range(150):
        observations, *_ = envs.step(policy.predict(observations)[0])
    mean = nees(flight_errors(batch), batch.covariance()).mean()
    assert abs(mean - 15.0) < 3.9 * np.sqrt(2.0 * 15.0 / 192)
