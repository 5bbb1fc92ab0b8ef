"""`FlightBatch`: many flights of one configuration, flown together."""

import math
import os
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.memory import Calls, FlightMemory, Word, address_of, configuration_digest
from quad_gym.batch.own_estimator import Estimator, OwnFilter
from quad_gym.batch.quantities import innovations_of, read
from quad_gym.batch.starts import (
    check_cold_start,
    check_reference,
    check_standing,
    checked_keys,
    checked_mask,
    checked_start,
    pack_warm_start,
)
from quad_gym.batch.threads import Crew, resolve_threads
from quad_gym.configuration import FlightConfiguration
from quad_gym.kernels.entries import linked_table
from quad_gym.kernels.stages import needed_stages, used_parts
from quad_gym.packing import (
    OTHER_FORM,
    RecordsOfOneForm,
    pack_paths,
    params_block,
    params_record,
    settings_record,
)
from quad_gym.params import checks as check
from quad_gym.params.checks import takes
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.world import WorldParams
from quad_gym.records import (
    EXCHANGE_BLOCK,
    FLIGHT_BLOCK,
    RESULTS,
    SINGLE,
    WIDTH,
    WORK_BLOCK,
    Call,
    Command,
    aligned_zeros,
    room_of,
    words_of_update,
)

_GROUP_MEMORY = 1 << 23
"""Memory of the blocks that a thread flies side by side [bytes], see `kernels/flight.py`: less
leaves gathered blocks half empty, more leaves the caches. A batch up to twice as large is one
group."""
_NO_BOUNDS = np.zeros(0)
_SINGLE_REACH = 1000.0
"""Distance from the origin up to which float32 resolves positions [m]: its spacing is 0.06 mm."""
_SINGLE_TICKS = 2.0**24  #: ticks of an episode that float32 counts exactly
_CALLS_OF_CHECK = 256  #: calls between two checks of these limits
_WORTH_NO_COPY = 1 << 16  #: size of observations [bytes] above which a step allocates its own


