"""Invalid values are refused by name; values at the limit are accepted."""

import math

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym import FlightBatch, TaskParams, Uniform, UnscentedKalmanFilter
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.faults import GnssOutage, PositionJump, RotorLoss
from quad_gym.records import Ending, Source
from tests.builders import MAKERS

LAB, RTK = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("rtk").simplified()
VEHICLE = quad_gym.vehicle_params("lab")


def refused(message, make, *arguments, kind=ValueError, **keywords):
    with pytest.raises(kind, match=message):
        make(*arguments, **keywords)


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("gnss", {"rate": 5.0}, r"GNSS rate \[Hz\] of sensors, 10\.0, got 5\.0"),
        ("gnss", {"velocity_sigma": None}, "presence of GNSS velocities"),
        ("gnss", {"phase": 0.5}, "GNSS phase of sensors, None, got 0.5"),
        ("camera", {"rate": 50.0}, r"camera rate \[Hz\] of sensors, 25\.0, got 50\.0"),
        ("camera", {"phase": 0.0}, "camera phase of sensors, None, got 0.0"),
        ("camera", {"features_I": ((1.0, 2.0, 0.0),)}, "camera features of sensors, 12, got 1"),
        ("imu", {"rate": 400.0}, "IMU rate"),
        ("imu", {"samples": "instant"}, "IMU samples"),
    ],
)
def test_incompatible_true_sensors_are_refused(part, changes, message):
    true = RTK.replace(**{part: getattr(RTK, part).replace(**changes)})
    message = f"true_sensors must have the .*{message}"
    refused(message, FlightBatch, 1, sensors=RTK, true_sensors=true)
    refused(message, QuadEnv, "hover", sensors=RTK, true_sensors=true)


def test_duration_that_rounds_to_zero_steps_is_refused():
    for duration in (0.001, 0.0099):
        refused("duration must be 0", QuadEnv, "hover", duration=duration)
    refused("duration must be 0", FlightBatch, 1, task=TaskParams(duration=0.001))
    assert QuadEnv("hover", duration=0.0101).flights.batch.max_steps == 1
    assert QuadEnv("hover", duration=0.0).flights.batch.max_steps == 0
    env = gymnasium.make("QuadGym/Hover-v0", duration=0.0, max_episode_steps=-1)
    assert (env.unwrapped.flights.batch.max_steps, env.spec.max_episode_steps) == (0, None)
    refused("threads must be at most 1024", FlightBatch, 8, threads=1025)
    refused("radius must be at most 1000", QuadEnv, "circle", radius=1e9)
    for good in (np.float32(3.0), np.int64(3), np.array(3.0)):
        assert TaskParams(radius=good).radius == 3.0


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


def test_physically_impossible_inertia_is_refused():
    flat, rod = np.diag([1.0, 2.0, 3.0]), np.diag([1e-3, 1.0, 1.0])
    for good in (flat, rod):
        quad_gym.VehicleParams(inertia=good)
    turned = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for bad in (np.diag([1.0, 2.0, 3.001]), turned @ np.diag([1.0, 1.0, 2.1]) @ turned.T):
        bad = (bad + bad.T) / 2.0
        refused("VehicleParams.inertia must belong to a body", quad_gym.VehicleParams, inertia=bad)


def test_draws_of_physically_impossible_inertia_are_refused():
    def drawn(*moments):
        return {"inertia": [Uniform(low, high) for low, high in moments]}

    one = (1e-3, 2e-3)
    bad = drawn(one, one, (4.1e-3, 5e-3))
    refused("randomization of 'inertia'", FlightBatch, 1, randomization=bad)
    FlightBatch(1, randomization=drawn(one, one, (3.9e-3, 5e-3)))
    FlightBatch(1, randomization={"inertia": Uniform(0.8, 1.2, relative=True)})


