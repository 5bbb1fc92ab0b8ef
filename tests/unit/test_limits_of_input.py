"""Invalid values are refused by name; values at the limit are accepted."""

import math

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym import FlightBatch, Uniform, UnscentedKalmanFilter, WorldParams
from quad_gym.envs.single import QuadEnv
from quad_gym.records import Ending, Source

LAB, RTK = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("rtk").simplified()
VEHICLE = quad_gym.vehicle_params("lab")


def refused(message, make, *arguments, kind=ValueError, **keywords):
    with pytest.raises(kind, match=message):
        make(*arguments, **keywords)


def test_duration_of_a_step_or_of_no_limit_is_accepted():
    assert QuadEnv("hover", duration=0.0101).flights.batch.max_steps == 1
    assert QuadEnv("hover", duration=0.0).flights.batch.max_steps == 0
    env = gymnasium.make("QuadGym/Hover-v0", duration=0.0, max_episode_steps=-1)
    assert (env.unwrapped.flights.batch.max_steps, env.spec.max_episode_steps) == (0, None)


def amplification(z):
    """Factor of one classic Runge-Kutta step of a decay: the series of exp(-z) to fourth order."""
    return abs(sum((-z) ** k / math.factorial(k) for k in range(5)))


@pytest.mark.parametrize("substeps", [1, 3])
def test_rotors_too_fast_for_the_integration_are_refused(substeps):
    step = 0.005 / substeps
    slow, fast = step / 2.779, step / 2.8
    assert amplification(step / slow) < 1.0 < amplification(step / fast)
    fast_ones, slow_ones = (VEHICLE.replace(motor_time_constant=tau) for tau in (fast, slow))
    message = f"motor_time_constant must be at least .*substeps={substeps}"
    refused(message, FlightBatch, 1, vehicle=fast_ones, substeps=substeps)
    refused(message, FlightBatch, 1, true_vehicle=fast_ones, substeps=substeps)
    draws = {"motor_time_constant": Uniform(fast, 0.1)}
    message = "randomization of 'motor_time_constant'"
    refused(message, QuadEnv, "hover", randomization=draws, substeps=substeps)
    batch = FlightBatch(1, vehicle=slow_ones, substeps=substeps, source=Source.TRUTH)
    batch.reset(seeds=[1])
    for _ in range(400):
        batch.step()
    top = VEHICLE.motor_speed_per_volt * VEHICLE.max_voltage
    assert (abs(batch.record("rotor_speeds")) < 2.0 * top).all()
    QuadEnv("hover", randomization={"motor_time_constant": Uniform(slow, 0.1)}, substeps=substeps)


@pytest.mark.parametrize(
    ("wind", "options"),
    [
        (0.0, {}),
        (50.0, {"world": WorldParams(wind_I=(0.0, 30.0, 40.0))}),
        (70.0, {"world": WorldParams(wind_I=(0.0, 30.0, 40.0), gust_wind_speed=20.0)}),
        (50.0, {"randomization": {"wind_east": Uniform(-50.0, 20.0)}}),
        (50.0, {"randomization": {"wind_speed": Uniform(0.0, 30.0), "wind_up": Uniform(0, 40)}}),
        (25.0, {"randomization": {"gust_wind_speed": Uniform(0.0, 25.0)}}),
    ],
)
def test_drag_too_large_for_the_integration_is_refused(wind, options):
    """Drag F = c v^2 / 2 at v = 100 m/s and the wind: its decay c v / m must suit the step."""
    decay = 2.78 / 0.005
    largest = decay * VEHICLE.mass / (VEHICLE.disc_area * VEHICLE.air_density * (100.0 + wind))
    for factor in (0.999, 1.001):
        blunt = VEHICLE.replace(drag_coefficient=factor * largest)
        keywords = {"true_vehicle": blunt, "source": Source.TRUTH, **options}
        if factor < 1.0:
            FlightBatch(1, **keywords)
        else:
            refused("drag must slow the vehicle down by less than", FlightBatch, 1, **keywords)


