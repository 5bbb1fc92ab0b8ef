"""The launch pad: a vehicle on the ground stands still until its thrust lifts it."""

from contextlib import nullcontext

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import FlightBatch, TaskParams, Trajectory, Uniform
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.records import Control, Source


def batch(count=3, task=None, **options):
    task = {"start": "ground", "duration": 0.0, "out_of_bounds": 1e3} | (task or {})
    made = {"sensors": "lab", "source": Source.TRUTH, "control": Control.MOTOR} | options
    return FlightBatch(count, task=TaskParams(**task), control_rate=200.0, **made)


def test_thrust_below_the_weight_does_not_lift_it():
    flights = batch(1)
    flights.reset(seeds=[0])
    for _ in range(2000):
        flights.step(np.full((1, 4), -1e-6))
    assert flights.record("on_pad")[0] == 1.0


def test_a_start_with_a_velocity_is_not_on_the_pad():
    flights = batch(2)
    flights.reset(seeds=[0, 1], velocity=[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert flights.record("on_pad").tolist() == [1.0, 0.0]


def test_vehicle_stays_on_the_pad_by_default_and_sinks_without_it():
    given = {"observation": "truth", "start": "ground"}
    for pad in (True, False):
        env = gymnasium.make_vec("QuadGym/Circle-v0", 2, **given, **({} if pad else {"pad": False}))
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros((2, 4)))  # hover thrust, once the rotors have spun up
        height = env.unwrapped.flights.batch.record("r")[:, 2]
        assert (height == 0.0).all() if pad else (height < -0.03).all()


@pytest.mark.parametrize("start", ["ground", "mixed"])
@pytest.mark.parametrize("task", ["hover", "circle", "lemniscate"])
def test_a_reference_out_of_bounds_of_the_pad_is_refused(task, start):
    options = {"start": start, "out_of_bounds": 1.6}
    env = QuadVectorEnv(16, task, height=1.6, **options)
    env.reset(seed=1)
    if task == "hover":  # in other tasks the reference moves away from the limit
        ending = env.step(np.tile([-1.0, 0.0, 0.0, 0.0], (16, 1)))[4]["ending"]
        assert (ending == 0).all()
    message = rf"out_of_bounds must be at least 1\.61 m.*start='{start}'.*got out_of_bounds=1\.6 m"
    for pad in (True, False):
        with pytest.raises(ValueError, match=message):
            QuadVectorEnv(16, task, height=1.61, pad=pad, **options)


def test_only_pads_from_which_no_episode_can_begin_are_refused():
    high = {"height": 2.0, "start": "ground"}
    for changes in ({"out_of_bounds": 2.0}, {"start": "hover"}, {"start": "moving"}):
        QuadEnv("hover", **high | changes)
    with pytest.raises(ValueError, match="at least 2 m"):
        QuadEnv("hover", **high)
    with pytest.raises(ValueError, match="at least 2 m"):  # draws that leave starts on the pad
        QuadEnv("hover", **high, randomization={"mass": Uniform(0.9, 1.1, relative=True)})
    QuadEnv("hover", **high, randomization={"start_position_I": (None, None, Uniform(0.5, 1.0))})

    def above(view, rng):
        return {"position": view.reference_position - [0.0, 0.0, 0.5]}

    env = QuadEnv(base="hover", **high, task=quad_gym.Task.of(reset=above))
    env.reset(seed=1)
    assert not env.step(np.zeros(4))[2]
    low, far = (Trajectory.through([(0, 0, z), (2, 0, 2), (4, 0, 3)]) for z in (1, 4))
    QuadEnv("trajectory", start="ground", trajectory=low)
    with pytest.raises(ValueError, match="at least 4 m"):
        QuadEnv("trajectory", start="ground", trajectory=[low, far])


@pytest.mark.parametrize(
    ("task", "refused", "allowed"),
    [
        ("waypoints", {"height": 2.3}, {"height": 2.2}),  # the lowest gate is at 0.7 heights
        ("random_trajectory", {"height": 2.4}, {"height": 2.3}),  # drawn within 0.75 m of it
    ],
)
def test_a_reference_that_may_begin_within_bounds_is_allowed(task, refused, allowed):
    for keywords, fine in ((refused, False), (allowed, True)):
        with nullcontext() if fine else pytest.raises(ValueError, match="out_of_bounds must"):
            QuadEnv(task, start="ground", out_of_bounds=1.6, **keywords)
