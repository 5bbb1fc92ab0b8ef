"""Wrong tasks raise errors that name the method and the flights, and leave flights usable."""

import warnings

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import TaskError
from quad_gym.records import Ending
from tests.builders import vec_env
from tests.contract.comparing import assert_same

FLIGHTS = 9


def at(flights, value):
    """Return ones (n,), with a value at some flights."""
    array = np.ones(FLIGHTS)
    array[list(flights)] = value
    return array


WRONG = {
    "reward": [
        (lambda v: np.ones(3), r"reward must return shape \(9,\).*got \(3,\)"),
        (lambda v: 1.0, r"reward must return shape \(9,\)"),
        (lambda v: None, "reward must return numbers, got None"),
        (lambda v: ["a"] * FLIGHTS, "reward must return numbers"),
        (lambda v: np.ones(FLIGHTS) * 1j, "reward must return numbers"),
        (lambda v: at([2, 5], np.nan), "reward must return finite rewards.*nan.*flights 2, 5"),
        (lambda v: at([8], 1e40), "finite rewards.*flight 8"),
        (lambda v: at(range(8), np.nan), "flights 0, 1, 2, 3, 4 and 3 more"),
        (lambda v: 1 / 0, "reward failed, for all flights: ZeroDivisionError"),
        (lambda v: v.altitude, "reward failed.*no attribute 'altitude'"),
        (lambda v: v.positon, r"no attribute 'positon'; did you mean position\?$"),
        (lambda v: v.observed.positon, r"no attribute 'positon'; did you mean position\?$"),
        (lambda v: v.truth.velocty, r"no attribute 'velocty'; did you mean velocity\?$"),
        (lambda v: v.nis, r"no attribute 'nis'; did you mean view.estimate.nis\?$"),
        (lambda v: v.observed.gyro, r"no attribute 'gyro'; did you mean view.measured.gyro\?$"),
        (lambda v: v.position.__setitem__(0, 1.0), "reward failed.*read-only"),
        (lambda v: v.builtin.reward.__iadd__(1.0), "reward failed.*read-only"),
        (lambda v: setattr(v, "mine", 1.0), "reward failed.*store your own data in view.state"),
        (lambda v: setattr(v.state, "count", 1.0), "reward failed.*read-only"),
        (lambda v: v.state.other, "declares no state 'other'"),
        (lambda v: v.state.cuont, r"no state 'cuont'.*; did you mean count\?$"),
    ],
    "terminated": [
        (lambda v: np.zeros(FLIGHTS), "terminated must return booleans.*got float64"),
        (lambda v: np.zeros(2, bool), r"terminated must return booleans of shape \(9,\)"),
        (lambda v: False, "terminated must return booleans of shape"),
        (lambda v: v.nothing, "terminated failed"),
    ],
    "truncated": [(lambda v: np.zeros(FLIGHTS, int), "truncated must return booleans")],
    "update": [(lambda v, rng: rng.normal(size=3), "update failed.*size must begin")],
    "observe": [
        (lambda v: np.ones((FLIGHTS, 3)), "must always return the same sizes"),
        (lambda v: dict.fromkeys("ab", np.ones(FLIGHTS)), "always return the same sizes"),
        (lambda v: np.ones(3), r"observe must return shape \(9,\) or \(9, k\)"),
        (lambda v: np.ones((FLIGHTS, 1, 1)), "observe must return shape"),
        (lambda v: at([3], np.inf), "observe must return finite 'observed'.*flight 3"),
        (lambda v: {"observed": np.ones((FLIGHTS, 1)) * 1j}, "observe must return numbers"),
        (lambda v: {"observed": np.full((FLIGHTS, 1), None)}, "observe must return numbers"),
        (lambda v: v.position, r"cannot read the truth \(view.position\).*view.observed"),
        (lambda v: v.truth.position, r"cannot read the truth \(view.truth\)"),
        (lambda v: v.builtin.reward, r"cannot read the truth \(view.builtin\)"),
        (lambda v: v.position_error, r"cannot read the truth \(view.position_error\)"),
    ],
}
CASES = [(method, *case) for method, cases in WRONG.items() for case in cases]


