"""Observations match their table, computed from the state in NumPy."""

import numpy as np
import pytest

import quad_gym
from quad_gym.envs.spaces import layout_bounds
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.params.sensor_table import AID_PARAMS
from quad_gym.records import (
    COLUMNS,
    FEATURE_BLOCKS,
    FEATURE_SLICE,
    MAX_FEATURES,
    MAX_OBSERVATION,
    MAX_TOGETHER,
)
from tests.builders import actions_of, vec_env
from tests.contract.test_tasks import SECONDS, UNBOUNDED, body_axes, level, unit
from tests.reference_ukf import east_north_up

OMEGA = 2 * np.pi / 10


def on_circle(t):
    """Return r*, v*, a* and x* of the circle at the time t."""
    c, s = np.cos(OMEGA * t), np.sin(OMEGA * t)
    r = np.array([4 * c, 4 * s, 1.0])
    v = 4 * OMEGA * np.array([-s, c, 0.0])
    return r, v, -(OMEGA**2) * r * [1, 1, 0], level(-r)


def flown(steps=13, n=6, **keywords):
    """Return a vector environment after some steps, its observation and the last action."""
    env = vec_env("circle", n, seed=21, autoreset_mode="Disabled", **{**UNBOUNDED, **keywords})
    for k in range(steps):
        actions = 0.3 * np.stack([actions_of(i, steps)[k] for i in range(n)])
        observation, *_ = env.step(actions)
    return env, observation, actions


def parts_of(observation, /, **keywords):
    if isinstance(observation, dict):
        observation = np.hstack([observation["policy"], observation["privileged"]])
    table = quad_gym.observation_layout(**keywords)
    assert table[-1].slice.stop == observation.shape[1]
    return {field.name: observation[:, field.slice].astype(float) for field in table}


def close(actual, expected, scale=1.0):
    np.testing.assert_allclose(actual, np.broadcast_to(expected, actual.shape), atol=2e-6 * scale)


def seen_state(env, source):
    """Return r, v, R_BI and w_B of the controller's source, truth or estimate."""
    batch = env.flights.batch
    if source == "truth":
        return batch.record("r"), batch.record("v"), body_axes(batch.record("q")), batch.record("w")
    rates = batch.record("w_meas") - batch.record("b_g_hat")
    return batch.record("r_hat"), batch.record("v_hat"), batch.record("R_hat"), rates


def in_body(R_BI, v_I):
    return np.einsum("nij,nj->ni", R_BI, np.broadcast_to(v_I, (len(R_BI), 3)))


@pytest.mark.parametrize("source", ["estimate", "truth"])
def test_relative_layout_equals_formulas(source):
    env, observation, actions = flown(observation=source)
    seen = parts_of(observation, observation=source)
    r, v, R, w = seen_state(env, source)
    t = 13 * SECONDS
    r_ref, v_ref, a_ref, x_ref = on_circle(t)
    close(seen["position_error"], in_body(R, r_ref - r), 4)
    close(seen["velocity_error"], in_body(R, v_ref - v), 4)
    close(seen["up"], R[:, :, 2])
    close(seen["heading"], in_body(R, x_ref))
    close(seen["body_rates"], w, 10)
    close(seen["reference_acceleration"], in_body(R, a_ref))
    close(seen["preview_1"], in_body(R, on_circle(t + 0.2)[0] - r_ref))
    close(seen["preview_2"], in_body(R, on_circle(t + 0.4)[0] - r_ref))
    close(seen["last_action"], actions)


@pytest.mark.parametrize("source", ["estimate", "truth"])
def test_absolute_layout_equals_formulas(source):
    env, observation, actions = flown(observation=source, layout="absolute")
    seen = parts_of(observation, observation=source, layout="absolute")
    r, v, R, w = seen_state(env, source)
    batch, hat, t = env.flights.batch, "_hat" if source == "estimate" else "", 13 * SECONDS
    r_ref, v_ref, a_ref, x_ref = on_circle(t)
    close(seen["position"], r, 4)
    close(seen["velocity"], v, 4)
    close(seen["R_BI"], R.reshape(-1, 9))
    close(seen["accel_bias"], batch.record(f"b_a{hat}"))
    close(seen["gyro_bias"], batch.record(f"b_g{hat}"))
    close(seen["body_rates"], w, 10)
    close(seen["reference_position"], r_ref, 4)
    close(seen["reference_velocity"], v_ref, 4)
    close(seen["reference_acceleration"], a_ref)
    close(seen["reference_heading"], x_ref)
    close(seen["preview_1"], on_circle(t + 0.2)[0], 4)
    close(seen["preview_2"], on_circle(t + 0.4)[0], 4)
    close(seen["last_action"], actions)


