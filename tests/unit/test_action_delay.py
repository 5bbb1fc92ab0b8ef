"""A flight with an action delay equals a flight without one whose actions are shifted."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import Uniform
from quad_gym.params.task import TaskParams
from quad_gym.records import Autoreset, Control, Source
from tests.builders import batch as flights_of
from tests.contract.configurations import LATE

TRUTH = ("r", "v", "q", "w", "rotor_speeds")
ESTIMATE = (*TRUTH, "r_hat", "v_hat", "R_hat", "L")
HOVER = TaskParams(kind="hover", start="hover", duration=0.0, out_of_bounds=1e6)
COUNT, STEPS = 3, 14


def batch(source=Source.TRUTH, control=Control.CTBR, **keywords):
    made = {"task": HOVER, "control_rate": 50.0, "autoreset": Autoreset.DISABLED, "threads": 1}
    return flights_of(COUNT, source=source, control=control, **made | keywords)


def commands(seed=1, steps=STEPS):
    return np.random.default_rng(seed).uniform(-0.3, 0.3, (steps, COUNT, 4))


def fly(flights, actions, fields=TRUTH):
    """Return the fields after each action."""
    found = []
    for action in actions:
        flights.step(action)
        found.append([flights.record(name) for name in fields])
    return found


@pytest.mark.parametrize(
    ("source", "control", "delay", "options"),
    [
        (Source.TRUTH, Control.CTBR, 1, {}),
        (Source.TRUTH, Control.MOTOR, 3, {}),
        (Source.TRUTH, Control.VELOCITY, 10, {}),
        (Source.ESTIMATE, Control.ATTITUDE, 2, {}),
        (Source.ESTIMATE, Control.ATTITUDE, 2, {"sensors": LATE}),
    ],
    ids=["body rates", "motors", "longest", "estimate", "late measurements"],
)
def test_a_delay_of_whole_steps_shifts_the_actions(source, control, delay, options):
    actions, fields = commands(), ESTIMATE if source is Source.ESTIMATE else TRUTH
    shifted = np.concatenate([np.zeros((delay, COUNT, 4)), actions])[:STEPS]
    delayed = batch(source, control, action_delay=delay, **options)
    prompt = batch(source, control, **options)
    np.testing.assert_equal(fly(delayed, actions, fields), fly(prompt, shifted, fields))


@pytest.mark.parametrize("ticks", [1, 2, 3, 5, 7])
def test_fractional_action_delay_shifts_actions_by_ticks(ticks):
    """The reference flies at 200 Hz, with each action repeated four times and shifted by ticks."""
    actions = commands()
    every_tick = np.repeat(actions, 4, axis=0)
    every_tick = np.concatenate([np.zeros((ticks, COUNT, 4)), every_tick])[: 4 * STEPS]
    at_every_tick = fly(batch(control_rate=200.0), every_tick)
    np.testing.assert_equal(fly(batch(action_delay=ticks / 4), actions), at_every_tick[3::4])


def test_each_episode_draws_its_own_delay():
    """Each flight equals one with its drawn delay, rounded to ticks, as a constant."""
    randomization = {"action_delay": Uniform(0.0, 3.0)}
    flights, actions = batch(randomization=randomization), commands()
    drawn = flights.drawn()["action_delay"]
    assert np.ptp(drawn) > 0.25
    found = fly(flights, actions)
    for flight, delay in enumerate(drawn):
        alone = fly(batch(action_delay=np.floor(4.0 * delay + 0.5) / 4.0), actions)
        mine, its = ([[x[flight] for x in step] for step in steps] for steps in (found, alone))
        np.testing.assert_equal(mine, its)
    flights.reset()
    assert not np.array_equal(flights.drawn()["action_delay"], drawn)


def test_new_episode_clears_delayed_actions():
    short = HOVER.replace(duration=0.1)
    flights = batch(task=short, action_delay=3, autoreset=Autoreset.SAME_STEP)
    fly(flights, np.ones((5, COUNT, 4)))
    assert (flights.record("episode") == 2.0).all()
    assert not flights.record("past_actions")[:, :4].any()
    flights.step(np.ones((COUNT, 4)))
    assert not flights.record("delayed_action").any()


def test_delay_out_of_range_or_without_actions_raises_value_error():
    for randomization in ({"action_delay": Uniform(0.0, 11.0)}, {"action_delay": Uniform(-1, 1)}):
        with pytest.raises(ValueError, match="action_delay"):
            batch(randomization=randomization)
    for delayed in ({"action_delay": 1}, {"randomization": {"action_delay": Uniform(0, 1)}}):
        with pytest.raises(ValueError, match="action_delay needs actions"):
            batch(control=Control.PD, **delayed)


def test_observation_has_the_commanded_action():
    """During the delay only the cost of action changes differs: 0.02 |da|^2 per step."""
    last = quad_gym.observation_layout("truth")[-1]
    assert last.name == "last_action"
    keywords = {"observation": "truth", "start": "hover"}
    idle = gymnasium.make("QuadGym/Hover-v0", **keywords)
    late = gymnasium.make("QuadGym/Hover-v0", action_delay=2, **keywords)
    idle.reset(seed=3)
    late.reset(seed=3)
    before, zeros = np.zeros(4), np.zeros(4, np.float32)
    for action in (np.full(4, 0.5, np.float32), np.full(4, -0.5, np.float32)):
        observation, reward, *_ = late.step(action)
        np.testing.assert_array_equal(observation[last.slice], action)
        other, unchanged, *_ = idle.step(zeros)
        np.testing.assert_array_equal(observation[: last.slice.start], other[: last.slice.start])
        cost = 0.02 * np.sum((action - before) ** 2)
        assert unchanged - reward == pytest.approx(cost, rel=1e-9)
        before = action
    observation, *_ = late.step(zeros)  # carries out the first action
    other, *_ = idle.step(zeros)
    assert not np.array_equal(observation[: last.slice.start], other[: last.slice.start])