class FlightBatch(RecordsOfOneForm, FlightMemory):
    """N flights of one configuration, advanced together by compiled kernels.

    The record of a flight holds its complete state: `snapshot` and `restore` copy arrays, and a
    flight depends only on its seed and its actions, not on the size of the batch, its order or the
    number of threads.

    It takes a `quad_gym.configuration.FlightConfiguration`, or its fields as arguments.

    Raises:
        ValueError: If an argument is invalid; nothing is allocated then.
    """

    @takes(FlightConfiguration)
    def __init__(self, *values: Any, **keywords: Any) -> None:
        ready = len(values) == 1 and not keywords and isinstance(values[0], FlightConfiguration)
        c: FlightConfiguration = values[0] if ready else FlightConfiguration(*values, **keywords)
        self.configuration, self.count = c, int(c.count)
        self.vehicle, self.sensors, self.task, self.world = c.vehicle, c.sensors, c.task, c.world
        self.gains, self.action_params, self.action_delay = c.pd_gains, c.actions, c.action_delay
        self.source, self.control, self.clocks = c.source, c.control, c.clocks
        self.randomization, self.faults = c.randomization, c.possible_faults
        self.run_filter, self.innovations = c.filters, c.innovations
        self.threads = resolve_threads(c.threads)
        self._own_filter: OwnFilter | None = None
        if c.estimator is not None:
            given = check.own("estimator", c.estimator, Estimator, ("update",))
            self._own_filter = OwnFilter(given, self.count)
        if c.filters and c.filter_start == "cold":
            check_cold_start(c.sensors, c.draws)
        check_reference(c.task, c.vehicle, c.actions, c.control)
        check_standing(c.task, c.flown_vehicle, c.world, c.draws)
        parameters = self._pack_parameters(c)
        self._settings, self._paths = settings_record(c), pack_paths(c.task.trajectories)
        if c.filters and c.filter_start == "warm":
            pack_warm_start(self._settings[0], FlightBatch, c)
        self._choose_stages()
        mode = np.array((c.compiled_autoreset,), [("autoreset", np.int64)])
        digest = configuration_digest(self._settings, mode, *parameters, *self._paths)
        used = used_parts(self._settings[0])
        self._allocate(room_of(used), c.draws.low, digest)
        self._words, self._written = words_of_update(self._settings[0], used)
        self._allocate_for_threads()
        self._low, self._high = (_NO_BOUNDS, _NO_BOUNDS) if c.bounds is None else c.bounds
        padded = -(-self.count // WIDTH) * WIDTH
        self._actions = np.zeros((padded, 4))
        self._resets = np.zeros(self.count, np.uint8)
        self._observations = np.zeros((self.count, self._low.size), np.float32)
        self.final_observations = np.zeros((self.count, self._low.size), np.float32)
        self.final_innovations: dict[str, NDArray[Any]] = {}
        self._results = np.zeros((len(RESULTS), padded + WIDTH))  # no rows 4 KiB apart
        own = self._own_filter is not None
        self._exchange = aligned_zeros(len(self._blocks) if own else 0, EXCHANGE_BLOCK)
        self._crew: Crew | None = None
        self._calls_until_check, self._beyond_single = 0, ""

    def _pack_parameters(self, c: FlightConfiguration) -> tuple[NDArray[Any], NDArray[Any]]:
        """Write the parameters as filter and controller assume them, and the true ones.

        Returns:
            Both as scalar records, shape (1,).
        """
        ground = WorldParams(ground_height=c.world.ground_height)  # what a filter models of it
        model = params_record(c.vehicle, c.sensors, c.pd_gains, c.actions, ground)
        vehicle, sensors, world = c.flown_vehicle, c.flown_sensors, c.world
        if (vehicle, sensors, world) == (c.vehicle, c.sensors, ground):
            true = model.copy()
        else:
            true = params_record(vehicle, sensors, c.pd_gains, c.actions, world)
        true["action_delay"] = c.action_delay
        self._model, self._world = params_block(model), params_block(true)
        return model, true

    def _allocate_for_threads(self) -> None:
        """Allocate the memory that each thread has for itself."""
        s, self._group = self._settings[0], 1  # blocks that a thread flies side by side
        own = s["randomized"] or s["faults"] or s["features_drawn"] or s["own_estimator"]
        if s["run_filter"] and not own and s["sensor_ticks"].max() > 1:
            blocks, size = len(self._blocks), self._room.dtype.itemsize
            whole = blocks * size <= 2 * _GROUP_MEMORY
            self._group = blocks if whole else max(1, _GROUP_MEMORY // size)
        self._own = [self._world.copy() for _ in range(self.threads)]
        self._assumed = [self._model.copy() for _ in range(self.threads)]
        self._work = [aligned_zeros(1, WORK_BLOCK) for _ in range(self.threads)]
        self._gathered = [aligned_zeros(1, FLIGHT_BLOCK) for _ in range(self.threads)]
        for block in self._gathered:
            block["stamps"] = np.nan  # nothing arrives in the other slots

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
        begin = np.flatnonzero(chosen)
        if words is not None:
            self.write(begin, key=words[begin], instant=0, episode=0.0)
        self._resets[:] = chosen
        if given is None:
            return self._run(Command.RESET)
        self.write(begin, start_given=given[begin])
        observations = self._run(Command.RESET)
        self.write(begin, start_given=np.nan)
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
        self._keep_actions(actions)
        observations = self._run(Command.STEP)
        if self.configuration.begins_after_step:
            over = self.result("terminated") + self.result("truncated") > 0.0
            if over.any():
                self.final_observations[over] = observations[over]
                self._keep_innovations()
                self._resets[:] = over
                return self._run(Command.RESET)
        return observations

    def _keep_actions(self, actions: NDArray[Any] | None) -> None:
        """Store the actions of a step; None: the present ones."""
        self._actions[: self.count] = self.record("action") if actions is None else actions

    def _keep_innovations(self) -> None:
        """Keep the innovations of episodes that are over, before others begin in the same step."""
        if self.innovations:
            self.final_innovations = innovations_of(self)

    def _require_begun(self) -> None:
        """Refuse to step flights that have no state; checked until all flights have one."""
        waiting = self.record("episode") == 0.0
        if waiting.any():
            raise check.NotResetError(
                f"call reset() before step(): {int(waiting.sum())} of {self.count} flights have "
                "never been reset"
            )
        self._begun = True

    def snapshot(self) -> NDArray[Any]:
        """Return a copy of all flights, with which `restore` restores this instant bitwise."""
        flights = super().snapshot()
        return flights if self._own_filter is None else self._own_filter.state.kept_with(flights)

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore all flights from a snapshot of this batch, or of another one like it.

        Raises:
            ValueError: If the snapshot is from a batch of another size, or with other settings,
                parameters or estimator. The time limit and the number of threads may differ.
        """
        own, flights = self._own_filter, snapshot
        if own is not None:
            flights = own.state.flights_of(snapshot, self._blocks.dtype, own.name)
        super().restore(flights)
        if own is not None:
            own.restore(self, snapshot)

    def _run(self, command: Command) -> NDArray[np.float32]:
        """Step or reset the flights; return the observations."""
        if self._own_filter is not None:
            return self._own_filter.run(self, command)
        return self._fly(command)

    def _fly(self, command: int) -> NDArray[np.float32]:
        """Have the threads carry out a `Command`; return the observations."""
        if self._crew is None or self._crew.process != os.getpid():
            self._calls = self._calls_of_threads()
            self._crew = Crew(self._calls, len(self._blocks), self.threads, self._group)
        self._crew.gather()
        if SINGLE:
            self._warn_beyond_single()
        if command >= Command.TICK or self._observations.nbytes < _WORTH_NO_COPY:
            self._crew.run(int(command))
            return self._observations.copy()
        self._observations = np.empty_like(self._observations)
        self._calls.observe_into(self._observations)
        self._crew.run(int(command))
        return self._observations

    def _warn_beyond_single(self) -> None:
        """Warn once about positions and times that float32 cannot resolve, checked now and then."""
        self._calls_until_check -= 1
        if self._calls_until_check > 0 or self._beyond_single:
            return
        self._calls_until_check = _CALLS_OF_CHECK
        reach, ticks = np.abs(self._blocks["r"]).max(), self._blocks["tick"].max()
        if reach > _SINGLE_REACH:
            self._beyond_single = f"{reach:.0f} m from the origin, beyond {_SINGLE_REACH:g} m"
        elif ticks >= _SINGLE_TICKS:
            self._beyond_single = f"{ticks:.0f} ticks old, beyond {_SINGLE_TICKS:.0f}"
        if self._beyond_single:
            warnings.warn(
                f"a flight is {self._beyond_single}: in single precision slow motions freeze there "
                "and ticks are lost; use QUAD_GYM_PRECISION=double",
                UserWarning,
                stacklevel=5,
            )

    def _calls_of_threads(self) -> Calls:
        """Return the arguments with which the threads call the compiled code."""
        table = linked_table(self._stages)
        table["paths"], table["pieces"] = map(address_of, self._paths)
        words = {**self.memory_of_call(), Call.STAGES: table}
        return Calls(self._blocks, self._room, words, self._paths)

    def memory_of_call(self) -> dict[Call, Word]:
        """Return the arguments of a call without blocks and stages; lists: one for each thread."""
        return {
            Call.COUNT: self.count,
            Call.GROUP: self._group,
            Call.WORD_COUNT: len(self._words),
            Call.WRITTEN_COUNT: self._written,
            Call.AUTORESET: int(self.configuration.compiled_autoreset),
            Call.SIZE: self._low.size,
            Call.RESULT_PITCH: self._results.strides[0],
            Call.RESETS: self._resets,
            Call.WORLD: self._world,
            Call.MODEL: self._model,
            Call.SETTINGS: self._settings,
            Call.WORDS: self._words,
            Call.ACTIONS: self._actions,
            Call.LOW: self._low,
            Call.HIGH: self._high,
            Call.OBSERVATIONS: self._observations,
            Call.FINAL_OBSERVATIONS: self.final_observations,
            Call.RESULTS: self._results,
            Call.EXCHANGE: self._exchange,
            Call.OWN: self._own,
            Call.BELIEVED: self._assumed,
            Call.WORK: self._work,
            Call.GATHERED: self._gathered,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled or copied state; see `RecordsOfOneForm`."""
        super().__setstate__(state)
        if self._room != room_of(used_parts(self._settings[0])):
            raise ValueError(OTHER_FORM)

    def _without_process(self) -> dict[str, Any]:
        return {"_crew": None, "_calls": None}

    def _choose_stages(self) -> None:
        """Choose the stages that the flights need."""
        self._stages = needed_stages(self._settings[0])

    def trajectory(self, flight: int) -> tuple[Trajectory, float] | None:
        """Return the trajectory of a flight's present episode, as rotated for it, and its phase.

        Args:
            flight: Index of the flight.

        Returns:
            The trajectory, and the time on it at which the episode began [s]; None if the task has
            another reference.
        """
        if not self.task.trajectories:
            return None
        which = np.array([flight])
        chosen = self.task.trajectories[int(self.record("path", which)[0])]
        cosine, sine = self.record("path_turn", which)[0]
        if cosine == 0.0 == sine:  # never reset
            cosine = 1.0
        share = float(self.record("path_share", which)[0])
        return chosen.turned(math.atan2(sine, cosine)), share * chosen.duration * chosen.closed

    def read(self, name: str, flights: NDArray[np.intp] | None = None) -> NDArray[Any]:
        """Return a quantity of the flights, as a new array (n, ...).

        Args:
            name: One of `quad_gym.batch.quantities.QUANTITIES`, such as "position",
                "estimated_velocity" or "reference_position"; or a parameter that `randomization`
                draws, such as "mass".
            flights: Indices of the flights; None: all of them.

        Raises:
            ValueError: If there is no such quantity or flight, or no filter runs that would
                estimate the quantity.
        """
        if flights is not None:
            flights = self._chosen(flights)
        if name in self.randomization.names:
            values = self.drawn()[name]
            return values if flights is None else values[flights]
        return read(self, name, flights)

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
