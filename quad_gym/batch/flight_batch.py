"""`FlightBatch`: many flights of one configuration, flown together."""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.calls import Calls, address_of
from quad_gym.batch.cold_start import check_cold_start
from quad_gym.batch.effects import require_effect, require_no_filter
from quad_gym.batch.following import check_trajectories, followed
from quad_gym.batch.innovations import innovations_of
from quad_gym.batch.memory import FlightMemory, configuration_digest
from quad_gym.batch.standing import check_standing
from quad_gym.batch.starts import checked_keys, checked_mask, checked_start
from quad_gym.batch.threads import Crew, resolve_threads
from quad_gym.batch.warm_start import FILTER_STARTS, pack_warm_start
from quad_gym.faults.presets import FaultsGiven, faults_of
from quad_gym.kernels.compiling.linked import linked_table
from quad_gym.kernels.compiling.stages import needed_stages, used_parts
from quad_gym.packing.faults import pack_faults
from quad_gym.packing.flight import (
    pack_imperfections,
    pack_latency,
    params_block,
    params_record,
    settings_record,
)
from quad_gym.packing.paths import pack_paths
from quad_gym.packing.world import pack_options, pack_places
from quad_gym.params import checks as check
from quad_gym.params.clocks import Clocks
from quad_gym.params.control import ActionParams, PDGains, pd_gains
from quad_gym.params.draw_limits import check_draws
from quad_gym.params.randomization import DrawingTable, Given, Randomization
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.suites import sensor_suite
from quad_gym.params.task import TaskParams, check_limit
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.vehicle import VehicleParams, vehicle_params
from quad_gym.params.world import WorldParams, world_params
from quad_gym.records import (
    COLUMNS,
    FLIGHT_BLOCK,
    MAX_ACTION_DELAY,
    RESULTS,
    WIDTH,
    WORK_BLOCK,
    Autoreset,
    Call,
    Command,
    Control,
    Layout,
    Source,
    aligned_zeros,
    room_of,
    words_of_update,
)

MOST_FLIGHTS = 10**7
"""Largest number of flights in a batch."""
_GROUP_MEMORY = 1 << 22
"""Memory of the blocks that a thread flies side by side [bytes]: less leaves gathered blocks half
empty."""
_NO_BOUNDS = np.zeros(0)
_WORTH_NO_COPY = 1 << 16
"""Size of observations [bytes] above which each step allocates memory, instead of copying."""


