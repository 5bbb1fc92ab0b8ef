"""Task variants in which arms of a study learn, recomputed from the flights."""

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines.compiled_ppo.imitation import columns_of, teacher_of
from baselines.policies import interface_of, load_policy
from baselines.recipes import Plan, recipe
from scripts.studies.arms import OUTAGE_DASH
from scripts.studies.rules import RULES
from tests.builders import part

ID = "QuadGym/LookAround-v0"


def make(name, count=6, env_id=ID, module="arm_tasks", **keywords):
    own = f"scripts.studies.{module}:{name}"
    env = gymnasium.make_vec(
        env_id, num_envs=count, autoreset_mode="Disabled", task=own, **keywords
    )
    observations, _ = env.reset(seed=3)
    return env, observations


def largest_sigma(env):
    L = env.unwrapped.flights.batch.record("L")
    return np.sqrt(np.diagonal(L @ L.transpose(0, 2, 1), axis1=1, axis2=2)[:, :3]).max(axis=1)


def test_log_sigma_is_logarithm_of_largest_position_sigma():
    env, observations = make("WithStd")
    for _ in range(30):
        expected = np.log10(largest_sigma(env) / 0.03)
        found = part(env, observations, "log_sigma")[:, 0]
        np.testing.assert_allclose(found, expected, atol=1e-5)
        observations, *_ = env.step(np.zeros((6, 4), np.float32))


@pytest.mark.parametrize("observation", ["truth", "noisy"])
def test_log_sigma_without_a_filter_is_the_lowest(observation):
    env, observations = make("WithStd", observation=observation)
    np.testing.assert_array_equal(part(env, observations, "log_sigma"), -1.0)


RACE_ID, DASH_ID = "QuadGym/StaleRace-v0", "QuadGym/OutageDash-v0"
STATE = ("position_error", "velocity_error", "up", "body_rates")


@pytest.mark.parametrize(
    ("name", "env_id", "every", "names"),
    [
        ("WithStdHistory", ID, 10, (*STATE[:3], "heading", "body_rates", "features_direction")),
        ("RaceWithHistory", RACE_ID, 5, STATE),
    ],
)
def test_history_has_past_observations_newest_first(name, env_id, every, names):
    env, observations = make(name, env_id=env_id)
    seen, width = [], 3 * len(names)
    np.testing.assert_array_equal(part(env, observations, "past"), 0.0)
    for step in range(1, 35):
        observations, *_ = env.step(np.full((6, 4), 0.01, np.float32))
        if step % every == 0:
            seen.insert(0, np.hstack([part(env, observations, name) for name in names]))
        past = part(env, observations, "past").reshape(6, 4, width)
        for k in range(4):
            expected = seen[k] if k < len(seen) else np.zeros((6, width))
            np.testing.assert_allclose(past[:, k], expected, atol=1e-5)


@pytest.mark.parametrize(("name", "told"), [("REPORTED_STD_X1_2", 0.5), ("REPORTED_STD_X4", 4.0)])
def test_reported_std_is_scaled(name, told):
    (plain, a), (misled, b) = make("WithStd"), make(name)
    change = part(misled, b, "log_sigma") - part(plain, a, "log_sigma")
    np.testing.assert_allclose(change, np.log10(told), atol=1e-5)


def test_residual_race_observes_true_state_plus_residual():
    env, b = make("ResidualRace", env_id="QuadGym/StaleRace-v0", observation="truth")
    batch = env.unwrapped.flights.batch
    for _ in range(30):
        b, *_ = env.step(np.zeros((6, 4), np.float32))
        residual = batch.view.state.residual
        R = Rotation.from_rotvec(residual[:, 6:9].copy()).as_matrix() @ batch.view.R_BI
        gap = batch.view.reference_position - batch.record("r") - residual[:, :3]
        expected = (R @ gap[:, :, np.newaxis])[:, :, 0]
        np.testing.assert_allclose(part(env, b, "position_error"), expected, atol=1e-4)
    assert np.abs(residual).max() > 1e-3


def next_width(env):
    walls = env.unwrapped.flights.batch.record("obstacle_center")[:, :4, 1]
    return np.stack([walls[:, k] - walls[:, k + 1] - 30.0 for k in (0, 2)], axis=1)


