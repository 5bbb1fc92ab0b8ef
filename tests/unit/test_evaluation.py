"""`roll_out` against a plain loop over single environments."""

import warnings

import gymnasium
import numpy as np
import pytest
from scipy.stats import binomtest

from baselines import PDPolicy
from baselines.keeping import score
from baselines.pd import pd_gains
from baselines.policies import keywords_of_policy, load_policy, pretrained_file
from quad_gym.analysis.plots import error_over_time_figure
from quad_gym.commands import tune
from quad_gym.commands.compare import MatrixCell
from quad_gym.commands.evaluate import evaluation_table, remark_on_crashes
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.evaluation import Episodes, evaluate, roll_out
from quad_gym.experiments import Flown, PathRecorder, fly
from quad_gym.records import Ending

LIMIT = 41


class Wobbly:
    """A policy with pseudorandom actions from the bits of observations; some flights crash."""

    def __init__(self, size):
        self.size = size

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        turns = np.sin(1e4 * np.asarray(observation, float)[..., :4])
        return (self.size * turns).astype(np.float32), state


class Wavering(Wobbly):
    """A policy with memory: pseudorandom actions depend on all observations of the episode."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        seen = np.asarray(observation, float)[..., :4]
        if state is None:
            state = np.zeros_like(seen)
        if episode_start is not None:
            state = np.where(np.reshape(episode_start, (-1, 1)), 0.0, state)
        return super().predict(state := 0.5 * state + seen, state)


def plain_loop(task, policy, seed, **keywords):
    """Fly one episode and return its results by name."""
    env = QuadEnv(task, **keywords)
    observation, _ = env.reset(seed=seed)
    rewards, errors, estimation, state = [], [], [], None
    while True:
        action, state = policy.predict(observation, state)
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        errors.append(info["position_error"])
        estimation.append(info["estimation_error"])
        if terminated or truncated:
            break
    crashed = terminated and info["ending"] != Ending.LAST_GATE
    measured = len(errors)
    if crashed:
        errors += [env.flights.task.out_of_bounds] * (LIMIT - len(errors))
    return {
        "returns": sum(rewards),
        "lengths": measured,
        "mean_error": np.mean(errors),
        "late_error": np.mean(errors[LIMIT // 2 :]) if len(errors) == LIMIT else np.nan,
        "estimation_error": np.mean(estimation),
        "crashed": crashed,
        "gates_passed": info["gates_passed"],
        "ending": str(Ending(info["ending"])),
    }


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("kind", [Wobbly, Wavering])
@pytest.mark.parametrize(("task", "size"), [("hover", 0.8), ("circle", 0.3), ("waypoints", 0.6)])
def test_roll_out_measures_same_values_as_plain_loop(task, size, kind, mode):
    keywords = {"max_episode_steps": LIMIT, "max_tilt": 0.9}
    env = QuadVectorEnv(24, task, autoreset_mode=mode, **keywords)
    policy = kind(size)
    episodes = roll_out(policy, env, seed=100)
    expected = [plain_loop(task, policy, 100 + i, **keywords) for i in range(24)]
    for name in episodes._fields:
        values, wanted = getattr(episodes, name), [row[name] for row in expected]
        if name in ("lengths", "crashed", "gates_passed", "ending"):
            assert values.tolist() == wanted, name
        else:
            np.testing.assert_allclose(values, wanted, rtol=1e-9, err_msg=name)
    if task == "hover":
        assert 0 < episodes.crashed.sum() < 24
    summary = episodes.summary()
    assert summary["episodes"] == 24
    assert summary["return"] == pytest.approx(episodes.returns.mean())
    assert summary["crash_rate"] == pytest.approx(episodes.crashed.sum() / 24)
    assert summary["late_error"] == pytest.approx(np.nanmean(episodes.late_error))


class Quitting:
    """PD control that turns the rotors off in some flights, once their error is small."""

    def __init__(self, env, share):
        self.pd, self.step = PDPolicy(env), 0
        self.quits = np.arange(env.num_envs) < share * env.num_envs

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        action, _ = self.pd.predict(observation)
        self.step += 1
        if self.step > 60:
            action[self.quits] = -1.0
        return action, None


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_crashes_on_purpose_raise_errors_and_percentiles(share):
    found = {}
    for name in ("pd", "quitting"):
        env = QuadVectorEnv(20, "hover", duration=4.0)
        policy = PDPolicy(env) if name == "pd" else Quitting(env, share)
        recorder = PathRecorder()
        episodes = roll_out(policy, env, seed=0, watch=recorder.add)
        found[name] = (episodes, recorder.recorded(), env.flights.task.out_of_bounds)
    (pd, flown, _), (quitting, dropped, bound) = found.values()
    few = int(20 * share)
    assert quitting.crashed.sum() == few
    assert not pd.crashed.any()
    for field in ("mean_error", "late_error"):
        assert (getattr(quitting, field)[:few] > getattr(pd, field)[:few]).all()
        assert quitting.summary()[field] > pd.summary()[field]
    low, middle, high = dropped["percentiles"]
    after = np.flatnonzero(dropped["not_crashed"] < 1.0)
    for worse, better in zip(dropped["percentiles"], flown["percentiles"], strict=True):
        assert (worse[after] >= better[after]).all()
    assert high[-1] == bound
    assert dropped["not_crashed"][-1] == pytest.approx(1.0 - share)
    assert (np.diff(dropped["not_crashed"]) <= 0.0).all()
    if share == 1.0:
        assert low[-1] == middle[-1] == bound
        assert len(dropped["time"]) < len(flown["time"])


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_tables_and_selections_rank_a_controller_that_crashes_below_one_that_does_not(share):
    env = QuadVectorEnv(10, "hover", duration=3.0)
    policies = {"pd": PDPolicy(env), "quitting": Quitting(env, share)}
    flown = {name: fly(policy, env, 0) for name, policy in policies.items()}
    kept, lost = (each.episodes.summary() for each in flown.values())
    shown = evaluation_table({(name, "truth"): each for name, each in flown.items()}, env)
    errors = [float(line.split("|")[1].split("[")[0]) for line in shown.splitlines()[-2:]]
    assert errors[1] > 2.0 * errors[0]
    assert f"{share:.1%}" in shown.splitlines()[-1]
    names = ("mean_error", "late_error", "crash_rate")
    cells = [MatrixCell(*(np.array([each[n]]) for n in names), None) for each in (kept, lost)]
    assert cells[1].in_mm()[0] > 2.0 * cells[0].in_mm()[0]
    assert cells[1].texts()[2] == f"{share:.1%}"
    judged = {"own_reward": 0.0, "gates_total": 0.0}  # of checkpoints
    assert score(lost | judged, 3.0) < score(kept | judged, 3.0)


@pytest.mark.parametrize(
    ("base", "total", "rate"),
    [("stale_race", 8, 50.0), ("waypoints", 5, 50.0), ("outage_dash", 10, 10.0)],
)
def test_table_of_a_course_has_gates_success_and_time(base, total, rate):
    """Three of four episodes pass all gates, in 1, 2 and 3 s; the last one crashes after half."""
    seconds, crashed = np.array([1.0, 2.0, 3.0, 1.5]), np.arange(4) == 3
    names = {**dict.fromkeys(Episodes._fields, np.zeros(4)), "crashed": crashed}
    names |= {
        "lengths": np.round(seconds * rate).astype(int),
        "gates_passed": np.where(crashed, total // 2, total),
        "mean_error": np.full(4, 300.0),
        "ending": np.array(["last_gate"] * 3 + ["collision"], object),
    }
    flown = Flown(Episodes(**names), {})
    env = QuadVectorEnv(1, base=base)
    results = {("pd", "estimate"): flown}
    last = evaluation_table(results, env).splitlines()[-1]
    low, high = (100.0 * limit for limit in binomtest(3, 4).proportion_ci(method="exact"))
    assert f"{total - (total - total // 2) / 4:.2f}  75.0% [{low:.1f}, {high:.1f}]" in last
    assert "2.00 s" in last
    assert "300" not in last
    assert not remark_on_crashes(results, env)


def test_tuning_counts_a_crash_as_ten_times_the_initial_error(monkeypatch):
    env = QuadVectorEnv(10, "hover", duration=3.0)
    search = tune.Search({"hover": env}, pd_gains("tuned"), False, 0)
    search.cost(np.zeros(4))
    monkeypatch.setattr(tune, "PDPolicy", lambda env, gains: Quitting(env, 0.5))
    assert search.cost(np.zeros(4)) > np.log(0.5 * 10.0)


def test_figure_of_errors_ends_at_the_bound_and_shows_crashes():
    pytest.importorskip("matplotlib")
    env = QuadVectorEnv(10, "hover", duration=3.0)
    cases = {"pd": PDPolicy(env), "quitting": Quitting(env, 1.0)}
    flown = {name: fly(policy, env, 0).recorded for name, policy in cases.items()}
    errors, crashes = error_over_time_figure(flown, 1.6).axes
    kept, lost = errors.lines[:2]
    assert lost.get_xdata()[-1] == kept.get_xdata()[-1] == 3.0
    assert lost.get_ydata()[-1] == 1.6 > kept.get_ydata()[-1]
    assert [line.get_ydata()[-1] for line in crashes.lines] == [100.0, 0.0]
    (only,) = error_over_time_figure({"pd": flown["pd"]}, 1.6).axes
    assert only.get_xlabel() == "time [s]"


def test_a_course_that_is_finished_is_no_crash():
    env = QuadVectorEnv(20, "waypoints", gate_count=1)
    episodes = roll_out(PDPolicy(env, gains="lab"), env, seed=0)
    assert (episodes.ending == "last_gate").all()
    assert not episodes.crashed.any()
    assert (episodes.gates_passed == 1).all()


def test_evaluate_equals_roll_out_of_environment_made_by_hand():
    policy = Wobbly(0.5)
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=9, max_tilt=0.7)
    roll_out(policy, env, seed=4)
    by_hand = roll_out(policy, env, seed=4)
    episodes = evaluate(policy, "QuadGym/Hover-v0", episodes=9, seed=4, max_tilt=0.7)
    for mine, other in zip(episodes, by_hand, strict=True):
        np.testing.assert_array_equal(mine, other)


def test_invalid_roll_outs_raise_value_error():
    policy = Wobbly(0.5)
    with pytest.raises(ValueError, match="QuadVectorEnv"):
        roll_out(policy, gymnasium.make_vec("Pendulum-v1", num_envs=2))
    with pytest.raises(ValueError, match="time limit"):
        roll_out(policy, QuadVectorEnv(2, "hover", duration=0.0))
    with pytest.raises(ValueError, match='autoreset_mode="NextStep" or "SameStep", got "Disabled"'):
        roll_out(policy, QuadVectorEnv(2, "hover", autoreset_mode="Disabled"))
    with pytest.raises(ValueError, match="env_id"):
        evaluate(policy, "QuadGym/Square-v0")
    with pytest.raises(ValueError, match="episodes"):
        evaluate(policy, "QuadGym/Hover-v0", episodes=0)


def test_a_policy_of_another_task_flies_with_a_warning():
    env = gymnasium.make_vec("QuadGym/Waypoints-v0", num_envs=1)
    with pytest.warns(UserWarning, match=r"trained on QuadGym/Circle-v0, but flies QuadGym/Waypo"):
        load_policy(str(pretrained_file("QuadGym/Circle-v0")), env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_policy("pretrained", env)


def test_policies_trained_on_the_truth_load_by_name():
    env_id = "QuadGym/LookAround-v0"
    assert keywords_of_policy("pretrained:truth", env_id) == {}
    policy = load_policy("pretrained:truth", gymnasium.make_vec(env_id, num_envs=2))
    assert policy.record["plan"]["environment"] == {"observation": "truth"}
    with pytest.raises(ValueError, match=r"for QuadGym/Hover-v0; did you mean pretrained:t"):
        load_policy("pretrained:thruth", QuadEnv("hover"))
    with pytest.raises(ValueError, match="there are no gains"):
        load_policy("pd:", QuadEnv("hover"))
    with pytest.raises(ValueError, match=r"no policy pretrained:truth is included for QuadGym/Hov"):
        load_policy("pretrained:truth", gymnasium.make_vec("QuadGym/Hover-v0", num_envs=2))