def test_previews_of_course_are_next_gates():
    env = QuadVectorEnv(5, "waypoints", observation="truth", gate_count=3)
    observation, _ = env.reset(seed=2)
    seen = parts_of(observation, observation="truth")
    gates, R = env.flights.batch.record("gates"), body_axes(env.flights.batch.record("q"))
    close(seen["position_error"], in_body(R, gates[:, 0] - env.flights.batch.record("r")), 4)
    close(seen["preview_1"], in_body(R, gates[:, 1] - gates[:, 0]), 4)
    close(seen["preview_2"], in_body(R, gates[:, 2] - gates[:, 0]), 4)


def test_the_covariance_part_is_the_root_of_the_diagonal():
    env, observation, _ = flown(include_std=True)
    seen = parts_of(observation, include_std=True)
    names = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
    sigmas = np.hstack([seen[f"{name}_sigma"] for name in names])
    P = env.flights.batch.covariance()
    np.testing.assert_allclose(sigmas, np.sqrt(np.einsum("nii->ni", P)), rtol=1e-5)
    assert (sigmas > 0).all()


@pytest.mark.parametrize("source", ["estimate", "noisy", "measurements", "truth"])
def test_the_privileged_part_is_the_truth(source):
    env, observation, _ = flown(observation=source, privileged=True)
    assert set(observation) == {"policy", "privileged"}
    seen = parts_of(observation, observation=source, privileged=True)
    batch = env.flights.batch
    R = body_axes(batch.record("q"))
    r_ref, v_ref, _, x_ref = on_circle(13 * SECONDS)
    close(seen["true_position_error"], in_body(R, r_ref - batch.record("r")), 4)
    close(seen["true_velocity_error"], in_body(R, v_ref - batch.record("v")), 4)
    close(seen["true_up"], R[:, :, 2])
    close(seen["true_heading"], in_body(R, x_ref))
    close(seen["true_body_rates"], batch.record("w"), 10)
    close(seen["true_accel_bias"], batch.record("b_a"))
    close(seen["true_gyro_bias"], batch.record("b_g"))
    hover = np.sqrt(0.78 * 9.8 / 4 / (6.11e-8 / 0.104719755**2))
    close(seen["rotor_speeds"], batch.record("rotor_speeds") / hover)


def test_measurements_come_with_flags_at_their_own_rates():
    # the vehicle faces the origin, with both features in view
    suite = quad_gym.sensor_suite("standard").with_rates(gnss=10.0, camera=25.0)
    env = QuadVectorEnv(4, "hover", observation="measurements", sensors=suite)
    observation, _ = env.reset(seed=2)
    flags = []
    for _ in range(21):
        seen = parts_of(observation, observation="measurements")
        for name in ("gnss_position", "gnss_baseline", "feature_0", "feature_1"):
            off = seen[f"{name}_valid"][:, 0] == 0.0
            assert set(np.unique(seen[f"{name}_valid"])) <= {0.0, 1.0}
            assert not seen[name][off].any()
            assert seen[name][~off].any(axis=1).all()
        flags.append((seen["gnss_position_valid"][0, 0], seen["feature_1_valid"][0, 0]))
        observation, *_ = env.step(np.zeros((4, 4)))
    gnss, camera = np.array(flags).T
    np.testing.assert_array_equal(np.flatnonzero(gnss), [0, 5, 10, 15, 20])
    np.testing.assert_array_equal(np.flatnonzero(camera), np.arange(0, 21, 2))


def test_measurements_of_other_sensors_follow_over_their_scales():
    suite = quad_gym.sensor_suite("rtk").simplified()
    suite = suite.replace(
        barometer=quad_gym.BarometerParams(rate=50.0),
        magnetometer=quad_gym.MagnetometerParams(rate=50.0),
        optical_flow=quad_gym.OpticalFlowParams(rate=50.0),
    )
    env = QuadVectorEnv(4, "hover", observation="measurements", sensors=suite)
    env.reset(seed=2)
    for _ in range(3):
        observation, *_ = env.step(np.zeros((4, 4)))
    seen = parts_of(observation, observation="measurements", sensors=suite)
    batch = env.flights.batch
    for name in ("barometer", "magnetometer", "optical_flow"):
        values = batch.read(name).reshape(4, -1)
        assert seen[f"{name}_valid"].all()
        assert np.isfinite(values).all()
        close(seen[name], values / getattr(suite, name).scale)