def test_uncertainty_is_two_sigma_over_the_room_in_the_gap():
    env, observations = make("WithUncertainty", env_id="QuadGym/OutageDash-v0")
    for _ in range(10):
        room = 0.5 * next_width(env) - 0.5
        expected = 0.5 * np.log2(2.0 * largest_sigma(env)[:, np.newaxis] / room)
        np.testing.assert_allclose(part(env, observations, "uncertainty"), expected, atol=1e-4)
        observations, *_ = env.step(np.zeros((6, 4), np.float32))
    env, observations = make("WithUncertainty", env_id="QuadGym/OutageDash-v0", observation="truth")
    np.testing.assert_array_equal(part(env, observations, "uncertainty"), -4.0)


def test_starts_are_before_the_first_wall_or_between_two():
    env, _ = make("ConstantCrashCost", 300, DASH_ID)
    x = env.unwrapped.flights.batch.record("r")[:, 0]
    found, count = np.unique(np.round(x, 6), return_counts=True)
    np.testing.assert_allclose(found, [*np.arange(-54.0, 43.0, 12.0), 60.0])
    assert count.min() > 10


def test_scaled_observations_are_divided_by_their_scales():
    plain = gymnasium.make_vec("QuadGym/OutageDash-v0", num_envs=6)
    seen = plain.reset(seed=3)[0]
    env, scaled = make("Scaled", env_id="QuadGym/OutageDash-v0")
    scales = {"position_error": 6.0, "velocity_error": 4.0, "body_rates": 2.0, "next_gap": 12.0}
    for _ in range(5):
        for name, scale in scales.items():
            expected = part(plain, seen, name) / scale
            np.testing.assert_allclose(part(env, scaled, f"{name}_scaled"), expected, atol=1e-6)
        for name in ("gap_width", "next_width"):
            expected = (part(plain, seen, name) - 4.5) / 1.5
            np.testing.assert_allclose(part(env, scaled, f"{name}_scaled"), expected, atol=1e-6)
        for name in ("up", "heading", "course_share"):
            np.testing.assert_allclose(part(env, scaled, name), part(plain, seen, name), atol=1e-6)
        action = np.full((6, 4), 0.2, np.float32)
        seen, scaled = plain.step(action)[0], env.step(action)[0]
    assert np.abs(part(plain, seen, "body_rates")).max() > 0.1


def test_control_rate_in_training_is_lower_than_in_evaluation():
    shipped = recipe("QuadGym/OutageDash-v0").replace(n_envs=2)
    plan = Plan(env_id="QuadGym/OutageDash-v0", recipe=shipped, episodes=2)
    learned, judged = plan.make_vector_flights(), plan.make_judge()
    assert learned.unwrapped.flights.control_rate == 4.0
    assert interface_of(judged)["control_rate"] == 10.0
    assert learned.observation_space == judged.observation_space


def test_rules_fly_the_plain_task_and_policies_the_scaled_one():
    for arm in OUTAGE_DASH:
        keywords = {"observation": "estimate", **arm.environment}
        env = gymnasium.make_vec("QuadGym/OutageDash-v0", num_envs=1, **keywords)
        plain = "gap_width" in interface_of(env)["observation"]
        is_rule = arm.policy is not None and not arm.learned
        assert plain == is_rule, arm.name
        if plain:
            RULES[arm.policy](env) if arm.policy in RULES else load_policy(arm.policy, env)


def test_time_since_fix_counts_from_the_last_measured_position():
    env, seen = make("WithTimeSinceFix", env_id=DASH_ID)
    view, expected = env.unwrapped.flights.batch.view, np.zeros(6)
    for _ in range(120):
        seen, *_ = env.step(np.zeros((6, 4), np.float32))
        fixed = np.isfinite(view.measured.gnss_position[:, 0])
        expected = np.where(fixed, 0.0, expected + 0.1)
        found = part(env, seen, "since_fix")[:, 0]
        np.testing.assert_allclose(found, np.log2(1.0 + expected), atol=1e-5)
    assert expected.max() > 2.0


