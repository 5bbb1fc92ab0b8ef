"""`OutageDash`: recomputed course, reward and observation, and results of policies."""

import itertools

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quad_gym
from baselines import PDPolicy
from baselines.policies import keywords_of_policy, load_policy
from quad_gym.evaluation import roll_out
from quad_gym.records import Ending
from quad_gym.tasks.outage_dash import OutageDash
from tests.builders import part

ID = "QuadGym/OutageDash-v0"
FAST = {"action": "ctbr", "control_rate": 50.0}


def make(count=20, **keywords):
    return gymnasium.make_vec(ID, num_envs=count, autoreset_mode="Disabled", **keywords)


def actions(rng, count):
    return np.clip(rng.normal(0.0, 0.1, (count, 4)), -1.0, 1.0).astype(np.float32)


def edges(batch):
    """Return x of the walls, and y of the northern and southern edges of gaps, (n, 10) each."""
    walls = batch.record("obstacle_center")[:, :20]
    assert batch.world.obstacles[0].size == (0.3, 30.0, 12.0)
    return walls[:, ::2, 0], walls[:, ::2, 1] - 15.0, walls[:, 1::2, 1] + 15.0


def test_invalid_worlds_and_weights_are_refused():
    cylinders = quad_gym.WorldParams(obstacles=(quad_gym.Cylinder(center_I=(0.0, 0.0, 1.0)),) * 2)
    for world in ("calm", cylinders):
        with pytest.raises(ValueError, match="world must have pairs of walls for OutageDash"):
            make(1, world=world)
    for name, bad in itertools.product(("progress_weight", "crash_cost"), (-1.0, np.inf, "much")):
        with pytest.raises(ValueError, match=f"{name} must be"):
            OutageDash(**{name: bad})


def test_task_that_replaces_the_observation_keeps_named_parts():
    def height(view):
        return {"height": view.observed.position[:, 2]}

    keeps = ("up", "body_rates", "nothing of the kind")
    task = quad_gym.Task.of(replaces_observation=True, keeps=keeps, observe=height)
    env = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=3, task=task, privileged=True)
    plain = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=3, privileged=True)
    assert [f.name for f in env.unwrapped.flights.table][:3] == ["up", "body_rates", "height"]
    ours, shipped = env.reset(seed=0)[0], plain.reset(seed=0)[0]
    kept = shipped["policy"][:, [6, 7, 8, 12, 13, 14]]
    np.testing.assert_array_equal(ours["policy"][:, :-1], kept)
    np.testing.assert_array_equal(ours["privileged"], shipped["privileged"])
    wrong = quad_gym.Task.of(replaces_observation=True, observe=height)
    wrong.keeps = "up"
    with pytest.raises(ValueError, match="keeps of Task must contain names, got 'up'"):
        gymnasium.make("QuadGym/Circle-v0", task=wrong)


def test_gaps_have_the_specified_distribution():
    env = make(500, observation="truth")
    env.reset(seed=0)
    x, north, south = edges(env.unwrapped.flights.batch)
    np.testing.assert_array_equal(x, np.tile(48.0 - 12.0 * np.arange(10), (500, 1)))
    width, nominal = north - south, np.tile([0.75, 3.75], 5)
    assert (np.abs(north - nominal) <= 1.5 + 1e-9).all()
    assert (width >= 3.0 - 1e-9).all()
    assert (width <= 6.0 + 1e-9).all()
    assert abs(width.mean() - 4.5) < 0.05
    assert np.abs(np.corrcoef(north[:, 0], width[:, 0])[0, 1]) < 0.2