@pytest.mark.parametrize(
    ("task", "least", "options"),
    [  # the least period with a thrust of twice the weight
        ("circle", 3.05, {}),
        ("circle", 4.26, {"randomize_reference": True}),
        ("circle", 0.98, {"action": "motor"}),
        ("lemniscate", 3.85, {}),
    ],
)
def test_periods_too_short_for_the_thrust_limit_are_refused(task, least, options):
    message = "period is infeasible for this vehicle"
    refused(message, QuadEnv, task, period=0.99 * least, **options)
    QuadEnv(task, period=1.01 * least, **options)


def test_step_before_reset_is_refused():
    for kind in (ValueError, RuntimeError):
        refused("call reset", FlightBatch(3).step, kind=kind)
    batch = FlightBatch(3)
    batch.reset(seeds=[1, 2, 3], mask=[True, False, True])
    refused("1 of 3 flights have never been reset", batch.step)
    empty = batch.snapshot()
    batch.reset(mask=[False, True, False])
    batch.step()
    batch.restore(empty)
    refused("1 of 3 flights", batch.step)


def test_an_absolute_position_does_not_start_a_filter():
    ukf = UnscentedKalmanFilter(LAB)
    baseline = np.array([0.1, 0.1, 0.0])
    absolute = np.array(LAB.gnss.reference_antenna_G) + 1.0
    refused("gnss_position_G must be relative", ukf.initialize, absolute, baseline)
    refused("call initialize", ukf.predict, np.zeros(3), np.zeros(3), kind=RuntimeError)
    ukf.initialize([1.0, 2.0, 3.0], baseline)


def test_pd_policy_refuses_transformed_observations():
    sb3_wrappers = pytest.importorskip("stable_baselines3.common.vec_env")
    single = gymnasium.make("QuadGym/Circle-v0")
    vector = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=2)
    sb3 = quad_gym.make_sb3_vec_env("QuadGym/Circle-v0", 2)
    wrappers, vector_wrappers = gymnasium.wrappers, gymnasium.wrappers.vector
    for wrapped in (
        wrappers.NormalizeObservation(single),
        wrappers.TransformObservation(single, lambda x: 2.0 * x, None),
        wrappers.FrameStackObservation(single, 2),
        wrappers.TimeLimit(wrappers.NormalizeObservation(single), 10),
        vector_wrappers.NormalizeObservation(vector),
        sb3_wrappers.VecNormalize(sb3),
        sb3_wrappers.VecFrameStack(sb3, 2),
    ):
        refused("env must return its original observations", PDPolicy, wrapped)
    for plain in (
        wrappers.TimeLimit(single, 10),
        wrappers.RecordEpisodeStatistics(single),
        vector_wrappers.RecordEpisodeStatistics(vector),
        sb3_wrappers.VecNormalize(sb3, norm_obs=False),
    ):
        PDPolicy(plain)


@pytest.mark.parametrize(
    ("given", "steps"),
    [
        ({"max_episode_steps": 1000, "control_rate": 100.0}, 1000),
        ({"max_episode_steps": 30, "duration": 0.4}, 20),
        ({"max_episode_steps": 10, "duration": 0.4}, 10),
        ({"duration": 0.4}, 20),
        ({}, 500),
    ],
)
def test_limit_in_steps_holds_in_every_interface(given, steps):
    still = {"observation": "truth", "action": "velocity", **given}
    single = gymnasium.make("QuadGym/Hover-v0", **still)
    vector = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=2, **still)
    sb3 = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", 2, **still)
    for env in (vector, sb3):
        assert env.flights.batch.max_steps == steps
    own = single.unwrapped.flights.batch.max_steps  # gymnasium.make keeps max_episode_steps
    assert own == round(given.get("duration", 10.0) * given.get("control_rate", 50.0))
    single.reset(seed=1)
    for k in range(1, steps + 1):
        _, _, terminated, truncated, info = single.step(np.zeros(4))
        assert not terminated
        assert truncated == (k == steps)
    assert (info["ending"] == Ending.TIME_LIMIT) == (own == steps)
