"""An own task over each id keeps what it does not override: observation, endings, start, reward."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.envs import IDS
from quad_gym.tasks.look_around import LookAround
from quad_gym.tasks.outage_dash import OutageDash
from quad_gym.tasks.stale_race import StaleRace
from tests.contract.comparing import assert_same
from tests.tasks.tasks import Chase, Same

CLASSES = {"LookAround": LookAround, "OutageDash": OutageDash, "StaleRace": StaleRace}
COUNT, STEPS = 3, 90


class Bonus(quad_gym.Task):
    """Reward of the environment and one more, half of the time at first."""

    state = {"steps": 0}

    def update(self, view, rng):
        view.state.steps = view.state.steps + 1

    def reward(self, view):
        return super().reward(view) + view.state.steps

    def terminated(self, view):
        return super().terminated(view) | (view.state.steps == 20)

    def observe(self, view):
        return {"steps": view.state.steps}


def make(env_id, mode="NextStep", **keywords):
    return gymnasium.make_vec(env_id, num_envs=COUNT, autoreset_mode=mode, **keywords)


def fly(env, steps=STEPS):
    """Return all results of random actions, of which the first flight's soon crash."""
    rng, rows = np.random.default_rng(0), [env.reset(seed=7)]
    over = np.zeros(COUNT, bool)
    for _ in range(steps):
        if env.unwrapped.autoreset_mode.value == "Disabled" and over.any():
            rows.append(env.reset(options={"reset_mask": over}))
        actions = rng.uniform(-1.0, 1.0, (COUNT, 4))
        actions[0, [0, 2]] = -1.0, -0.6  # tips over, or flies into the ground
        rows.append(env.step(actions))
        over = rows[-1][2] | rows[-1][3]
    return rows


@pytest.fixture(scope="module")
def plain():
    return {env_id: fly(make(env_id)) for env_id in IDS}


@pytest.mark.parametrize("env_id", IDS)
def test_task_without_changes_gives_the_flights_of_the_id(env_id, plain):
    for own in (quad_gym.Task(), Same()):
        assert_same(fly(make(env_id, task=own)), plain[env_id], type(own).__name__)


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
@pytest.mark.parametrize("name", CLASSES)
def test_task_without_changes_gives_the_flights_of_the_class_in_other_modes(name, mode):
    env_id = f"QuadGym/{name}-v0"
    flown = fly(make(env_id, mode, task=Same()))
    assert_same(flown, fly(make(env_id, mode)))
    assert any(row[2].any() for row in flown if len(row) == 5), "no episode ended"


@pytest.mark.parametrize("env_id", IDS)
def test_own_reward_keeps_observation_endings_and_start(env_id, plain):
    own = fly(make(env_id, task=quad_gym.Task.of(reward=lambda view: np.full(view.count, 7.0))))
    began = np.zeros(COUNT, bool)
    for flown, expected in zip(own[1:], plain[env_id][1:], strict=True):
        for k in (0, 2, 3):  # observation, terminated, truncated
            np.testing.assert_array_equal(flown[k], expected[k])
        np.testing.assert_array_equal(flown[1], np.where(began, 0.0, 7.0))
        np.testing.assert_array_equal(flown[4]["ending"], expected[4]["ending"])
        np.testing.assert_array_equal(flown[4]["gates_passed"], expected[4]["gates_passed"])
        began = flown[2] | flown[3]


@pytest.mark.parametrize("env_id", IDS)
def test_own_task_builds_on_reward_endings_and_observation_of_the_id(env_id, plain):
    env = make(env_id, "Disabled", task=Bonus)
    theirs = make(env_id, "Disabled")
    size = theirs.single_observation_space.shape[0]
    assert env.single_observation_space.shape == (size + 1,)
    mine, other = fly(env, 20), fly(theirs, 20)
    going, k = np.ones(COUNT, bool), 0
    for flown, expected in zip(mine[1:], other[1:], strict=False):
        if len(flown) != 5 or len(expected) != 5 or not going.all():
            break  # an episode has ended and began anew
        k += 1
        np.testing.assert_array_equal(flown[0][:, :size], expected[0])
        np.testing.assert_array_equal(flown[0][:, size], np.full(COUNT, k))
        np.testing.assert_allclose(flown[1], expected[1] + k, rtol=1e-12)
        np.testing.assert_array_equal(flown[2], expected[2] | (k == 20))
        going &= ~(flown[2] | flown[3])
    assert k > 3


