"""The model of estimation errors, fitted to draws of a known model, and errors from flights."""

import gymnasium
import numpy as np
import pytest

from baselines import PDPolicy
from scripts.studies.residuals import SIZE, ResidualModel, fit, record


def known(rng):
    A = 0.9 * np.eye(SIZE) + 0.005 * rng.standard_normal((SIZE, SIZE))
    B = 0.01 * rng.standard_normal((SIZE, 4))
    return ResidualModel(A, B, np.diag(rng.uniform(0.01, 0.02, SIZE)))


def drawn(model, rng, steps=400, flights=100):
    velocities = rng.normal(0.0, 2.0, (steps, flights, 3))
    errors = np.zeros((steps, flights, SIZE))
    for t in range(steps - 1):
        noise = rng.standard_normal((flights, SIZE))
        errors[t + 1] = model.advance(errors[t], velocities[t], noise)
    return errors, velocities


def test_fit_recovers_the_model_that_generated_the_errors(tmp_path):
    rng = np.random.default_rng(0)
    model = known(rng)
    errors, velocities = drawn(model, rng)
    errors[200:, :10] = np.nan  # flights that are over
    found = fit(errors, velocities)
    np.testing.assert_allclose(found.A, model.A, atol=0.02)
    np.testing.assert_allclose(found.B, model.B, atol=0.001)
    np.testing.assert_allclose(found.L @ found.L.T, model.L @ model.L.T, atol=5e-6)
    found.save(tmp_path / "model.json")
    np.testing.assert_array_equal(ResidualModel.load(tmp_path / "model.json").A, found.A)


def test_growing_or_too_few_errors_are_refused():
    rng = np.random.default_rng(0)
    errors = 0.01 * rng.standard_normal((400, 20, SIZE)) + 1.01 ** np.arange(400)[:, None, None]
    with pytest.raises(ValueError, match="stationary"):
        fit(errors, np.zeros((400, 20, 3)))
    with pytest.raises(ValueError, match="at least 160 steps, got 8"):
        fit(np.zeros((3, 4, SIZE)), np.zeros((3, 4, 3)))


def test_record_returns_the_errors_of_the_estimate():
    env = gymnasium.make_vec("QuadGym/StaleRace-v0", num_envs=4, duration=0.4)
    errors, velocities = record(PDPolicy(env), env)
    assert errors.shape == (21, 4, SIZE)
    assert velocities.shape == (21, 4, 3)
    batch = env.unwrapped.flights.batch
    np.testing.assert_allclose(
        errors[-1, :, :3], batch.record("r_hat") - batch.record("r"), atol=1e-12
    )
    truth = gymnasium.make_vec(
        "QuadGym/StaleRace-v0", num_envs=4, duration=0.4, observation="truth"
    )
    np.testing.assert_allclose(record(PDPolicy(truth), truth)[0], 0.0, atol=1e-12)