def test_slow_controller_receives_every_fix_since_its_last_step():
    suite = quad_gym.sensor_suite("standard").with_rates(gnss=25.0)
    env = vec_env(count=2, seed=1, observation="measurements", control_rate=10, sensors=suite)
    for _ in range(5):
        seen = parts_of(env.step(np.zeros((2, 4)))[0], observation="measurements")
        assert seen["gnss_position_valid"].all()


@pytest.mark.parametrize("suite", ["lab", "rtk"])  # instant samples; averages with vibration
def test_imu_means_are_over_samples_since_the_last_step(suite):
    given = {"observation": "measurements", "action": "motor", "sensors": suite, "start": "hover"}
    slow = QuadVectorEnv(3, "circle", **given)
    fast = QuadVectorEnv(3, "circle", **given, control_rate=200)  # shows every sample
    observation, _ = slow.reset(seed=4)
    fast.reset(seed=4)
    seen = parts_of(observation, observation="measurements", sensors=suite)
    np.testing.assert_array_equal(seen["gyro_mean"], seen["gyro"])
    np.testing.assert_array_equal(seen["accel_mean"], seen["accel"])
    for k in range(5):
        actions = 0.2 * np.stack([actions_of(i, 5)[k] for i in range(3)])
        seen = parts_of(slow.step(actions)[0], observation="measurements", sensors=suite)
        each = [
            parts_of(fast.step(actions)[0], observation="measurements", sensors=suite)
            for _ in range(4)
        ]
        for name in ("gyro", "accel"):
            np.testing.assert_array_equal(seen[name], each[-1][name])
            mean = np.mean([sample[name] for sample in each], axis=0)
            np.testing.assert_allclose(seen[f"{name}_mean"], mean, rtol=1e-5, atol=1e-6)


def test_new_episode_has_no_samples_of_the_last_one():
    env = QuadVectorEnv(
        2, "hover", observation="measurements", duration=0.04, autoreset_mode="SameStep"
    )
    env.reset(seed=1)
    env.step(np.ones((2, 4)))
    observation, _, _, truncated, info = env.step(np.ones((2, 4)))
    assert truncated.all()
    first = parts_of(observation, observation="measurements")
    np.testing.assert_array_equal(first["gyro_mean"], first["gyro"])
    last = parts_of(np.stack(info["final_obs"]), observation="measurements")
    assert (last["gyro_mean"] != last["gyro"]).all()


def test_observed_measurements_equal_records_of_sensors():
    env, observation, _ = flown(start="hover", observation="measurements", sensors="lab")
    seen, batch = parts_of(observation, observation="measurements"), env.flights.batch
    suite = quad_gym.sensor_suite("lab")
    R_IG = east_north_up(suite.gnss.reference_antenna_G)
    close(seen["gnss_position"], batch.record("gnss_position") @ R_IG.T, 4)
    close(seen["gnss_baseline"], unit(batch.record("gnss_baseline") @ R_IG.T))
    close(seen["gyro"], batch.record("gyro"), 10)
    close(seen["accel"], batch.record("accel"), 10)
    valid = batch.record("block_valid")[:, FEATURE_SLICE] > 0.0
    assert valid.any()
    for k in range(len(suite.camera.features_I)):
        shown = seen[f"feature_{k}"] * np.array(suite.camera.image_size) / 2
        expected = np.where(valid[:, k : k + 1], batch.record("pixels")[:, k], 0.0)
        np.testing.assert_allclose(shown, expected, rtol=1e-5, atol=1e-3)
        np.testing.assert_array_equal(seen[f"feature_{k}_valid"][:, 0], valid[:, k])