def flown_alone(rule, parts):
    """Position error that a rule pursues for an observation with these parts."""
    env = gymnasium.make_vec(DASH_ID, num_envs=1, include_std=True)
    rows = np.zeros((1, env.single_observation_space.shape[0]))
    ahead = {"up": (0.0, 0.0, 1.0), "heading": (1.0, 0.0, 0.0)}
    for field in env.unwrapped.flights.table:
        rows[:, field.slice] = {**ahead, **parts}.get(field.name, 0.0)
    return RULES[rule](env)._read(rows).position_error[0]


def test_rule_backs_off_from_a_wall_near_the_gap_only_if_certain():
    near = {"position_error": (2.0, 3.0, 0.0), "gap_width": 4.0}
    np.testing.assert_allclose(flown_alone("backs_off", near), [-1.0, 3.0, 0.0])
    inside = near | {"position_error": (2.0, 1.0, 0.0)}
    np.testing.assert_allclose(flown_alone("backs_off", inside), [2.0, 1.0, 0.0])
    uncertain = near | {"position_sigma": 1.0}
    np.testing.assert_allclose(flown_alone("backs_off", uncertain), [-4.0, 3.0, 0.0])


@pytest.mark.parametrize(("share", "pursued"), [(50, 0.75), (25, 0.375), (0, 0.0)])
def test_rule_slows_down_only_if_uncertain(share, pursued):
    ahead = {"position_error": (6.0, 0.0, 0.0), "gap_width": 4.0}
    np.testing.assert_allclose(flown_alone(f"slows_to_{share}", ahead), [6.0, 0.0, 0.0])
    uncertain = ahead | {"position_sigma": 0.8}  # the room is 1.5 m
    np.testing.assert_allclose(flown_alone(f"slows_to_{share}", uncertain), [pursued, 0.0, 0.0])


def test_imitation_shows_the_rule_its_observation_and_the_policy_its_own():
    arm = next(arm for arm in OUTAGE_DASH if arm.name == "imitation")
    env, seen = make("WithUncertaintyForRule", env_id=DASH_ID, include_std=True)
    plain = gymnasium.make_vec(DASH_ID, num_envs=6, include_std=True)
    scaled, own = make("WithUncertainty", env_id=DASH_ID)
    rule, same_rule = RULES["backs_off"](plain), teacher_of(arm.parameters["teacher"], env)
    columns = columns_of(interface_of(scaled)["observation"], env)
    shown = plain.reset(seed=3)[0]
    for _ in range(5):
        action = rule.predict(shown)[0]
        np.testing.assert_array_equal(same_rule.predict(seen)[0], action)
        np.testing.assert_array_equal(seen[:, columns], own)
        shown, seen, own = (each.step(action)[0] for each in (plain, env, scaled))


def test_critic_of_look_around_observes_the_truth():
    plain, _ = make("WithStdCertaintyReward")
    shipped = gymnasium.make_vec(ID, num_envs=6, autoreset_mode="Disabled", privileged=True)
    shipped.reset(seed=3)
    env, _ = make("WithStdCertaintyRewardForCritic", module="arm_critics")
    for _ in range(20):
        actions = np.full((6, 4), 0.1, np.float32)
        observations, reward, *_ = env.step(actions)
        shown, same, *_ = plain.step(actions)
        truth = shipped.step(actions)[0]["privileged"]
        np.testing.assert_array_equal(observations[:, :-15], shown)
        np.testing.assert_allclose(observations[:, -15:], truth[:, :15], atol=1e-5)
        np.testing.assert_array_equal(reward, same)
    seen = part(env, observations, "position_error")
    assert abs(part(env, observations, "actual_position_error") - seen).max() > 0.01


def test_certainty_reward_is_added():
    (plain, _), (paid, _) = make("WithStd"), make("WithStdCertaintyReward")
    for _ in range(40):
        actions = np.zeros((6, 4), np.float32)
        actions[:, 3] = 1.0  # turn, so that features enter and leave the view
        reward, with_pay = plain.step(actions)[1], paid.step(actions)[1]
        expected = reward + np.maximum(0.3 - 0.6 * largest_sigma(paid), 0.0)
        np.testing.assert_allclose(with_pay, expected, atol=1e-12)