class FlightBatch(FlightMemory):
    """N flights of one configuration, advanced together by compiled kernels.

    The record of a flight holds its complete state: `snapshot` and `restore` copy arrays, and a
    flight depends only on its seed and its actions, not on the size of the batch, its order or the
    number of threads.

    Args:
        count: Number of flights.
        vehicle: Vehicle, or the name of a preset.
        sensors: Sensor suite, or the name of a preset.
        gains: Gains of `Control.PD`, or the name of a preset; None: "lab".
        action_params: Scales of the actions, and bandwidths of the inner loops.
        task: Reference, start and termination.
        source: Source of the state that the controller observes.
        control: Meaning of an action; `Control.PD` flies without actions.
        control_rate: Actions per second; must divide the IMU rate [Hz].
        substeps: Runge-Kutta steps per tick.
        action_delay: Delay from the command of an action to its execution, rounded to whole ticks,
            at most MAX_ACTION_DELAY [control steps]. Before the first action arrives, the vehicle
            hovers.
        layout: Layout of the observations.
        include_std: True: append the filter's standard deviations to the observations.
        privileged: True: append the truth to the observations.
        bounds: (low, high) of the observations, each (n,); None: no observations.
        autoreset: Start of the next episode after one has ended.
        run_filter: True: sensors and filter run; None: they run if another argument needs them.
        filter_start: "cold": the filter starts from its first fix; "warm": it has converged in
            `quad_gym.batch.warm_start.WARM_UP` of hovering where the task begins, with errors drawn
            from the covariance that it has reached. See `quad_gym.batch.cold_start` for the bounds.
        innovations: True: keep innovations and NIS block by block, for `record`: "innovation",
            "innovation_sigma", "block_nis". Filters with an innovation gate, with `faults`, or with
            `truncate_when_diverged` in their task always keep them.
        threads: Number of threads; None: one per core.
        true_vehicle: True parameters of the vehicle, if they differ from `vehicle`, which the
            controller assumes.
        true_sensors: True parameters of the sensors, if they differ from `sensors`, which the
            filter assumes.
        world: Wind, gusts, drag, ground, battery, obstacles and geofence, or the name of a preset.
        randomization: Parameters drawn in every episode, relative to `true_vehicle`, `true_sensors`
            and `world`: a `Randomization`, or distributions by name.
        faults: Faults of sensors and rotors, or names of presets, see `quad_gym.faults`.

    Raises:
        ValueError: If an argument is invalid; nothing is allocated then.
    """

    def __init__(
        self,
        count: int,
        *,
        vehicle: VehicleParams | str = "lab",
        sensors: SensorSuite | str = "standard",
        gains: PDGains | str | None = None,
        action_params: ActionParams | None = None,
        task: TaskParams | None = None,
        source: Source = Source.ESTIMATE,
        control: Control = Control.PD,
        control_rate: float | None = None,
        substeps: int = 1,
        action_delay: float = 0.0,
        layout: Layout = Layout.RELATIVE,
        include_std: bool = False,
        privileged: bool = False,
        bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
        autoreset: Autoreset = Autoreset.DISABLED,
        run_filter: bool | None = None,
        filter_start: str = "cold",
        innovations: bool = False,
        threads: int | None = None,
        true_vehicle: VehicleParams | None = None,
        true_sensors: SensorSuite | None = None,
        world: WorldParams | str = "calm",
        randomization: Randomization | Mapping[str, Given] | None = None,
        faults: FaultsGiven = None,
    ) -> None:
        self.count = check.whole("count", count, most=MOST_FLIGHTS)
        self.vehicle = vehicle_params(vehicle) if isinstance(vehicle, str) else vehicle
        self.sensors = sensor_suite(sensors) if isinstance(sensors, str) else sensors
        self.gains = pd_gains(gains or "lab") if isinstance(gains, str | None) else gains
        self.action_params = ActionParams() if action_params is None else action_params
        self.task = TaskParams() if task is None else task
        self.world = world_params(world) if isinstance(world, str) else world
        self.randomization = Randomization.of(randomization)
        for name, value, kind in (
            ("vehicle", self.vehicle, VehicleParams),
            ("sensors", self.sensors, SensorSuite),
            ("gains", self.gains, PDGains),
            ("action_params", self.action_params, ActionParams),
            ("task", self.task, TaskParams),
            ("true_vehicle", self.vehicle if true_vehicle is None else true_vehicle, VehicleParams),
            ("true_sensors", self.sensors if true_sensors is None else true_sensors, SensorSuite),
            ("world", self.world, WorldParams),
        ):
            check.instance(name, value, kind)
        self.source, self.control = Source(source), Control(control)
        rate = self.sensors.imu.rate if control_rate is None else control_rate
        self.clocks = Clocks.of(self.sensors, rate, substeps)
        check_limit(self.task, self.clocks.imu_rate, "IMU rate")
        self.threads = resolve_threads(threads)
        true_vehicle = self.vehicle if true_vehicle is None else true_vehicle
        true_sensors = self.sensors if true_sensors is None else true_sensors
        self.sensors.require_like(true_sensors)
        self.faults = faults_of(faults, true_sensors)
        self.innovations = check.flag("innovations", innovations)
        self._begins_after_step = self.innovations and autoreset == Autoreset.SAME_STEP
        self.final_innovations: dict[str, NDArray[Any]] = {}
        check.flag("include_std", include_std)
        check.flag("privileged", privileged)
        check.choice("filter_start", filter_start, FILTER_STARTS)
        if run_filter is None:
            needed = include_std or innovations
            run_filter = needed or self.source in (Source.ESTIMATE, Source.MEASUREMENTS)
        self.run_filter = check.flag("run_filter", run_filter)
        given = {"gains": gains, "action_params": action_params}
        require_effect(self.control, {name for name in given if given[name] is not None})
        if not run_filter:
            require_no_filter(
                include_std=include_std,
                innovations=innovations,
                truncate_when_diverged=self.task.truncate_when_diverged,
                filter_start=filter_start,
            )
        watches = self.innovations or bool(self.faults) or self.task.truncate_when_diverged
        if run_filter:
            self.sensors.require_filter()

        self.action_delay = check.number(
            "action_delay", action_delay, least=0.0, most=float(MAX_ACTION_DELAY)
        )
        draws = DrawingTable(
            self.randomization, true_vehicle, true_sensors, self.world, self.action_delay
        )
        longest_delay = math.ceil(draws.high[COLUMNS["action_delay"]][0])
        if longest_delay > 0 and self.control is Control.PD:
            raise ValueError("action_delay needs actions: Control.PD flies without any")
        check_draws(draws, true_vehicle, self.world, self.clocks)
        if run_filter and filter_start == "cold":
            check_cold_start(self.sensors, draws)
        check_trajectories(self.task, self.vehicle, self.action_params, self.control)
        check_standing(self.task, true_vehicle, self.world, draws)
        model = params_record(self.vehicle, self.sensors, self.gains, self.action_params)
        true = params_record(true_vehicle, true_sensors, self.gains, self.action_params, self.world)
        true["action_delay"] = self.action_delay
        self._model, self._world = params_block(model), params_block(true)
        self._own = [self._world.copy() for _ in range(self.threads)]
        self._believed = [self._model.copy() for _ in range(self.threads)]
        self._settings = settings_record(
            self.task,
            self.clocks,
            self.sensors,
            source=self.source,
            control=self.control,
            layout=Layout(layout),
            include_std=include_std,
            privileged=privileged,
            # the kernels would begin an episode before anybody reads the last one's innovations
            autoreset=Autoreset.DISABLED if self._begins_after_step else Autoreset(autoreset),
            run_filter=run_filter,
            innovations=run_filter and watches,
            lever_drawn=self.randomization.known
            and bool({"lever_arm_B", "center_of_mass_B"} & set(self.randomization.names)),
            gnss_drifts=true_sensors.drifts,
        )
        pack_options(
            self._settings[0],
            self.world,
            draws,
            known=self.randomization.known,
            limited=true_vehicle.max_voltage < self.vehicle.max_voltage,
        )
        self._settings["action_delays"] = longest_delay
        self._paths = pack_paths(self.task.trajectories)
        self._settings["path_count"] = len(self._paths[0])
        pack_places(self._settings[0], draws, true_sensors, self.sensors)
        pack_faults(self._settings[0], self.faults, self.sensors.imu.dt)
        pack_latency(self._settings[0], true_sensors, self.clocks, self.sensors)
        pack_imperfections(self._settings[0], true_sensors)
        if run_filter and filter_start == "warm":
            pack_warm_start(
                self._settings[0],
                FlightBatch,
                true_sensors,
                vehicle=self.vehicle,
                sensors=self.sensors,
                task=self.task,
                substeps=substeps,
            )
        self._stages = needed_stages(self._settings[0])
        self._low, self._high = (_NO_BOUNDS, _NO_BOUNDS) if bounds is None else bounds
        configuration = configuration_digest(self._settings, model, true, *self._paths)
        used = used_parts(self._settings[0])
        self._allocate(room_of(used), draws.low, configuration)
        self._group = self._group_of_blocks()
        self._words, self._written = words_of_update(self._settings[0], used)
        self._gathered = [aligned_zeros(1, FLIGHT_BLOCK) for _ in range(self.threads)]
        for block in self._gathered:
            block["stamps"] = np.nan  # nothing arrives in the other slots
        self._work = [aligned_zeros(1, WORK_BLOCK) for _ in range(self.threads)]
        padded = len(self._blocks) * WIDTH
        self._actions = np.zeros((padded, 4))
        self._resets = np.zeros(self.count, np.uint8)
        self._observations = np.zeros((self.count, self._low.size), np.float32)
        self.final_observations = np.zeros((self.count, self._low.size), np.float32)
        self._results = np.zeros((len(RESULTS), padded + WIDTH))  # no rows 4 KiB apart
        self._crew: Crew | None = None

    def reset(
        self,
        *,
        seeds: Sequence[int | None] | None = None,
        keys: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        position: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        yaw: ArrayLike | None = None,
    ) -> NDArray[np.float32]:
        """Begin new episodes.

        Args:
            seeds: One seed per flight, used as Gymnasium uses an environment's; None for a flight:
                fresh entropy.
            keys: (count, 2) keys of the random streams, instead of seeds. Without either, the
                streams continue.
            mask: (count,) bool: the flights to reset; None: all of them.
            position: (3,) or (count, 3) initial position in I, instead of a drawn one [m].
            velocity: (3,) or (count, 3) initial velocity in I, instead of a drawn one [m/s].
            yaw: Scalar or (count,) initial yaw, instead of a drawn one [rad].

        Returns:
            (count, n_observation) float32 observations of all flights at the present instant.

        Raises:
            ValueError: If the arguments do not fit the number of flights; nothing has changed then.
        """
        chosen = checked_mask(self.count, mask)
        given = checked_start(self.count, position, velocity, yaw, self.task, self.world, chosen)
        words = checked_keys(self.count, seeds, keys)
        if words is not None:
            for flight in np.flatnonzero(chosen):
                block, lane = divmod(int(flight), WIDTH)
                self._blocks["key"][block, :, lane] = words[flight]
                self._blocks["instant"][block, lane] = 0
                self._blocks["episode"][block, lane] = 0.0
        self._resets[:] = chosen
        if given is None:
            return self._run(Command.RESET)
        lanes = np.full((len(self._blocks) * WIDTH, 7), np.nan)
        lanes[: self.count] = given
        self._blocks["start_given"] = lanes.reshape(-1, WIDTH, 7).transpose(0, 2, 1)
        observations = self._run(Command.RESET)
        self._blocks["start_given"] = np.nan
        return observations

    def step(self, actions: NDArray[Any] | None = None) -> NDArray[np.float32]:
        """Fly one control period.

        Args:
            actions: (count, 4) in [-1, 1], not checked here; None: keep the present actions.

        Returns:
            (count, n_observation) float32 observations; `results` holds the rest.

        Raises:
            ValueError: If a flight has never been reset; the exception is also a RuntimeError.
        """
        if not self._begun:
            self._require_begun()
        self._actions[: self.count] = self.record("action") if actions is None else actions
        observations = self._run(Command.STEP)
        if self._begins_after_step:
            over = self._flights_over()
            if over.any():
                self.final_observations[over] = observations[over]
                self._keep_innovations()
                self._resets[:] = over
                return self._run(Command.RESET)
        return observations

    def _flights_over(self) -> NDArray[np.bool_]:
        """(count,) which flights have ended their episode in the last step."""
        return np.asarray(self.result("terminated") + self.result("truncated") > 0.0)

    def _keep_innovations(self) -> None:
        """Keep the innovations of episodes that are over, before others begin in the same step."""
        if self.innovations:
            self.final_innovations = innovations_of(self)

    def _require_begun(self) -> None:
        """Refuse to step flights that have no state; checked until all flights have one."""
        waiting = (self._blocks["episode"] == 0.0) & (self._blocks["idle"] == 0.0)
        if waiting.any():
            raise check.NotResetError(
                f"call reset() before step(): {int(waiting.sum())} of {self.count} flights have "
                "never been reset"
            )
        self._begun = True

    def _run(self, command: Command) -> NDArray[np.float32]:
        if self._crew is None or self._crew.process != os.getpid():
            self._calls = self._calls_of_threads()
            self._crew = Crew(self._calls, len(self._blocks), self.threads, self._group)
        self._crew.gather()
        if self._observations.nbytes < _WORTH_NO_COPY:
            self._crew.run(int(command))
            return self._observations.copy()
        self._observations = np.empty_like(self._observations)
        self._calls.observe_into(self._observations)
        self._crew.run(int(command))
        return self._observations

    def _group_of_blocks(self) -> int:
        """Return how many blocks a thread flies side by side, see `kernels/gathering.py`."""
        s = self._settings[0]
        own = s["randomized"] or s["faults"] or s["features_drawn"]
        if own or not s["run_filter"] or s["sensor_ticks"].max() <= 1:
            return 1
        return max(1, _GROUP_MEMORY // self._room.dtype.itemsize)

    def _calls_of_threads(self) -> Calls:
        """Return the arguments with which the threads call the compiled code."""
        shared = {
            Call.RESETS: self._resets,
            Call.WORLD: self._world,
            Call.MODEL: self._model,
            Call.SETTINGS: self._settings,
            Call.WORDS: self._words,
            Call.STAGES: linked_table(self._stages),
            Call.ACTIONS: self._actions,
            Call.LOW: self._low,
            Call.HIGH: self._high,
            Call.OBSERVATIONS: self._observations,
            Call.FINAL_OBSERVATIONS: self.final_observations,
            Call.RESULTS: self._results,
        }
        numbers = {
            Call.COUNT: self.count,
            Call.GROUP: self._group,
            Call.WORD_COUNT: len(self._words),
            Call.WRITTEN_COUNT: self._written,
            Call.SIZE: self._low.size,
            Call.RESULT_PITCH: self._results.strides[0],
        }
        self._settings["paths"], self._settings["pieces"] = map(address_of, self._paths)
        threads = (self._own, self._believed, self._work, self._gathered)
        return Calls(self._blocks, self._room, shared, numbers, *threads, self._paths)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the threads, which a copy starts again."""
        return self.__dict__ | {"_crew": None, "_calls": None}

    def trajectory(self, flight: int) -> tuple[Trajectory, float] | None:
        """Return the trajectory of a flight's present episode, as rotated for it, and its phase.

        Args:
            flight: Index of the flight.

        Returns:
            The trajectory, and the time on it at which the episode began [s]; None if the task has
            another reference.
        """
        return followed(self, flight)

    def limit(self, max_steps: int) -> None:
        """Truncate episodes after this many steps; 0: no limit."""
        self._settings["max_steps"] = check.whole("max_steps", max_steps, least=0)

    @property
    def max_steps(self) -> int:
        """Number of steps after which an episode is truncated; 0: no limit."""
        return int(self._settings["max_steps"][0])

    @property
    def results(self) -> NDArray[np.float64]:
        """Results (count, k) of the last step by RESULTS; the next step overwrites them."""
        return self._results[:, : self.count].T

    def result(self, name: str) -> NDArray[np.float64]:
        """Return one column of `RESULTS` of the last step, as a new array (count,)."""
        return self._results[RESULTS.index(name), : self.count].copy()

    def reward_terms(self) -> dict[str, NDArray[np.float64]]:
        """Return the terms of the last step's reward, (count,) each; their sum is the reward."""
        names = (term.name.lower() for term in self.task.reward_params.terms(self.task.kind))
        return {name: self.result(f"reward_{name}") for name in names}
