"""`QuadEnv`: one flight as a Gymnasium environment."""

from typing import TYPE_CHECKING, Any, Unpack

import gymnasium
import numpy as np

from quad_gym.batch.starts import stream_key
from quad_gym.envs.config import Base, EnvConfig, EnvKeywords, shows
from quad_gym.envs.flights import (
    RENDERING_METADATA,
    Flights,
    Rendered,
    checked_actions,
    drawn_info,
    flight_info,
    info_of_flight,
    start_info,
)
from quad_gym.envs.spaces import action_space
from quad_gym.params import checks as check
from quad_gym.records import Autoreset, Result

if TYPE_CHECKING:
    from quad_gym.tasks import Task


class QuadEnv(Rendered, gymnasium.Env[Any, np.ndarray]):
    """A quadrotor that is controlled on estimated state.

    ## Description
    A quadrotor (0.78 kg, four rotors with a time constant of 0.05 s) flies a reference. By default,
    GNSS, camera and IMU measure at 200 Hz, an unscented Kalman filter fuses the measurements, and
    the controller observes the filter's estimate; `observation` selects other sources. Reward,
    endings and `info` use the true state.

    | id | reference | start | time limit |
    |---|---|---|---|
    | `QuadGym/Hover-v0` | a point 4 m from the origin, 1 m high, looking at the origin | hovering near it | 10 s |
    | `QuadGym/Circle-v0` | the circle of the laboratory report: radius 4 m, period 10 s, height 1 m, looking at the center | on a launch pad below it, rotors stopped, or hovering (`start="mixed"`) | 10 s |
    | `QuadGym/Lemniscate-v0` | a figure of eight, 6 m by 3 m, period 10 s, looking ahead | hovering near it | 10 s |
    | `QuadGym/RandomTrajectory-v0` | smooth, new in each episode; speed <= 2.5 m/s, acceleration <= 3 m/s^2 | hovering near it | 10 s |
    | `QuadGym/Waypoints-v0` | five gates in order, at random within 3.5 m of the origin, looking east (`randomize_reference=True`: in any direction) | hovering near the origin | 20 s |
    | `QuadGym/Trajectory-v0` | your own, `trajectory=`: a `quad_gym.Trajectory` or several, of which each episode draws one; by default a closed figure of eight through five points, looking ahead | hovering near its start | its duration, or one round; by default 10 s |
    | `QuadGym/LookAround-v0` | as in `RandomTrajectory`; no GNSS, markers on one wall, looking at them costs reward | hovering near it | 15 s |
    | `QuadGym/StaleRace-v0` | eight gates with a radius of 0.6 m; measurements arrive late, and the filter ignores their time stamps | hovering near the origin | 20 s |
    | `QuadGym/OutageDash-v0` | a course of ten gaps between walls, from east to west, with velocity commands; GNSS fails again and again, for 5 to 15 s | hovering before the first wall | 90 s |

    The classes of the last three specify their observation and reward:
    `quad_gym.tasks.look_around.LookAround`, `stale_race.StaleRace` and `outage_dash.OutageDash`.

    ## Observation space
    A `Box` of float32. With `observation="estimate"`, `"truth"` or `"noisy"` and
    `layout="relative"`:

    | slice | name | meaning | unit | frame |
    |---|---|---|---|---|
    | 0:3 | position_error | reference minus position | m | B |
    | 3:6 | velocity_error | reference minus velocity | m/s | B |
    | 6:9 | up | vertical direction, upward | - | B |
    | 9:12 | heading | desired horizontal direction of body x | - | B |
    | 12:15 | body_rates | angular rate | rad/s | B |
    | 15:18 | reference_acceleration | acceleration of the reference | m/s^2 | B |
    | 18:21 | preview_1 | reference in 0.2 s (on a course: the gate after the next) minus the present one | m | B |
    | 21:24 | preview_2 | reference in 0.4 s (on a course: the gate after that) minus the present one | m | B |
    | 24:28 | last_action | previous action, as commanded | - | - |

    The body frame is the one with the observed attitude. `layout="absolute"` gives position,
    velocity, rotation matrix, biases and reference in the inertial frame.
    `observation="measurements"` has its own layout: the raw measurements of the step with flags (a
    measurement that was not taken is zero, and so is its flag), and from the IMU the last sample
    and the mean over the step. `quad_gym.observation_layout(...)` returns each of these tables, and
    the bounds to which observations are clipped.

    ## Action space
    `Box(-1, 1, (4,))`; larger values are clipped. The scales refer to the nominal vehicle. The
    inner loops run at every tick (200 Hz) on the observed state and the gyro.

    | `action` | a[0] | a[1], a[2], a[3] |
    |---|---|---|
    | `"ctbr"` (default of most tasks) | thrust m g (1 + a) | body rates 6, 6, 3 rad/s |
    | `"motor"` | each: voltage = hover voltage (1 + a), at most 12 V | |
    | `"wrench"` | thrust m g (1 + a) | torque 1.6, 1.6, 0.19 N m |
    | `"attitude"` | thrust m g (1 + a) | roll, pitch 45 deg, yaw rate 3 rad/s |
    | `"velocity"` | velocity ahead 5 m/s | to the left, up 5 m/s; yaw rate 3 rad/s |

    ## Reward
    In each step, with the position error e [m], the alignment h of body x with the desired heading
    (1: aligned), the change of the action da and the body rates w:

        exp(-2 e) + 0.5 exp(-20 e) + 0.1 h - 0.02 |da|^2 - 0.002 |w|^2

    `reward_params` sets these weights and decays, see `quad_gym.RewardParams`. The maximum is 1.6,
    so 500 steps of a perfect circle return 800; an action that jumps from corner to corner costs
    0.32. In `Waypoints`, progress replaces the two exponentials: the speed toward the next gate
    [m/s], and 1 s^-1 times the control rate (50) for each gate passed. `reward_per="second"`
    multiplies all rewards by the control period, so that returns do not depend on the control rate:
    16 for a perfect circle.

    ## Episode end
    Terminated: farther than 3 m from the reference (`Hover`: 1.6 m, `LookAround`: 8 m, `Waypoints`
    and `StaleRace`: 12 m, `OutageDash`: 300 m), tilted by more than 100 degrees, below -0.5 m
    (`LookAround`: -5 m, `OutageDash`: 0 m), when the last gate is passed, or, in worlds that have
    them, when the vehicle touches an obstacle or leaves the geofence. Truncated: at the time limit,
    when the filter has failed numerically (`info["filter_status"]`), or, with
    `truncate_when_diverged=True`, when its consistency monitor flags divergence. A step can do
    both, as with Gymnasium's `TimeLimit`. `info["ending"]` is the reason, the termination if both:
    the number of a `quad_gym.Ending`. A `TimeLimit`, which `gymnasium.make(..., max_episode_steps=)`
    adds, truncates from outside, with an `ending` of 0.

    ## Start
    "ground": at rest at height 0 below the start of the reference, rotors stopped, level, with the
    desired heading. A launch pad supports the vehicle until its thrust lifts it; with `pad=False`,
    as in the report, it sinks while its rotors spin up. "hover": hovering, with standard deviations
    of 0.3 m, 0.03 m/s, 0.2 rad in yaw and 0.03 rad in tilt. "mixed": one of these two, each with
    probability 0.5; the hovering starts make take-off easier to learn. "moving": as "hover", with
    uniformly drawn velocities of up to 1.5 m/s and body rates of up to 2 rad/s on each axis. The
    filter always starts from its first fix, or, with `filter_start="warm"`, as if it had been
    running for 10 s, as before any real take-off. `reset(options=...)` sets the "position" (3,),
    the "velocity" (3,) or the "yaw" [rad] for one episode.

    ## Info
    `position_error` and `estimation_error` [m], the distances of the true position from the
    reference and from the observed position; `ending`; `filter_status`, 0 without numerical
    failures; `filter_diverged`, True if the filter's covariance does not explain its innovations,
    which is monitored in filters with an innovation gate, and in any filter with `faults`,
    `truncate_when_diverged` or `innovations`; `gates_passed`. With `randomization` also `drawn`,
    the parameters of the episode by name. With `faults` also `faults`, True for each that is active
    at present, by name. With `innovations=True` also `innovations`: the filter's last innovations,
    their NIS and the decisions of its gate, see `quad_gym.envs.flights.innovations_of`. With
    `reward_terms=True` also `reward_terms` in every step: the weighted terms of the reward by name,
    whose sum is the reward (of your own task, what its `reward` returns by name).

    ## World
    By default the air is still, and vehicle and sensors are the same in all episodes.
    `world="breeze"` or a `quad_gym.WorldParams` adds steady wind, Dryden gusts (MIL-F-8785C),
    linear rotor drag, ground effect and a battery, walls, cylinders and a geofence;
    `randomization={"mass": Uniform(0.8, 1.2, relative=True), "wind_speed": Uniform(0.0, 5.0)}`
    draws parameters in every episode (`quad_gym.params.randomization.DRAWABLES` lists them). Filter
    and controller model neither: they assume `vehicle` and `sensors` (with
    `Randomization(..., known=True)`, the true parameters, except for wind and ground). With
    `privileged=True`, the truth ends with the wind in the body frame and the draws, each minus the
    center of its distribution and divided by half of its range (normal: by its standard deviation).

    Args:
        task: Your task: a `quad_gym.Task`, its class, or "module:name" of either. It is laid over
            the id's task (also over the class of `LookAround`, `StaleRace` or `OutageDash`, and
            over a task of `register_task`), whose other methods stay. A class
            derived from the id's takes its place. Without an id, also the name of a kind of task,
            such as "hover".
        base: Kind of task under your own, or a pair of it and a task; `gymnasium.make` sets it from
            the id. None: the circle.
        observation: "estimate", "truth", "noisy" (truth plus independent noise, as large as the
            errors of the converged filter), or "measurements".
        action: "ctbr", "motor", "wrench", "attitude" or "velocity"; by default "velocity" on
            `OutageDash`, "ctbr" elsewhere.
        layout: "relative" or "absolute".
        include_std: Append the standard deviations of the filter's covariance.
        privileged: Return a Dict of "policy" and "privileged" (the truth), for asymmetric critics.
        sensors: "standard" (the laboratory's sensors, a consistent filter), "lab" (exactly the
            report's form, with an overconfident filter), "rtk", "consumer", "indoor", a suite for
            one task (`quad_gym.params.suites`), a ".toml" file, or a `SensorSuite`; by default
            "one_wall" on `LookAround`, "stale" on `StaleRace`, "consumer" on `OutageDash`.
        run_filter: True: sensors and filter run although the controller observes the truth, with or
            without noise, so that a task can use the estimate: a reward for certainty
            (`quad_gym.tasks.rewards.Uncertainty`), or an observation with standard deviations of
            its choice. None: they run if another keyword needs them.
        innovations: Add the filter's innovations to `info` and `flights.batch.record`, block by
            block; the latter always has them with a gate, `faults` or `truncate_when_diverged`.
        reward_terms: Add the terms of the reward to `info`.
        vehicle: Name of a preset, or `VehicleParams`.
        action_params: Scales of the actions, and bandwidths of the inner loops.
        camera: False: leave out the camera of the sensors.
        estimator: "ukf" or "ekf", in place of the estimator of the sensors, or your own: a
            `quad_gym.Estimator`, its class, or "module:Class".
        filter_start: "cold": the filter starts from its first fix, or without GNSS from the marked
            spot of `quad_gym.InitialPoseParams`; "warm": it has been running for 10 s before the
            episode, and has converged.
        control_rate: Actions per second, by default 10 on `OutageDash`, 50 elsewhere; must divide
            the IMU rate [Hz].
        action_delay: Delay from the command of an action to its execution, in control steps
            (rounded to ticks), at most 10; 0 by default. Until the first action arrives, the vehicle executes
            zeros, which hover. `last_action` in the observation is the commanded action.
        substeps: Runge-Kutta steps per tick.
        max_episode_steps: Time limit in steps, in place of the task's own, whether longer or
            shorter; with a `duration` as well, the earlier of the two holds. `gymnasium.make` keeps
            this argument for its `TimeLimit`, which can only shorten episodes: there, `duration`
            sets a longer limit.
        true_vehicle: True parameters of the vehicle; the controller assumes `vehicle`.
        true_sensors: True parameters of the sensors; the filter assumes `sensors`.
        world: "calm", "breeze", "fresh_breeze", "slalom" (of `OutageDash`), a file (.toml), or
            `WorldParams`.
        randomization: Parameters drawn in every episode: distributions by name, or `Randomization`.
        faults: Faults of sensors and rotors, see `quad_gym.faults`: names of presets, such as
            "gnss_outage" or "gnss_outliers+rotor_loss", or instances.
        keywords: Keywords of the task: radius, period, height, start, pad, reward_per,
            reward_params, randomize_reference, duration, out_of_bounds, min_height, truncate_when_diverged,
            max_tilt, max_speed, max_acceleration, gate_count, gate_radius, preview, trajectory; see
            `quad_gym.TaskParams`.
        render_mode: "human" (a window), "rgb_array", "rgb_array_list", or None.
        render_view: "fixed" shows the whole reference from outside, "chase" follows the vehicle.
        render_size: Width and height of a frame [pixels].

    Raises:
        TypeError: If a keyword is unknown; the exception is also a ValueError.
        ValueError: If a keyword belongs to another task, or its value is invalid.

    ## Version history
    - v0: changes before the first release, with which Stable-Baselines3's default settings learn
      `Circle`, and its SAC `Hover`: rewards of order one per step (before: `reward_per="second"`),
      a launch pad (`pad=False`), hovering starts in half of the episodes of `Circle`
      (`start="ground"`), episodes of `Hover` that end 1.6 m from the point (`out_of_bounds=3.0`).
    """

    metadata: dict[str, Any] = RENDERING_METADATA

    @shows(EnvKeywords)
    def __init__(
        self,
        task: "Task | type[Task] | str | None" = None,
        *,
        base: "Base | None" = None,
        render_mode: str | None = None,
        **keywords: Unpack[EnvKeywords],
    ) -> None:
        config = EnvConfig.of(keywords, task, base, ("render_mode",))
        self._open(Flights(config, 1, Autoreset.DISABLED, threads=1), render_mode)
        self.metadata = self.metadata | {"render_fps": round(self.flights.control_rate)}
        self.observation_space = self.flights.space
        self.action_space = action_space()
        self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of the flight's random stream; None: continue the present stream.
            options: Initial "position" (3,) [m] and "velocity" (3,) [m/s] in I, and "yaw" [rad],
                any of them.

        Returns:
            The observation and `info`.

        Raises:
            ValueError: If an option is unknown or invalid, or the seed is not an integer of at
                least 0; nothing has changed then.
        """
        start = self.flights.start(options)
        super().reset(seed=check.seed("seed", seed))
        batch = self.flights.batch
        if seed is not None or not self._begun:
            keys = stream_key(self.np_random)[np.newaxis]
            observations = batch.reset(keys=keys, **start)
        else:
            observations = batch.reset(**start)
        self._over = False
        if self.rendering is not None:
            self.rendering.observe(reset=True)
        return self.flights.split(observations[0]), info_of_flight(start_info(batch), 0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Fly one control period.

        Args:
            action: (4,) in [-1, 1]; larger values are clipped.

        Returns:
            Observation, reward, terminated, truncated, `info`.

        Raises:
            ValueError: If the action has another shape or is not finite; nothing has been flown
                then.
            gymnasium.error.ResetNeeded: If the episode is over.
        """
        numbers = checked_actions(action, (4,))
        batch = self.flights.batch
        if not batch.begun:  # a snapshot may have been restored
            self._over = batch.record("needs_reset")[0] > 0.0
        if self._over:
            raise gymnasium.error.ResetNeeded(
                "call reset() before step(): no episode is in progress"
            )
        observations = batch.step(numbers)
        row = batch.results[0].tolist()
        terminated, truncated = row[Result.TERMINATED] > 0.0, row[Result.TRUNCATED] > 0.0
        self._over = terminated or truncated
        if self.rendering is not None:
            self.rendering.observe()
        info = {
            "position_error": row[Result.POSITION_ERROR],
            "estimation_error": row[Result.ESTIMATION_ERROR],
            "ending": int(row[Result.ENDING]),
            "filter_status": int(row[Result.FILTER_STATUS]),
            "filter_diverged": row[Result.FILTER_DIVERGED] > 0.0,
            "gates_passed": int(row[Result.GATES_PASSED]),
        }
        if batch.randomization.names:
            info |= info_of_flight(drawn_info(batch.drawn()), 0)
        if batch.faults or batch.innovations:
            info |= info_of_flight(flight_info(batch, batch.results[:, Result.FAULTS]), 0)
        if self.flights.reward_terms:
            info |= info_of_flight({"reward_terms": batch.reward_terms()}, 0)
        return self.flights.split(observations[0]), row[Result.REWARD], terminated, truncated, info

    def render(self) -> Any:
        """Return the output that `render_mode` selects.

        Returns:
            "rgb_array": a frame (height, width, 3) of uint8 of the present instant;
            "rgb_array_list": a list with a frame of every instant since the last call or reset;
            "human", where a window shows every step by itself, and None: None.

        Raises:
            gymnasium.error.ResetNeeded: Before the first reset.
        """
        rendering = self._open_rendering("make")
        if rendering is not None and self.render_mode == "rgb_array_list":
            return [frame for (frame,) in rendering.taken_frames()]
        return rendering.frames()[0] if rendering and self.render_mode == "rgb_array" else None
