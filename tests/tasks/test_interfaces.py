"""Tests of tasks in registration, policies, observations, commands and rendering."""

import json

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym.envs import keywords_of
from quad_gym.evaluation import evaluate, roll_out
from quad_gym.tasks import ObservationSpec
from tests import console_commands
from tests.contract.comparing import assert_same
from tests.tasks.tasks import Chase


class Half(quad_gym.Task):
    """Task with half of the built-in reward."""

    def reward(self, view):
        return 0.5 * view.builtin.reward


def distance(view):
    gap = view.features - view.observed.position[:, np.newaxis]
    return {"marker": np.linalg.norm(gap, axis=2).min(axis=1)}


@pytest.fixture
def registered():
    quad_gym.register_task("Mine/Chase-v0", Chase, "QuadGym/Hover-v0", max_episode_steps=30)
    yield "Mine/Chase-v0"
    del gymnasium.registry["Mine/Chase-v0"]


def test_registered_id_works_in_all_interfaces(registered):
    one = gymnasium.make(registered)
    assert one.spec.max_episode_steps == 30
    assert one.observation_space.shape == (32,)
    many = gymnasium.make_vec(registered, num_envs=3, sensors="rtk")
    theirs = quad_gym.make_sb3_vec_env(registered, n_envs=3, seed=5, sensors="rtk")
    np.testing.assert_array_equal(many.reset(seed=5)[0], theirs.reset())
    assert evaluate(PDPolicy(many), registered, episodes=3).lengths.max() <= 30


def test_registration_refuses_wrong_ids():
    with pytest.raises(ValueError, match="env_id must be a new one"):
        quad_gym.register_task("QuadGym/Hover-v0", Chase)
    for wrong in (3, None):
        with pytest.raises(ValueError, match="env_id must be a new one"):
            quad_gym.register_task(wrong, Chase)
        with pytest.raises(ValueError, match=r"task must be a quad_gym\.Task"):
            quad_gym.register_task("Mine/Chase-v0", wrong)
    assert "Mine/Chase-v0" not in gymnasium.registry
    with pytest.raises(ValueError, match="base must be one of"):
        quad_gym.register_task("Mine/Chase-v0", Chase, "CartPole-v1")
    for wrong in ("circle", "circel", "QuadGym/Cirle-v0", "quadgym/circle-v0"):
        with pytest.raises(ValueError, match=r"; did you mean QuadGym/Circle-v0\?$"):
            keywords_of(wrong)
    with pytest.raises(ValueError, match=r"env_id must be one of .* got 'CartPole-v1'"):
        quad_gym.make_sb3_vec_env("CartPole-v1")


def test_roll_out_sums_the_rewards_of_the_task():
    def returns(**keywords):
        env = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=4, **keywords)
        return roll_out(PDPolicy(env), env, seed=0).returns

    np.testing.assert_allclose(returns(task=Half()), 0.5 * returns(), rtol=1e-12)


def test_ending_of_the_task_is_not_a_crash():
    def late(view):
        return view.time > 0.5

    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=3, task=quad_gym.Task.of(terminated=late))
    episodes = roll_out(PDPolicy(env), env, seed=0)
    assert list(episodes.ending) == ["task"] * 3
    assert list(episodes.lengths) == [26] * 3
    assert not episodes.crashed.any()


@pytest.mark.parametrize("layout", ["relative", "absolute"])
@pytest.mark.parametrize("keywords", [{}, {"privileged": True, "include_std": True}])
def test_pd_control_finds_its_part_of_a_longer_observation(layout, keywords):
    task = quad_gym.Task.of(observe=distance)
    made = {"num_envs": 3, "layout": layout, **keywords}
    plain = gymnasium.make_vec("QuadGym/Circle-v0", **made)
    longer = gymnasium.make_vec("QuadGym/Circle-v0", task=task, **made)
    actions = [
        PDPolicy(env).predict(env.reset(seed=3)[0], deterministic=True)[0]
        for env in (plain, longer)
    ]
    np.testing.assert_array_equal(*actions)


def test_pd_control_refuses_an_observation_without_its_part():
    task = quad_gym.Task.of(observe=distance, replaces_observation=True)
    env = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=1, task=task)
    with pytest.raises(ValueError, match=r"env must observe body_rates: its task replaces"):
        PDPolicy(env)


