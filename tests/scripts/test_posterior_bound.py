"""The posterior Cramer-Rao bound, against closed forms and a filter that attains it."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from quad_gym.analysis.consistency import endless
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.records import Source
from scripts.benchmarks.posterior_bound import Recursion, posterior_bound

F = np.array([[1.0, 0.1], [0.0, 1.0]])
Q = 0.04 * np.outer([0.005, 0.1], [0.005, 0.1])  # of rank one
H = np.array([[1.0, 0.0]])


def test_bound_of_a_linear_system_solves_the_riccati_equation():
    recursion = Recursion(np.tile(np.eye(2), (2, 1, 1)))
    for _ in range(400):
        recursion.predict(F[np.newaxis], Q[np.newaxis])
        recursion.measure(np.array([1]), H[np.newaxis], [0.25])
    prior = solve_discrete_are(F.T, H.T, Q, [[0.25]])
    gain = prior @ H.T / (H @ prior @ H.T + 0.25)
    np.testing.assert_allclose(recursion.P[1], prior - gain @ H @ prior, rtol=1e-8)
    assert (np.diag(recursion.P[0]) > 1.0).all()  # never measured


def test_delayed_and_equivalent_undelayed_measurements_give_equal_bounds():
    """With x' = F x, a measurement H x of three steps ago is one of H F^-3 x now."""
    late, punctual = (Recursion(np.eye(2)[np.newaxis]) for _ in range(2))
    rows = np.array([0])
    for _ in range(50):
        for recursion in (late, punctual):
            recursion.predict(F[np.newaxis], 0.0 * Q[np.newaxis])
    late.measure(rows, H[np.newaxis], [0.25], delay=3)
    punctual.measure(rows, (H @ np.linalg.inv(F @ F @ F))[np.newaxis], [0.25])
    np.testing.assert_allclose(late.P, punctual.P, rtol=1e-9)


@pytest.mark.parametrize("sensors", ["rtk", "consumer", "indoor", "crazyflie", "uwb"])
def test_errors_of_the_built_in_filter_are_near_the_bound(sensors):
    batch = FlightBatch(
        24,
        sensors=sensors,
        task=endless(TASK_DEFAULTS["random_trajectory"]),
        gains="tuned",
        source=Source.TRUTH,
        run_filter=True,
    )
    keys = {"seeds": range(24), "duration": 2.0, "settle": 1.95}
    found = posterior_bound(batch, **keys)
    claimed = np.sqrt(np.einsum("nii->ni", batch.covariance()).mean(axis=0))
    for k, name in enumerate(("position", "velocity", "attitude")):
        assert 0.9 < found[name] / np.sqrt((claimed[3 * k : 3 * k + 3] ** 2).mean()) < 1.02
