"""The PD policy on observations acts as the compiled controller does on the estimate."""

import warnings

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from baselines.policies import load_policy
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.evaluation import roll_out
from quad_gym.records import Control
from tests.contract.comparing import ACTIONS

TRACKING = ("QuadGym/Hover-v0", "QuadGym/Circle-v0", "QuadGym/Lemniscate-v0")
TRACKING += ("QuadGym/RandomTrajectory-v0",)


def keywords_for(action, **keywords):
    """Return the keywords that an environment needs for the controller with an action."""
    if action == "velocity":
        keywords["layout"] = "absolute"
    if action in ("motor", "wrench"):
        keywords["control_rate"] = 200
    return keywords


def errors_of_the_compiled_controller(seeds, sensors):
    """Return true position errors (ticks, n) on the report's circle, flown by the kernel."""
    batch = FlightBatch(len(seeds), control=Control.PD, gains="lab", sensors=sensors)
    batch.reset(seeds=seeds)
    errors = []
    for _ in range(2000):
        batch.step()
        errors.append(batch.result("position_error"))
    return np.array(errors)


@pytest.fixture(scope="module")
def direct():
    suite = quad_gym.sensor_suite("lab")
    estimator = suite.estimator.replace(bearing_noise_at="predicted")
    return errors_of_the_compiled_controller(range(60), suite.replace(estimator=estimator))


@pytest.mark.parametrize(
    ("action", "layout"),
    [
        ("motor", "relative"),
        ("wrench", "absolute"),
        *(
            pytest.param(*both, marks=pytest.mark.slow)
            for both in (("motor", "absolute"), ("wrench", "relative"))
        ),
    ],
)
def test_policy_at_every_tick_equals_the_compiled_controller(action, layout, direct):
    given = {"action": action, "layout": layout, "control_rate": 200, "start": "ground"}
    env = QuadVectorEnv(60, "circle", autoreset_mode="Disabled", **given)
    policy = PDPolicy(env, gains="lab")
    observation, _ = env.reset(seed=0)
    errors = []
    for _ in range(2000):
        observation, *_, info = env.step(policy.predict(observation)[0])
        errors.append(info["position_error"])
    errors = np.array(errors)
    spread = direct.mean(axis=0).std()
    assert abs(errors.mean() - direct.mean()) < spread
    late, late_direct = errors[1000:], direct[1000:]
    assert late.mean() == pytest.approx(late_direct.mean(), rel=0.05)
    # the same seeds give the same noise, so each flight's errors are nearly the same
    assert np.corrcoef(late.mean(axis=0), late_direct.mean(axis=0))[0, 1] > 0.9


EPISODES = [64, pytest.param(1000, marks=pytest.mark.slow)]


@pytest.mark.parametrize("count", EPISODES)
@pytest.mark.parametrize("gains", ["lab", "tuned"])
@pytest.mark.parametrize("env_id", TRACKING)
def test_policy_flies_every_tracking_task_on_the_estimate(env_id, gains, count):
    env = gymnasium.make_vec(env_id, num_envs=count)
    episodes = roll_out(PDPolicy(env, gains), env, seed=0)
    assert not episodes.crashed.any()
    assert (episodes.ending == "time_limit").all()
    assert episodes.late_error.mean() < 0.15


@pytest.mark.parametrize("action", ACTIONS)
def test_policy_flies_with_every_action(action):
    keywords = keywords_for(action, duration=10.0)
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=50, **keywords)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        policy = PDPolicy(env)
    episodes = roll_out(policy, env, seed=3)
    assert not episodes.crashed.any()
    assert episodes.late_error.mean() < 0.1


@pytest.mark.parametrize("observation", ["truth", "noisy"])
@pytest.mark.parametrize("layout", ["relative", "absolute"])
def test_policy_flies_on_truth_and_noisy_observations(observation, layout):
    env = gymnasium.make_vec(
        "QuadGym/RandomTrajectory-v0", num_envs=40, observation=observation, layout=layout
    )
    episodes = roll_out(PDPolicy(env, gains="lab"), env, seed=3)
    assert not episodes.crashed.any()
    assert episodes.late_error.mean() < 0.1


@pytest.mark.parametrize("count", EPISODES)
@pytest.mark.parametrize("gains", ["lab", "tuned"])
def test_policy_passes_all_gates(gains, count):
    env = gymnasium.make_vec("QuadGym/Waypoints-v0", num_envs=count)
    episodes = roll_out(PDPolicy(env, gains), env, seed=0)
    assert not episodes.crashed.any()
    assert (episodes.gates_passed == 5).all()


@pytest.mark.parametrize("privileged", [False, True])
@pytest.mark.parametrize("action", ACTIONS)
def test_single_and_batched_predictions_agree(action, privileged):
    env = QuadVectorEnv(7, "lemniscate", privileged=privileged, **keywords_for(action))
    single = QuadEnv("lemniscate", privileged=privileged, **keywords_for(action))
    policy, alone = PDPolicy(env, gains="lab"), PDPolicy(single, gains="lab")
    observation, _ = env.reset(seed=1)
    for _ in range(5):
        together, state = policy.predict(observation)
        assert state is None
        assert together.shape == (7, 4)
        assert together.dtype == np.float32
        assert (abs(together) <= 1.0).all()
        for i in range(7):
            if privileged:
                own = {name: values[i] for name, values in observation.items()}
            else:
                own = observation[i]
            action_of_one, _ = alone.predict(own, deterministic=True)
            np.testing.assert_allclose(action_of_one, together[i], rtol=1e-5, atol=1e-6)
            assert action_of_one.shape == (4,)
        observation, *_ = env.step(together)


@pytest.mark.parametrize("policy", ["pd", "pretrained"])
def test_policy_acts_the_same_in_every_interface(policy):
    env_id, actions = "QuadGym/Circle-v0", []
    single = gymnasium.make(env_id)
    actions.append(load_policy(policy, single).predict(single.reset(seed=5)[0])[0])
    vector = gymnasium.make_vec(env_id, num_envs=2)
    actions.append(load_policy(policy, vector).predict(vector.reset(seed=5)[0])[0][0])
    sb3 = quad_gym.make_sb3_vec_env(env_id, 2, seed=5)
    actions.append(load_policy(policy, sb3).predict(sb3.reset())[0][0])
    np.testing.assert_allclose(actions, [actions[0]] * 3, atol=1e-6)


def test_policy_does_not_change_observation_and_has_no_memory():
    env = QuadEnv("circle")
    observation, _ = env.reset(seed=2)
    kept = observation.copy()
    policy = PDPolicy(env)
    first, _ = policy.predict(observation)
    policy.predict(observation + 1.0)
    np.testing.assert_array_equal(observation, kept)
    np.testing.assert_array_equal(policy.predict(observation)[0], first)


def test_policy_for_another_environment_is_refused():
    with pytest.raises(ValueError, match="env must be a QuadGym environment, got"):
        load_policy("pretrained", gymnasium.make("CartPole-v1"))


@pytest.mark.parametrize("error", [0.0, -1.0, np.nan, "1"])
def test_limit_of_position_errors_that_is_not_positive_is_refused(error):
    with pytest.raises(ValueError, match="max_position_error must be"):
        PDPolicy(QuadEnv("hover"), max_position_error=error)


@pytest.mark.parametrize("action", ["motor", "wrench", "ctbr", "attitude"])
def test_low_control_rate_without_inner_loop_gives_warning(action):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        PDPolicy(QuadEnv("hover", action=action, control_rate=50))
    assert ["Hz" in str(w.message) for w in caught] == [True] * (action in ("motor", "wrench"))