class Switch:
    """Method that returns valid values until it is switched."""

    def __init__(self, method, wrong):
        right = {
            "reward": lambda v: np.ones(v.count),
            "observe": lambda v: np.ones(v.count),
            "update": lambda v, rng: None,
        }
        self.right = right.get(method, lambda v: np.zeros(v.count, bool))
        self.wrong, self.on = wrong, False

    def __call__(self, *arguments):
        return (self.wrong if self.on else self.right)(*arguments)


def with_switch(method, wrong, mode):
    switch = Switch(method, wrong)
    task = quad_gym.Task.of(state={"count": 0.0}, **{method: switch})
    return vec_env(count=FLIGHTS, seed=3, task=task, autoreset_mode=mode, threads=1), switch


@pytest.mark.parametrize(("method", "wrong", "message"), CASES)
def test_error_names_method_and_flights_and_reset_recovers(method, wrong, message):
    actions = np.zeros((FLIGHTS, 4))
    env, switch = with_switch(method, wrong, "NextStep")
    fresh, _ = with_switch(method, wrong, "NextStep")
    env.step(actions)
    switch.on = True
    with (
        np.errstate(all="ignore"),
        pytest.raises(TaskError, match=f"Task.{method} .*|{message}") as caught,
    ):
        env.step(actions)
    assert caught.match(message)
    with pytest.raises(RuntimeError, match=r"call reset\(\) before step.*flights 0, 1, 2, 3, 4"):
        env.step(actions)
    switch.on = False
    assert_same(env.reset(seed=8), fresh.reset(seed=8))
    for _ in range(3):
        assert_same(env.step(actions), fresh.step(actions))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_snapshot_from_before_error_is_restored_and_continues(mode):
    env, switch = with_switch("reward", lambda v: at([1], np.nan), mode)
    actions = np.full((FLIGHTS, 4), 0.1)
    env.step(actions)
    instant = env.flights.batch.snapshot()
    expected = env.step(actions)
    env.flights.batch.restore(instant)
    switch.on = True
    with pytest.raises(TaskError):
        env.step(actions)
    env.flights.batch.restore(instant)
    switch.on = False
    assert_same(env.step(actions), expected)


def test_flights_that_failed_must_be_reset():
    class Wrong(quad_gym.Task):
        """Task whose start can be set to an invalid one."""

        wrong = None

        def reset(self, view, rng):
            return self.wrong

    env = vec_env(count=3, seed=0, task=Wrong(), autoreset_mode="Disabled")
    task = env.flights.batch.own_task
    mask = np.array([False, True, False])
    for wrong, message in (
        ({"position": np.full((3, 3), np.nan)}, "finite numbers for 'position'.*flight 1"),
        ({"position": np.zeros(2)}, r"shape \(3, 3\) for 'position', got \(2,\)"),
        ({"height": 1.0}, "None or a dictionary with any of position, velocity, yaw"),
        ({"velocity": np.full(3, 1e6)}, "invalid start: velocity must be at most"),
        ({"yaw": 100.0}, "invalid start: yaw must be in rad, within ±2 pi, got 100"),
        (7, "None or a dictionary with any of"),
    ):
        task.wrong = wrong
        with pytest.raises(TaskError, match=f"Wrong.reset .*{message}"):
            env.reset(options={"reset_mask": mask})
        with pytest.raises(RuntimeError, match=r"call reset\(\).*Wrong has failed for flight 1"):
            env.step(np.zeros((3, 4)))
    task.wrong = None
    env.reset(options={"reset_mask": mask})
    env.step(np.zeros((3, 4)))


def test_failed_reset_of_no_flight_needs_no_reset():
    def fail(view):
        raise OSError("full")

    env, switch = with_switch("observe", fail, "Disabled")
    batch = env.flights.batch
    switch.on = True
    with pytest.raises(TaskError, match="observe failed"):
        batch.reset(mask=np.zeros(FLIGHTS, bool))
    switch.on = False
    batch.step(np.zeros((FLIGHTS, 4)))


def test_interrupted_step_needs_a_reset():
    def stop(view):
        raise KeyboardInterrupt

    env, switch = with_switch("reward", stop, "SameStep")
    switch.on = True
    with pytest.raises(KeyboardInterrupt):
        env.step(np.zeros((FLIGHTS, 4)))
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(np.zeros((FLIGHTS, 4)))


