"""A policy of thrust and body rates ("ctbr") behind Betaflight, which commands the motors."""

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from docs.examples.betaflight.firmware import Firmware, configured
from quad_gym.evaluation import Policy
from quad_gym.params.vehicle import ActionParams, VehicleParams

_P_SCALE, _MIXER_SCALE = 0.032029, 1000.0
"""Betaflight's units: sum per P and deg/s, and sum that is all of a motor's range (PTERM_SCALE,
PID_MIXER_SCALING)."""

_IDLE = 0.01  # of the motors' range

_ALL = """
set pid_process_denom = 8
set gyro_calib_duration = 50
set gyro_lpf1_dyn_min_hz = 0
set gyro_lpf1_static_hz = 0
set gyro_lpf2_static_hz = 0
set small_angle = 180
set pwr_on_arm_grace = 0
set runaway_takeoff_prevention = OFF
set yaw_spin_recovery = OFF
aux 0 0 0 1700 2100 0 0
profile 0
set simplified_pids_mode = OFF
set tpa_rate = 0
set throttle_boost = 0
set anti_gravity_gain = 0
set yaw_lowpass_hz = 0
rateprofile 0
set rates_type = ACTUAL
set rc_smoothing = OFF
"""
"""PID loop at 1 kHz on a gyro at 8 kHz; linear sticks; no filters and no adaptation of gains, which
would differ from the built-in loop; arming at any attitude, by a switch."""


class Motors:
    """Motors of Betaflight and of a vehicle with rotors in an X.

    Raises:
        ValueError: If the rotors do not form an X with neighbors that turn in opposite senses.
    """

    def __init__(self, vehicle: VehicleParams) -> None:
        x, y, _ = np.array(vehicle.rotor_positions_B).T
        places = [(-1, -1), (1, -1), (-1, 1), (1, 1)]  # rear right, front right, rear left, ...
        found = {(np.sign(a), np.sign(b)): i for i, (a, b) in enumerate(zip(x, y, strict=True))}
        if set(found) != set(places):
            raise ValueError(
                "vehicle must have rotors in an X, one in each quadrant, for Betaflight, got "
                f"rotor_positions_B {vehicle.rotor_positions_B}"
            )
        self.order = [found[place] for place in places]
        spins = np.array(vehicle.rotor_spins)[self.order]
        if abs(spins @ [-1, 1, 1, -1]) != 4.0:
            raise ValueError(
                "vehicle must have neighboring rotors with opposite rotor_spins for Betaflight, "
                f"got {vehicle.rotor_spins}"
            )
        self.reversed = bool(spins[0] > 0.0)
        self.hover = vehicle.hover_voltage / vehicle.max_voltage
        # actions command at most twice the voltage of hovering
        self.limit = min(100, math.ceil(200.0 * self.hover))
        self.range = (1.0 - _IDLE) * self.limit / 100.0
        arm, twist = (
            np.abs([y, x]).sum(axis=1),
            vehicle.torque_coefficient / vehicle.thrust_coefficient,
        )
        slope = 2.0 * self.hover * vehicle.max_rotor_force  # dF/du = 2 u Fmax
        self.torques = self.range * slope * np.array([*arm, 4.0 * twist])

    def throttle(self, thrust: NDArray[Any]) -> NDArray[Any]:
        """Throttle in [0, 1] for a thrust [weights], as the square of the voltage gives it."""
        u = self.hover * np.sqrt(np.maximum(thrust, 0.0))
        return np.asarray(np.clip((u - _IDLE) / self.range, 0.0, 1.0))

    def actions(self, commands: NDArray[Any]) -> NDArray[Any]:
        """Actions (n, 4) of the environment, "motor", from motor commands (n, 4) in [0, 1]."""
        voltages = np.empty_like(commands)
        voltages[:, self.order] = commands / self.hover
        return np.clip(voltages - 1.0, -1.0, 1.0)


def firmware_settings(vehicle: VehicleParams, actions: ActionParams) -> list[str]:
    """Return the lines of Betaflight's command line for a vehicle.

    The rates have no expo: the largest body rate is that at full stick. P corresponds to the
    built-in loop, `J k_w (w* - w)`, at hover.
    """
    motors = Motors(vehicle)
    lines = _ALL.strip().splitlines()
    p = np.diag(np.array(vehicle.inertia)) * actions.rate_bandwidth / motors.torques
    p *= _MIXER_SCALE / math.degrees(1.0) / _P_SCALE
    for axis, gain, rate in zip(("roll", "pitch", "yaw"), p, actions.rate_scale, strict=True):
        full = stick_range(rate)
        lines += [f"set {axis}_{name} = {full // 10}" for name in ("rc_rate", "srate")]
        numbers = {"p": max(1, round(gain)), "i": 0, "d": 0, "d_max": 0, "f": 0}
        lines += [f"set {name}_{axis} = {value}" for name, value in numbers.items()]
    lines += [
        f"set motor_idle = {round(10_000 * _IDLE)}",
        f"set motor_output_limit = {motors.limit}",
        f"set yaw_motors_reversed = {'ON' if motors.reversed else 'OFF'}",
    ]
    return lines


