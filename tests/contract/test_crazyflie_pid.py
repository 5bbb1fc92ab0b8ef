"""The Crazyflie's PID: closed forms, and its step response in the simulator."""

import gymnasium
import numpy as np
import pytest
from numpy.polynomial import polynomial
from scipy.signal import StateSpace, lsim

import quad_gym
from baselines.crazyflie_pid import CrazyfliePID
from baselines.policies import keywords_of_policy, load_policy
from quad_gym.evaluation import roll_out

RATE = 500.0


def environment(**keywords):
    suite = quad_gym.sensor_suite("mocap")
    given = {
        "action": "motor",
        "layout": "absolute",
        "control_rate": RATE,
        "observation": "truth",
        "vehicle": "crazyflie",
        "radius": 1e-6,
        "sensors": suite.replace(imu=suite.imu.replace(rate=RATE)),
    }
    return gymnasium.make_vec("QuadGym/Hover-v0", 1, **{**given, **keywords})


def parts(env):
    return {field.name: field.slice for field in env.unwrapped.flights.table}


def test_thrust_of_a_constant_height_error_follows_the_closed_form():
    """With w = 2 e + e t / 2, it is 36,000 + 25,000 w + 15,000 int w dt."""
    env = environment()
    policy, shown, error, state = CrazyfliePID(env), parts(env), 0.02, None
    observation = np.zeros((1, env.single_observation_space.shape[0]))
    observation[:, shown["R_BI"]] = np.eye(3).ravel()
    observation[:, shown["reference_heading"]] = (1.0, 0.0, 0.0)
    observation[:, shown["reference_position"]] = (0.0, 0.0, error)
    for _ in range(1000):
        action, state = policy.predict(observation, state)
    t = 2.0
    thrust = 36e3 + 25e3 * error * (2.0 + 0.5 * t) + 15e3 * error * (2.0 * t + 0.25 * t * t)
    volts = env.unwrapped.flights.batch.vehicle.hover_voltage * (1.0 + action)
    force = polynomial.polyval(volts, policy.gains.force_curve)
    np.testing.assert_allclose(force, 0.12 * thrust / 65535.0, rtol=2e-3)


def linear_step(vehicle, curve, times, step):
    """Return the response (n,) of x to a step, by the linear loop about hover."""
    hover, lag = vehicle.hover_voltage, vehicle.motor_time_constant
    # force of the vehicle per force that the firmware's curve has
    ratio = (
        2.0
        * (vehicle.mass * vehicle.gravity / 4.0 / hover)
        / polynomial.polyval(hover, polynomial.polyder(curve))
    )
    arm = vehicle.rotor_positions_B[0][0]
    turn = 4.0 * arm * 0.5 * 0.12 / 65535.0 * ratio / vehicle.inertia[1][1]
    deg = np.degrees(1.0)
    # x, v, pitch, rate, torque over inertia; integrals of velocity, angle and rate errors
    x, v, pitch, rate, push, of_v, of_angle, of_rate, one = np.eye(9)
    e_v = 2.0 * (step * one - x) - v
    e_angle = 25.0 * e_v + of_v - deg * pitch
    e_rate = 6.0 * e_angle + 3.0 * of_angle - deg * rate
    wanted = turn * (250.0 * e_rate + 500.0 * of_rate - 2.5 * deg * push)
    A = np.array(
        [v, 9.8 * pitch, rate, push, (wanted - push) / lag, e_v, e_angle, e_rate, 0.0 * one]
    )
    system = StateSpace(A, np.zeros((9, 1)), x[np.newaxis], [[0.0]])
    return lsim(system, np.zeros(len(times)), times, X0=one)[1]


def test_step_response_is_that_of_the_linear_loop():
    env = environment(start="hover", duration=12.0, world=quad_gym.WorldParams())
    policy, shown, state, step = CrazyfliePID(env), parts(env), None, 0.05
    batch = env.unwrapped.flights.batch
    observation, _ = env.reset(seed=1, options={"position": (0.0, 0.0, 1.0), "yaw": 0.0})
    settled, found = round(9.0 * RATE), []
    for k in range(round(11.0 * RATE)):
        goal = (step if k >= settled else 0.0, 0.0, 1.0)
        observation[:, shown["reference_position"]] = goal
        observation[:, shown["reference_heading"]] = (1.0, 0.0, 0.0)
        if k >= settled:
            found.append(batch.read("position")[0, 0])
        action, state = policy.predict(observation, state)
        observation, *_ = env.step(action)
    times = np.arange(len(found)) / RATE
    expected = linear_step(batch.vehicle, policy.gains.force_curve, times, step)
    np.testing.assert_allclose(np.array(found) - found[0], expected, atol=0.05 * step)
    assert expected.max() > step  # it overshoots


def test_new_episode_forgets_the_one_before():
    env = environment()
    policy, rng = CrazyfliePID(env), np.random.default_rng(0)
    first, second = rng.normal(size=(2, 1, env.single_observation_space.shape[0]))
    expected, _ = policy.predict(second)
    _, state = policy.predict(first)
    kept, _ = policy.predict(second, state._replace(step=0))
    again, _ = policy.predict(second, state._replace(step=0), episode_start=[True])
    np.testing.assert_array_equal(again, expected)
    assert not np.array_equal(kept, expected)


def test_pid_flies_trajectories_by_its_name():
    task = "QuadGym/RandomTrajectory-v0"
    given = {"vehicle": "crazyflie", "sensors": "mocap", "start": "hover", "max_speed": 0.5}
    env = gymnasium.make_vec(task, 20, **given, **keywords_of_policy("crazyflie_pid", task))
    flown = roll_out(load_policy("crazyflie_pid", env), env, seed=0)
    assert not flown.crashed.any()
    # at most 0.5 m/s, it is late by the reciprocal of its gain, 0.5 s
    assert 0.02 < np.nanmean(flown.late_error) < 0.25


@pytest.mark.parametrize("keywords", [{"layout": "relative"}, {"control_rate": 50}])
def test_environments_that_the_loops_cannot_control_are_refused(keywords):
    with pytest.raises(ValueError, match="env must have"):
        CrazyfliePID(environment(**keywords))