@pytest.mark.parametrize("env_id", IDS)
def test_copies_and_interfaces_fly_a_laid_task_the_same_way(env_id):
    env = make(env_id, "SameStep", task=Chase)
    flown = fly(env)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for one in copies:
        assert_same(fly(one), flown)
    theirs = quad_gym.make_sb3_vec_env(env_id, n_envs=COUNT, seed=7, task=Chase)
    np.testing.assert_array_equal(theirs.reset(), flown[0][0])
    single = gymnasium.make(env_id, task=Chase).reset(seed=8)[0]
    np.testing.assert_array_equal(single, flown[0][0][1])


def test_observation_that_replaces_keeps_named_parts_of_the_class():
    own = quad_gym.Task.of(
        observe=lambda view: {"one": np.ones(view.count)},
        replaces_observation=True,
        keeps=("features_direction", "last_action"),
    )
    env = make("QuadGym/LookAround-v0", task=own)
    names = [field.name for field in env.unwrapped.flights.table]
    assert names == ["last_action", "features_direction", "one"]
    table = {field.name: field for field in make("QuadGym/LookAround-v0").unwrapped.flights.table}
    seen, expected = env.reset(seed=1)[0], make("QuadGym/LookAround-v0").reset(seed=1)[0]
    np.testing.assert_array_equal(seen[:, 4:7], expected[:, table["features_direction"].slice])


@pytest.mark.parametrize("kind", CLASSES.values())
def test_of_keeps_the_class_and_what_is_not_given(kind):
    own = kind.of(reward=lambda view: np.ones(view.count), state={"mine": 0})
    assert type(own) is kind
    assert own.observes == kind.observes
    assert own.keeps == kind.keeps
    assert own.replaces_observation is kind.replaces_observation
    assert own.state == {**kind.state, "mine": 0}
    env_id = f"QuadGym/{kind.__name__}-v0"
    flown = fly(make(env_id, task=own))
    expected = fly(make(env_id))
    np.testing.assert_array_equal(flown[0][0], expected[0][0])
    assert_same([row[2:4] for row in flown[1:]], [row[2:4] for row in expected[1:]])


def test_own_task_over_a_registered_one_keeps_it():
    quad_gym.register_task("Mine/Laid-v0", Chase, "QuadGym/LookAround-v0")
    try:
        theirs = make("Mine/Laid-v0")
        assert theirs.single_observation_space.shape == (31 + 4,)
        own = make("Mine/Laid-v0", task=quad_gym.Task.of(reward=lambda view: np.ones(view.count)))
        flown, expected = fly(own), fly(theirs)
        assert_same([row[2:4] for row in flown[1:]], [row[2:4] for row in expected[1:]])
        np.testing.assert_array_equal(flown[1][1], 1.0)
        np.testing.assert_array_equal(flown[5][0], expected[5][0])
    finally:
        del gymnasium.registry["Mine/Laid-v0"]


@pytest.mark.parametrize(
    ("own", "error", "message"),
    [
        (
            quad_gym.Task.of(state={"earned": 0.0}),
            ValueError,
            "state of Task must not have 'earned', which the environment's task OutageDash has",
        ),
        (
            quad_gym.Task.of(observe=lambda view: {"gap_width": np.ones(view.count)}),
            quad_gym.TaskError,
            "Task.observe failed.*observe must not return 'gap_width', a name of a part of Outage",
        ),
        (
            quad_gym.Task.of(reward=lambda view: np.ones(2)),
            quad_gym.TaskError,
            r"Task.reward must return shape \(3,\)",
        ),
    ],
)
def test_wrong_task_over_a_class_is_refused_by_its_own_name(own, error, message):
    with pytest.raises(error, match=message):
        fly(make("QuadGym/OutageDash-v0", task=own), 1)


def test_weights_of_the_builtin_reward_are_refused_where_they_have_no_effect():
    own = quad_gym.Task.of(observe=lambda view: {"one": np.ones(view.count)})
    for task in (None, own):
        with pytest.raises(ValueError, match="reward_params has no effect on the task look_around"):
            make("QuadGym/LookAround-v0", task=task, reward_params=quad_gym.RewardParams())