@pytest.mark.parametrize("keywords", [{}, FAST])
def test_reward_equals_documented_equation(keywords):
    env, rng = make(30, observation="truth", **keywords), np.random.default_rng(0)
    env.reset(seed=0)
    batch, crashes, over = env.unwrapped.flights.batch, 0, np.zeros(30, bool)
    h, down = (0.02, (0.3, 0.0, 0.0, 0.0)) if keywords else (0.1, (-0.5, 0.0, 0.3, 0.0))
    last, earned = np.zeros((30, 4)), np.zeros(30)
    for _ in range(150):
        action = np.clip(actions(rng, 30) - down, -1.0, 1.0)  # to the ground
        _, reward, terminated, truncated, _ = env.step(action)
        effort = ((action - last) ** 2).sum(axis=1)
        rates = (batch.record("w") ** 2).sum(axis=1)
        paid = 5.0 * h * np.minimum(-batch.record("v")[:, 0], 5.0)
        earned += paid
        expected = paid - 0.02 * effort - 0.002 * rates - (50.0 + earned) * terminated
        np.testing.assert_allclose(reward, expected, atol=1e-9)
        over = terminated | truncated
        crashes += over.sum()
        last, earned = np.where(over[:, np.newaxis], 0.0, action), np.where(over, 0.0, earned)
        if over.any():
            env.reset(options={"reset_mask": over})
    assert crashes > 5


@pytest.mark.parametrize("observation", ["estimate", "truth"])
def test_observation_is_computed_from_the_observed_state(observation):
    env = make(12, observation=observation, **FAST)
    policy = PDPolicy(env)
    observed, _ = env.reset(seed=5)
    batch, passed = env.unwrapped.flights.batch, set()
    for _ in range(300):
        observed, *_ = env.step(policy.predict(observed)[0])
        x, north, south = edges(batch)
        r, turn = batch.record("r_seen"), Rotation.from_matrix(batch.record("R_seen"))
        for i in range(12):
            behind = int((r[i, 0] < x[i] - 0.7).sum())
            middle = np.stack([x[i], 0.5 * (north[i] + south[i]), np.full(10, 4.0)], axis=1)
            passed.add(behind)
            for name, gap in (
                ("position_error", middle[behind] - r[i]),
                ("next_gap", middle[behind + 1] - middle[behind]),
            ):
                found = part(env, observed, name)[i]
                np.testing.assert_allclose(found, turn[i].apply(gap), atol=1e-5)
            widths = [part(env, observed, name)[i, 0] for name in ("gap_width", "next_width")]
            np.testing.assert_allclose(widths, (north - south)[i, behind : behind + 2], atol=1e-5)
        velocity = turn.apply(batch.record("v_seen"))
        np.testing.assert_allclose(part(env, observed, "velocity_error"), -velocity, atol=1e-5)
        course = np.tile(turn.apply([-1.0, 0.0, 0.0]), (1, 1))
        np.testing.assert_allclose(part(env, observed, "heading"), course, atol=1e-6)
    assert {0, 1, 2} <= passed


def test_bounds_of_the_observation_are_the_built_in_ones_and_fit_each_other():
    """A width is not negative, and no larger than the distance of the next two gaps may be."""
    ours, builtin = (
        {f.name: (f.low, f.high, f.unit) for f in env.unwrapped.flights.table}
        for env in (make(1), gymnasium.make_vec("QuadGym/Circle-v0", num_envs=1))
    )
    for name in ("velocity_error", "up", "heading", "body_rates"):
        assert ours[name] == builtin[name]
    least, most, _ = ours["next_gap"]
    assert least == -most
    assert ours["gap_width"] == ours["next_width"] == (0.0, most, "m")


def test_reward_after_the_finish_is_zero():
    env = make(2, observation="truth", **FAST)
    env.reset(seed=0, options={"position": (-65.0, 0.0, 4.0), "velocity": (-3.0, 0.0, 0.0)})
    observed, reward, *_ = env.step(np.zeros((2, 4), np.float32))
    np.testing.assert_array_equal(part(env, observed, "gap_width"), 6.0)
    np.testing.assert_array_equal(part(env, observed, "next_gap"), 0.0)
    assert (reward > 0.25).all()
    env.reset(seed=0, options={"position": (-71.97, 0.0, 4.0), "velocity": (-3.0, 0.0, 0.0)})
    _, reward, terminated, _, info = env.step(np.zeros((2, 4), np.float32))
    np.testing.assert_allclose(reward, 0.0, atol=1e-3)
    assert terminated.all()
    assert (info["ending"] == Ending.TASK).all()
    assert (info["gates_passed"] == 10).all()