def test_parts_of_the_task_precede_the_privileged_ones():
    env = gymnasium.make("QuadGym/Hover-v0", task=Chase(), privileged=True)
    table = env.unwrapped.flights.table
    named = {field.name: field for field in table}
    assert [field.slice.start for field in table] == [0] + [f.slice.stop for f in table[:-1]]
    assert named["target"] == ("target", slice(28, 31), "m", "B", -20.0, 20.0)
    assert named["best"][1] == slice(31, 32)
    assert named["true_position_error"].slice.start == 32
    observation, _ = env.reset(seed=0)
    assert observation["policy"].shape == (32,)
    plain, _ = gymnasium.make("QuadGym/Hover-v0", privileged=True).reset(seed=0)
    assert observation["privileged"].shape == plain["privileged"].shape


def test_observations_are_clipped_to_their_bounds():
    far = quad_gym.Task.of(
        observe=lambda view: {"a": np.full((view.count, 2), 7.0), "b": np.full(view.count, -1e9)},
        observes={"a": ObservationSpec(low=0.0, high=0.5)},
    )
    env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=2, task=far)
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation[:, 28:], [[0.5, 0.5, -1e6]] * 2)
    assert env.observation_space.contains(observation)


def test_observed_array_without_name_is_called_observed():
    env = gymnasium.make(
        "QuadGym/Hover-v0", task=quad_gym.Task.of(observe=lambda view: view.observed.position)
    )
    assert env.unwrapped.flights.table[-1][:2] == ("observed", slice(28, 31))
    observation, _ = env.reset(seed=0)
    seen = env.unwrapped.flights.batch.record("r_hat")[0].astype(np.float32)
    np.testing.assert_array_equal(observation[28:], seen)


def test_a_task_is_named_by_its_module():
    named = gymnasium.make_vec(
        "QuadGym/Hover-v0", num_envs=2, task="tests.tasks.tasks:Chase"
    ).reset(seed=0)
    assert_same(named, gymnasium.make_vec("QuadGym/Hover-v0", num_envs=2, task=Chase).reset(seed=0))


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ("tests.tasks.tasks", '"module:name"'),
        ("tests.tasks.tasks:Nobody", "must name a quad_gym.Task.*Nobody"),
        ("no.such.module:Chase", "must name a quad_gym.Task.*No module"),
        ("tests.tasks.tasks:np", "must be a quad_gym.Task"),
        (lambda view: 0.0, "must be a quad_gym.Task"),
        (quad_gym.QuadEnv, "must be a quad_gym.Task"),
    ],
)
def test_task_keyword_without_a_task_is_refused(own, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make("QuadGym/Hover-v0", task=own)


def test_functions_without_names_of_methods_are_refused():
    with pytest.raises(TypeError, match=r"a task has no rewards"):
        quad_gym.Task.of(rewards=distance)
    with pytest.raises(TypeError, match="reward must be a function"):
        quad_gym.Task.of(reward=1.0)


def test_command_line_flies_a_task_of_the_working_directory(tmp_path):
    (tmp_path / "task_of_mine.py").write_text(
        "import numpy as np\nimport quad_gym\n"
        "One = quad_gym.Task.of(reward=lambda view: np.ones(view.count))\n"
    )
    words = "evaluate QuadGym/Hover-v0 --policy pd --observation estimate --episodes 2"
    words += " --env task=task_of_mine:One max_episode_steps=5 --output out"
    done = console_commands.run(*words.split(), where=tmp_path)
    assert done.returncode == 0, done.stderr
    (case,) = json.loads((tmp_path / "out/summary.json").read_text())["cases"]
    assert case["return"] == 5.0


@pytest.mark.parametrize("command", ["evaluate", "fly"])
def test_commands_name_the_option_with_which_the_filter_of_a_reward_runs(command, tmp_path):
    (tmp_path / "uncertain.py").write_text(
        "import quad_gym\nfrom quad_gym import rewards\n"
        'Uncertain = quad_gym.Task.of(reward=rewards.Uncertainty("position"))\n'
    )
    words = f"{command} QuadGym/Hover-v0 --policy pd --observation truth --overwrite --output "
    words += {"evaluate": "out --episodes 2", "fly": "flight.npz"}[command]
    words += " --env task=uncertain:Uncertain max_episode_steps=3"
    done = console_commands.run(*words.split(), where=tmp_path)
    assert done.returncode == 2
    said = done.stderr.strip().splitlines()[-1]
    assert said.startswith("error: Task.reward needs the filter")
    assert "--observation estimate" in said
    done = console_commands.run(*words.split(), "run_filter=true", where=tmp_path)
    assert done.returncode == 0, done.stderr


def test_rendering_and_recording_take_a_task():
    pytest.importorskip("pygame")
    env = gymnasium.make("QuadGym/Hover-v0", task=Half(), render_mode="rgb_array")
    env.reset(seed=0)
    reward = env.step(np.zeros(4))[1]
    assert env.render().shape == (480, 640, 3)
    (flight,) = env.unwrapped.rendering.flights
    assert flight["reward"][-1] == reward != 0.0