def test_averaged_samples_need_midpoint_integration():
    suite = LAB.replace(imu=LAB.imu.replace(samples="average"))
    message = "integration='midpoint'"
    refused(message, FlightBatch, 1, sensors=suite)
    refused(message, QuadEnv, "hover", sensors=suite)
    refused(message, UnscentedKalmanFilter, suite)
    FlightBatch(1, sensors=suite, source=Source.TRUTH)  # no filter runs


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


def test_invalid_start_options_are_refused_without_effect():
    env, vector = QuadEnv("hover"), QuadVectorEnv(2, "hover")
    for one in (env, vector):
        one.reset(seed=1)
        before = one.flights.batch.snapshot(), one.np_random.bit_generator.state
        for options, message in (
            ({"position": [1e12, 0.0, 0.0]}, "position must be .* out_of_bounds=1.6 m"),
            ({"position": [1e300, 0.0, 0.0]}, "position must be .* out_of_bounds=1.6 m"),
            ({"velocity": [0.0, 1e9, 0.0]}, "velocity must be at most"),
            ({"yaw": 1e300}, "yaw must be at most"),
            ({"yaw": 90.0}, r"yaw must be in rad, .* got 90; did you mean 1\.571\?"),
            ({"position": ["1", "2", "3"]}, "position must be numbers"),
        ):
            refused(message, one.reset, seed=5, options=options)
            assert one.flights.batch.snapshot().tobytes() == before[0].tobytes()
            assert one.np_random.bit_generator.state == before[1]
    wide = QuadEnv("hover", out_of_bounds=1e6)
    assert np.isfinite(wide.reset(seed=1, options={"position": [9e5, 0.0, 0.0]})[0]).all()


@pytest.mark.parametrize("seed", [1.5, "a", -1, True, (), {}])
def test_invalid_seeds_are_refused(seed):
    for env in (QuadEnv("hover"), QuadVectorEnv(2, "hover")):
        refused("seed must be", env.reset, seed=seed)
    if seed != ():
        refused("seed must be", QuadVectorEnv(1, "hover").reset, seed=[seed])
    refused("seed must be", quad_gym.make_sb3_vec_env, "QuadGym/Hover-v0", seed=seed)
    refused("seeds must be", FlightBatch(2).reset, seeds=[seed, 1])
    refused("seeds must hold 2", FlightBatch(2).reset, seeds=seed)
    first = QuadEnv("hover").reset(seed=np.int64(7))[0]
    np.testing.assert_array_equal(first, QuadEnv("hover").reset(seed=7)[0])


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


@pytest.mark.parametrize("maker", MAKERS)
def test_misplaced_keywords_are_refused_with_a_suggestion(maker):
    make = MAKERS[maker]
    refused("contrl_rate is not a keyword .* did you mean control_rate?", make, contrl_rate=1)
    refused("gate_count belongs to the task waypoints", make, gate_count=3)
    refused("camera must not be True", make, camera=True, sensors="consumer")
    refused("num_envs is n_envs here", quad_gym.make_sb3_vec_env, "QuadGym/Hover-v0", num_envs=2)
    make(camera=False, sensors="consumer")
    make(camera=True, sensors="rtk")


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize("observation", ["truth", "noisy"])
def test_faults_of_sensors_need_sensors(maker, observation):
    make = MAKERS[maker]
    message = f'GnssOutage concerns sensors, and none runs with observation="{observation}"'
    for faults in ("gnss_outage", (RotorLoss(), GnssOutage())):
        refused(message, make, observation=observation, faults=faults)
    make(observation=observation, faults=(RotorLoss(), PositionJump()))
    make(observation=observation, faults="gnss_outage", innovations=True)
    make(observation="measurements", faults="gnss_outage")


def test_pd_policy_refuses_transformed_observations():
    from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

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
        VecNormalize(sb3),
        VecFrameStack(sb3, 2),
    ):
        refused("env must return its original observations", PDPolicy, wrapped)
    for plain in (
        wrappers.TimeLimit(single, 10),
        wrappers.RecordEpisodeStatistics(single),
        vector_wrappers.RecordEpisodeStatistics(vector),
        VecNormalize(sb3, norm_obs=False),
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
