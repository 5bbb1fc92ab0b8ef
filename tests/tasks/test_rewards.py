"""Terms of rewards, against their formulas and the built-in rewards."""

import pickle

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym import rewards
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.tasks.rewards import BLOCKS, Constant, Term
from tests.builders import flown


@pytest.mark.parametrize("per", ["step", "second"])
@pytest.mark.parametrize("task", [i for i, task in quad_gym.IDS.items() if task in TASK_DEFAULTS])
def test_sums_of_terms_equal_the_builtin_rewards(task, per):
    piece = rewards.RACING if "Waypoints" in task else rewards.TRACKING
    made = {"num_envs": 6, "reward_per": per, "randomize_reference": True, "max_episode_steps": 120}
    plain = gymnasium.make_vec(task, **made)
    ours = gymnasium.make_vec(task, task=quad_gym.Task.of(reward=piece), **made)
    observation, _ = plain.reset(seed=3)
    ours.reset(seed=3)
    policy, rng, gates = PDPolicy(plain), np.random.default_rng(5), 0
    for _ in range(150):
        action = policy.predict(observation)[0] + rng.normal(0.0, 0.2, (6, 4))
        observation, expected, *_, info = plain.step(action)
        _, got, *_ = ours.step(action)
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-11)
        gates = max(gates, info["gates_passed"].max())
    assert gates > 0 or "Waypoints" not in task


def view_after(steps=10, **keywords):
    made = {"task": quad_gym.Task(), "autoreset_mode": "Disabled", **keywords}
    return flown("hover", count=4, steps=steps, seed=2, **made).flights.batch.view


def test_sums_differences_and_multiples_are_terms():
    view = view_after()
    a, b = rewards.Tracking(1.0), rewards.ActionRate()
    x, y = a(view), b(view)
    for piece, expected in (
        (a + b, x + y),
        (a - 2.0 * b, x - 2.0 * y),
        (-(a - b) * 3.0, -3.0 * (x - y)),
        (1.0 - a, 1.0 - x),
        (a + 2, x + 2.0),
        (a + (lambda view: view.time), x + view.time),
        (0.5 * (a + 0.5 * b), 0.5 * x + 0.25 * y),
    ):
        assert isinstance(piece, Term)
        np.testing.assert_allclose(piece(view), expected, rtol=1e-14)
    assert pickle.loads(pickle.dumps(rewards.TRACKING)) == rewards.TRACKING
    with pytest.raises(ValueError, match="piece must be a number"):
        a + "b"
    with pytest.raises(ValueError, match="weight must be finite"):
        a * np.nan


def test_each_term_equals_its_formula():
    view = view_after()
    change = view.action - view.last_action
    for piece, expected in (
        (rewards.Tracking(3.0), np.exp(-3.0 * view.position_error)),
        (rewards.Heading(), np.einsum("ni,ni->n", view.R_BI[:, 0], view.reference_heading)),
        (rewards.ActionRate(), np.linalg.norm(change, axis=1) ** 2),
        (rewards.BodyRates(), np.linalg.norm(view.body_rates, axis=1) ** 2),
        (rewards.GatePassed(), np.zeros(4)),
        (rewards.Crash(), np.zeros(4)),
        (rewards.Visibility(), view.truth.features_in_view.sum(axis=1)),
        (Constant(2.0), np.full(4, 2.0)),
    ):
        np.testing.assert_allclose(piece(view), expected, rtol=1e-12)


@pytest.mark.parametrize("block", BLOCKS)
def test_uncertainty_is_the_trace_or_log_determinant(block):
    view, k = view_after(), 3 * BLOCKS.index(block)
    P = view.estimate.covariance[:, k : k + 3, k : k + 3]
    np.testing.assert_allclose(
        rewards.Uncertainty(block)(view), np.trace(P, axis1=1, axis2=2), rtol=1e-9
    )
    values = np.linalg.eigvalsh(P)
    np.testing.assert_allclose(
        rewards.Uncertainty(block, "log_det")(view), np.log(values).sum(axis=1), rtol=1e-6
    )


def test_uncertainty_of_unknown_blocks_is_refused():
    with pytest.raises(ValueError, match="of must be one of"):
        rewards.Uncertainty("height")
    with pytest.raises(ValueError, match="measure must be one of"):
        rewards.Uncertainty(measure="det")


def test_uncertainty_on_the_truth_uses_a_filter_that_changes_nothing_else():
    certain = quad_gym.Task.of(reward=1.0 * rewards.Uncertainty("position"))
    runs = {}
    for name, keywords in {
        "truth alone": {"observation": "truth"},
        "truth": {"observation": "truth", "run_filter": True, "task": certain},
        "estimate": {"observation": "estimate", "task": certain},
    }.items():
        env = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=3, threads=1, **keywords)
        seen = [env.reset(seed=5)[0]]
        for _ in range(5):
            observation, reward, *_, info = env.step(np.zeros((3, 4), np.float32))
            seen.append(observation)
        runs[name] = np.array(seen), reward, set(info)
    np.testing.assert_array_equal(runs["truth"][0], runs["truth alone"][0])
    np.testing.assert_array_equal(runs["truth"][1], runs["estimate"][1])
    assert "innovations" not in runs["truth"][2]
    with pytest.raises(ValueError, match="run_filter must not be False"):
        gymnasium.make_vec("QuadGym/Circle-v0", num_envs=1, run_filter=False)