def test_privileged_task_observes_the_truth():
    class Open(quad_gym.Task):
        """Task that observes the truth."""

        privileged = True

        def observe(self, view):
            return {"truth": view.position, "reward": view.builtin.reward}

    for mode in ("SameStep", "NextStep"):
        made = {"count": 2, "autoreset_mode": mode, "max_episode_steps": 3}
        env, plain = vec_env(task=Open(), **made), vec_env(**made)
        assert_same(env.reset(seed=0)[0][:, :28].copy(), plain.reset(seed=0)[0])
        for _ in range(7):
            action = np.full((2, 4), 0.1)
            observation, reward, *_, over, info = env.step(action)
            theirs, their_reward, *_ = plain.step(action)
            np.testing.assert_array_equal(observation[:, :28], theirs)
            np.testing.assert_array_equal(reward, their_reward)
            position = env.flights.batch.record("r").astype(np.float32)
            np.testing.assert_array_equal(observation[:, 28:31], position)
            started = over if mode == "SameStep" else env.flights.batch.began
            expected = np.where(started, 0.0, reward).astype(np.float32)
            np.testing.assert_array_equal(observation[:, 31], expected)
            if "final_obs" in info:
                final = np.stack(list(info["final_obs"]))
                np.testing.assert_array_equal(final[:, 31], reward.astype(np.float32))


SEES = {"observe": lambda view: {"a": view.time}}


def test_flight_with_a_state_that_is_not_finite_ends():
    task = quad_gym.Task.of(
        terminated=lambda view: np.zeros(view.count, bool),
        reward=lambda view: view.position[:, 0],
        observe=lambda view: view.observed.position,
    )
    env = vec_env(count=2, seed=0, task=task, autoreset_mode="SameStep")
    env.flights.batch._blocks["v"][0, :, 1] = np.nan
    with np.errstate(invalid="ignore"):
        observation, reward, terminated, _, info = env.step(np.zeros((2, 4)))
    assert list(terminated) == [False, True]
    assert reward[1] == 0.0
    assert info["final_info"]["ending"][1] == Ending.OUT_OF_BOUNDS
    assert np.isfinite(observation).all()
    assert np.isfinite(info["final_obs"][1]).all()


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"state": {"a b": 1.0}}, "names in state must be identifiers"),
        ({"state": {"a": "text"}}, "state must contain numbers"),
        ({**SEES, "observes": {"a": 3}}, "must map names to ObservationSpec"),
        ({**SEES, "observes": {"b": quad_gym.ObservationSpec()}}, "'b', which observe does not"),
        ({"observe": lambda v: {"up": v.time}}, "must not return 'up'"),
        ({"observe": lambda v: {"true_up": v.observed.up}}, "must not return 'true_up'"),
        ({"observe": lambda v: {}, "replaces_observation": True}, "must return something"),
        ({"replaces_observation": 1}, "replaces_observation of Task must be True or False"),
    ],
)
def test_invalid_declarations_are_refused(attributes, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make("QuadGym/Hover-v0", task=quad_gym.Task.of(**attributes))


def test_misspelled_method_gives_warning():
    with pytest.warns(UserWarning, match=r"Mine\.rewards is not called; did you mean reward\?"):

        class Mine(quad_gym.Task):
            def rewards(self, view):
                return view.time

    with warnings.catch_warnings():
        warnings.simplefilter("error")

        class Right(quad_gym.Task):
            def reward(self, view):
                return self.pieces(view)

            def pieces(self, view):
                return view.time


def test_missing_attribute_of_a_user_object_has_no_suggestion():
    class Silent:
        """Object that does not list its attributes."""

        def __dir__(self):
            raise RuntimeError("attributes are not listed")

    env = vec_env(count=2, seed=0, task=quad_gym.Task.of(reward=lambda view: Silent().gain))
    with pytest.raises(TaskError, match=r"reward failed.*no attribute 'gain'$") as caught:
        env.step(np.zeros((2, 4)))
    assert isinstance(caught.value.__cause__, AttributeError)