def test_noisy_observations_have_the_stated_noise_and_no_memory():
    n = 3000
    env = vec_env("circle", n, seed=4, observation="noisy", layout="absolute", **UNBOUNDED)
    batch, sigma = env.flights.batch, quad_gym.sensor_suite("standard").noisy
    seconds = []
    for _ in range(2):
        seen = parts_of(env.step(np.zeros((n, 4)))[0], layout="absolute")
        R = body_axes(batch.record("q"))
        E = seen["R_BI"].reshape(-1, 3, 3) @ R.transpose(0, 2, 1)
        turn = np.stack([E[:, 1, 2] - E[:, 2, 1], E[:, 2, 0] - E[:, 0, 2], E[:, 0, 1] - E[:, 1, 0]])
        errors = {
            "position": seen["position"] - batch.record("r"),
            "velocity": seen["velocity"] - batch.record("v"),
            "attitude": 0.5 * turn.T,
            "body_rates": seen["body_rates"] - batch.record("w"),
        }
        for name, error in errors.items():
            stated = getattr(sigma, name)
            np.testing.assert_allclose(error.std(axis=0), stated, rtol=0.06, err_msg=name)
            assert (abs(error.mean(axis=0)) < 5 * stated / np.sqrt(n)).all()
        seconds.append(np.hstack(list(errors.values())))
        assert not seen["accel_bias"].any()
    both = np.corrcoef(np.hstack(seconds), rowvar=False) - np.eye(24)
    assert abs(both).max() < 6 / np.sqrt(n)


def test_observations_are_held_within_their_bounds():
    env = QuadVectorEnv(2, "hover", observation="truth", out_of_bounds=1e4)
    observation, _ = env.reset(
        seed=1, options={"position": [5e3, 0, -5e3], "velocity": [0, 1e4, 0]}
    )
    assert observation in env.observation_space
    assert abs(observation).max() == 100.0


def nearly_all_draws():
    """Return distributions of parameters that can be drawn together without a battery."""
    left_out = ("wind_speed", "wind_direction", "battery_charge", "battery_resistance")
    absolute = ("wind_", "start_", "feature", "camera_", "lever_arm", "center_of", "gust_")
    draws = {}
    for name in COLUMNS:
        if name in left_out:
            continue
        if name.startswith(absolute) or name.endswith(("drag_B", "action_delay")):
            draws[name] = quad_gym.Uniform(0.0, 0.01)
        else:
            draws[name] = quad_gym.Uniform(0.99, 1.01, relative=True)
    return draws


def test_the_longest_observation_fits_and_ends_with_the_draws():
    """The parts are measurements with 16 features, standard deviations, truth and draws."""
    suite = quad_gym.sensor_suite("rtk")
    features = tuple((2.0 + 0.1 * i, 0.2 * i, 1.0) for i in range(16))
    suite = suite.replace(
        camera=suite.camera.replace(features_I=features),
        barometer=quad_gym.BarometerParams(),
        magnetometer=quad_gym.MagnetometerParams(),
    )
    keywords = {"observation": "measurements", "include_std": True, "privileged": True}
    env, observation, actions = flown(
        steps=2, sensors=suite, randomization=nearly_all_draws(), **keywords
    )
    batch = env.flights.batch
    drawn = batch.randomization.names
    parts = parts_of(observation, sensors=suite, drawn=drawn, **keywords)
    assert sum(part.shape[1] for part in parts.values()) == 262
    values = batch.drawn()
    close(parts["last_action"], actions)
    offsets = values["feature_offsets_I"].reshape(6, -1)
    close(parts["drawn_feature_offsets_I"], (offsets - 0.005) / 0.005, 10.0)
    close(parts["drawn_wind_up"][:, 0], (values["wind_up"] - 0.005) / 0.005, 10.0)


def test_observation_with_all_parts_fits_in_maximum_length():
    suite = quad_gym.sensor_suite("rtk")
    aids = {name: kind() for name, kind in AID_PARAMS.items() if kind.most_blocks == 1}
    most = min(MAX_FEATURES, MAX_TOGETHER - FEATURE_BLOCKS - len(aids))
    camera = suite.camera.replace(features_I=((1.0, 0.0, 0.0),) * most)
    suite = suite.replace(camera=camera, **aids)
    shown = {"include_std": True, "privileged": True, "sensors": suite, "drawn": tuple(COLUMNS)}
    table = quad_gym.observation_layout("measurements", **shown)
    assert 256 < table[-1].slice.stop <= MAX_OBSERVATION
    longer = [*table, table[0]._replace(slice=slice(0, MAX_OBSERVATION + 1))]
    with pytest.raises(ValueError, match="an observation must have at most 512 numbers, got 513"):
        layout_bounds(tuple(longer))