def stick_range(rate: float) -> int:
    """Body rate at full stick: the next multiple of ten above the largest action [deg/s]."""
    return 10 * math.ceil(math.degrees(rate) / 10.0)


MAX_FLIGHTS = 200  # processes of the firmware


def flights_behind(commanded: Any, keywords: Mapping[str, Any], threads: int | None = None) -> Any:
    """Make the environment in which policies of another one fly behind Betaflight.

    Args:
        commanded: Vector environment with action "ctbr".
        keywords: Its keywords.
        threads: Number of threads.

    Raises:
        ValueError: If the environment has another action, another observation than a state, or a
            keyword that Betaflight does not support.
    """
    flights, count = commanded.unwrapped.flights, commanded.num_envs
    if count > MAX_FLIGHTS:
        raise ValueError(
            f"episodes must be at most {MAX_FLIGHTS} behind Betaflight, each has a process, "
            f"got {count}"
        )
    for name, found, expected in (
        ("action", flights.action, ("ctbr",)),
        ("observation", flights.observation, ("truth", "estimate", "noisy")),
        ("action_delay", keywords.get("action_delay", 0.0), (0.0,)),
        ("privileged", keywords.get("privileged", False), (False,)),
    ):
        if found not in expected:
            raise ValueError(
                f"{name} must be {' or '.join(map(str, expected))} behind Betaflight, got {found!r}"
            )
    missing = {"body_rates", "last_action"} - {field.name for field in flights.table}
    if missing:
        raise ValueError(
            f"observation must contain {min(missing)} behind Betaflight: the task replaces it"
        )
    given = {name: value for name, value in keywords.items() if name != "action_params"}
    rate = flights.batch.clocks.imu_rate
    given |= {"action": "motor", "control_rate": rate}
    if (steps := given.get("max_episode_steps")) is not None:
        given["max_episode_steps"] = round(steps * rate / flights.control_rate)
    return gymnasium.make_vec(commanded.spec.id, num_envs=count, threads=threads, **given)


class BehindBetaflight:
    """A policy for "ctbr" as a policy for "motor": Betaflight tracks its thrust and body rates.

    The firmware receives the observed body rates, as the built-in loop does, and the policy's
    actions as positions of sticks. Every flight has a process, in lockstep with the simulation.

    Args:
        policy: Policy that acts on observations of `commanded`.
        commanded: Environment with action "ctbr" for which the policy was made.
        flown: Environment of `flights_behind`, in which it flies.

    Raises:
        ValueError: If the vehicle's rotors do not fit.
        RuntimeError: If the firmware cannot be built.
    """

    def __init__(self, policy: Policy, commanded: Any, flown: Any) -> None:
        self._flights: list[Firmware] = []
        inner, outer = flown.unwrapped.flights, commanded.unwrapped.flights
        vehicle, scales = outer.batch.vehicle, outer.batch.action_params
        self._policy, self._motors = policy, Motors(vehicle)
        self._settings = configured(firmware_settings(vehicle, scales))
        self._ratio = round(inner.control_rate / outer.control_rate)
        self._period = 1.0 / inner.control_rate
        slices = {field.name: field.slice for field in inner.table}
        self._rates, self._last = slices["body_rates"], slices["last_action"]
        full = np.radians([stick_range(rate) for rate in scales.rate_scale])
        self._sticks = np.array(scales.rate_scale) / full
        self._step = 0
        self._action = np.zeros((0, 4))
        self._state: Any = None

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Return motor actions (n, 4); all flights begin their episodes together."""
        starts = np.zeros(len(observation), bool) if episode_start is None else episode_start
        if len(self._flights) != len(observation) or starts.any():
            self._begin(len(observation))
        if self._step % self._ratio == 0:
            seen = np.array(observation)
            seen[:, self._last] = self._action
            begins = np.full(len(seen), self._step == 0)
            self._action, self._state = self._policy.predict(
                seen, state=self._state, episode_start=begins, deterministic=deterministic
            )
        self._step += 1
        sticks = self._sticks * self._action[:, 1:]
        throttle = self._motors.throttle(1.0 + self._action[:, 0])
        for i, flight in enumerate(self._flights):
            flight.send(self._period, observation[i, self._rates], sticks[i], throttle[i])
        return self._motors.actions(np.array([flight.motors() for flight in self._flights])), None

    def _begin(self, count: int) -> None:
        """Start the firmware of every flight, hovering."""
        self.close()
        self._flights = [Firmware(self._settings) for _ in range(count)]
        for flight in self._flights:
            flight.take_off(float(self._motors.throttle(np.ones(1))[0]))
        self._step, self._action, self._state = 0, np.zeros((count, 4)), None

    def close(self) -> None:
        """End the firmware's processes."""
        for flight in self._flights:
            flight.close()
        self._flights = []

    def __del__(self) -> None:
        self.close()
