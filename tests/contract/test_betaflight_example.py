"""Betaflight's firmware as the rate loop of a policy."""

import math

import gymnasium
import numpy as np
import pytest

from baselines.policies import load_policy
from docs.examples.betaflight import BehindBetaflight, firmware, firmware_settings, flights_behind
from docs.examples.betaflight.rate_loop import Motors
from quad_gym.evaluation import roll_out
from quad_gym.params.vehicle import ActionParams, vehicle_params

needs_firmware = pytest.mark.skipif(
    not firmware.is_built(),
    reason="Betaflight's firmware is not built; python -m docs.examples.betaflight builds it",
)
LAB = vehicle_params("lab")


def flights(count=1, **keywords):
    """Return an environment with action "ctbr" and its counterpart behind Betaflight."""
    env = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=count, threads=1, **keywords)
    return env, flights_behind(env, keywords, threads=1)


def test_settings_give_the_torque_of_the_built_in_loop():
    lines = dict(
        line.split(" = ") for line in firmware_settings(LAB, ActionParams()) if "=" in line
    )
    limit = int(lines["set motor_output_limit"]) / 100.0
    hover = math.sqrt(LAB.mass * LAB.gravity / 4.0 / LAB.max_rotor_force)
    for row, axis in enumerate(("roll", "pitch", "yaw"), 1):
        u = hover + 1e-6 * np.sign(LAB.effectiveness[row])  # all rotors turn the body the same way
        torque_per_u = LAB.effectiveness[row] @ (LAB.max_rotor_force * u**2) / 1e-6
        per_p = 0.032029 * math.degrees(1.0) / 1000.0 * 0.99 * limit * torque_per_u
        wanted = LAB.inertia[row - 1][row - 1] * ActionParams().rate_bandwidth
        assert int(lines[f"set p_{axis}"]) == round(wanted / per_p)
        assert lines[f"set {axis}_rc_rate"] == lines[f"set {axis}_srate"]  # no expo


def test_throttle_and_motor_actions_invert_each_other_at_hover():
    motors = Motors(LAB)
    command = 0.01 + motors.range * motors.throttle(np.ones(1))  # idle plus the throttle's share
    np.testing.assert_allclose(motors.actions(np.full((1, 4), command)), 0.0, atol=1e-12)
    assert motors.order == [3, 0, 2, 1]  # rear right, front right, rear left, front left
    assert not motors.reversed
    turned = LAB.replace(rotor_spins=(-1.0, 1.0, -1.0, 1.0))
    assert Motors(turned).reversed


def test_vehicles_without_an_x_of_rotors_are_refused():
    arms = ((0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (-0.3, 0.0, 0.0), (0.0, -0.3, 0.0))
    with pytest.raises(ValueError, match="rotors in an X, one in each quadrant, for Betaflight"):
        Motors(LAB.replace(rotor_positions_B=arms))


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"action": "attitude"}, "action must be ctbr behind Betaflight, got 'attitude'"),
        ({"observation": "measurements"}, "observation must be truth or estimate or noisy"),
        ({"action_delay": 1.0}, "action_delay must be 0.0 behind Betaflight, got 1.0"),
    ],
)
def test_environments_that_betaflight_cannot_fly_are_refused(keywords, message):
    with pytest.raises(ValueError, match=message):
        flights(**keywords)


def test_missing_make_or_too_many_episodes_are_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(firmware.shutil, "which", lambda name: None if name == "make" else name)
    env, flown = flights(2)
    policy = load_policy("pd", env)
    with pytest.raises(RuntimeError, match="Betaflight's firmware cannot be built without make"):
        BehindBetaflight(policy, env, flown)
    with pytest.raises(ValueError, match="episodes must be at most 200 behind Betaflight"):
        flights(1000)


class _Step:
    def predict(self, observation, **_):
        action = np.zeros((len(observation), 4))
        action[:, 1] = 0.25
        return action, None


@needs_firmware
def test_roll_rate_follows_a_step_as_with_the_built_in_loop():
    keywords = {"observation": "truth", "control_rate": 200.0, "start": "hover"}
    env, flown = flights(**keywords)
    found = []
    for policy, place in ((_Step(), env), (BehindBetaflight(_Step(), env, flown), flown)):
        observation, _ = place.reset(seed=0)
        for _ in range(60):
            observation, *_ = place.step(policy.predict(observation)[0])
            found.append(place.unwrapped.flights.batch.read("body_rates")[0, 0])
    built_in, betaflight = np.reshape(found, (2, 60))
    assert built_in[-1] > 1.4
    assert np.abs(betaflight - built_in).max() < 0.05 * 1.5


@needs_firmware
def test_flights_repeat_bitwise_and_track_the_circle_as_with_the_built_in_loop():
    env, flown = flights(3, observation="estimate")
    policy = load_policy("pretrained", env)
    behind = BehindBetaflight(policy, env, flown)
    first, again = (roll_out(behind, flown, seed=0) for _ in range(2))
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not first.crashed.any()
    built_in = roll_out(policy, env, seed=0)
    np.testing.assert_allclose(first.mean_error, built_in.mean_error, rtol=0.2)