@pytest.mark.parametrize("mode", ["Disabled", "SameStep", "NextStep"])
def test_gaps_passed_are_counted_by_the_true_position(mode):
    env = gymnasium.make_vec(ID, num_envs=8, observation="truth", autoreset_mode=mode, **FAST)
    policy = PDPolicy(env)
    observed, _ = env.reset(
        seed=1, options={"position": (-21.0, 1.5, 4.0), "velocity": (-4.0, 0.0, 0.0)}
    )
    batch, counted, ended = env.unwrapped.flights.batch, np.zeros(8, int), np.zeros(8, bool)
    for _ in range(160):
        observed, _, terminated, truncated, info = env.step(policy.predict(observed)[0])
        over = (terminated | truncated) & ~ended
        x = 48.0 - 12.0 * np.arange(10)
        behind = (batch.record("r")[:, :1] < x - 0.7).sum(axis=1)
        flying = ~(ended | over)
        counted[flying] = np.maximum(counted, behind)[flying]
        passed = info["gates_passed"]
        np.testing.assert_array_equal(passed[flying], counted[flying])
        if over.any() and mode == "SameStep":
            assert (passed[over] == 0).all()
            assert (info["final_info"]["gates_passed"][over] >= counted[over]).all()
        ended |= over
        if mode == "Disabled" and (terminated | truncated).any():
            observed, _ = env.reset(options={"reset_mask": terminated | truncated})
    assert counted.max() > 6


def test_outage_without_sensors_is_refused():
    assert make(1, observation="truth").unwrapped.flights.batch.faults == ()
    for true in (True, np.True_):
        watched = make(1, observation="truth", include_std=true)
        assert len(watched.unwrapped.flights.batch.faults) == 1
    with pytest.raises(ValueError, match=r"no effect on sensors .GnssOutage. where no filter runs"):
        make(1, observation="truth", faults=[quad_gym.faults.GnssOutage(start=1.0)])


def test_fixed_rules_crash_in_some_flights():
    """PD control crashes in 0 of 60 flights on the truth, 19 on the estimate, and 6 if it waits."""
    crashed, returns = {}, {}
    for name, shown in (
        ("pd", {"observation": "truth"}),
        ("pd", {}),
        ("pd:waiting", keywords_of_policy("pd:waiting", ID)),
    ):
        env = gymnasium.make_vec(ID, num_envs=60, **shown)
        flown = roll_out(load_policy(name, env), env, seed=0)
        case = f"{name} {shown.get('observation', '')}".strip()
        crashed[case], returns[case] = flown.crashed.mean(), flown.returns.mean()
    assert crashed["pd truth"] == 0.0
    assert crashed["pd"] > 0.2
    assert crashed["pd:waiting"] < crashed["pd"] - 0.1
    assert returns["pd"] < returns["pd:waiting"] - 60.0
    assert returns["pd:waiting"] < returns["pd truth"] - 20.0


def test_pretrained_policy_slows_down_with_uncertainty():
    env = gymnasium.make_vec(ID, num_envs=60, **keywords_of_policy("pretrained", ID))
    speed, sigma = [], []

    def watch(step, batch, flying):
        speed.append(-batch.view.velocity[flying, 0])
        sigma.append(batch.view.estimate.position_sigma[flying].max(axis=1))

    learned = roll_out(load_policy("pretrained", env), env, seed=0, watch=watch)
    ahead, doubt = np.concatenate(speed), np.concatenate(sigma)
    assert ahead[doubt > 1.5].mean() < 0.5 * ahead[doubt < 0.4].mean()
    assert learned.crashed.mean() < 0.6  # it was trained with a single outage per episode
    assert learned.returns.mean() > 250.0


def test_rules_without_their_observations_are_refused():
    with pytest.raises(ValueError, match='env must observe position_sigma for pace="waiting"'):
        load_policy("pd:waiting", make(1))
    circle = gymnasium.make("QuadGym/Circle-v0")
    with pytest.raises(ValueError, match='env must observe gap_width for pace="waiting"'):
        PDPolicy(circle, pace="waiting")
    with pytest.raises(ValueError, match="pace must be one of steady, waiting"):
        PDPolicy(circle, pace="hasty")
