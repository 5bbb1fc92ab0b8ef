"""From the keywords of an environment to its flights: the same for all three interfaces."""

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.quantities import innovations_of
from quad_gym.batch.starts import check_in_bounds, check_pad, checked_start
from quad_gym.configuration import MAX_FLIGHTS, FlightConfiguration, arguments_without_effect
from quad_gym.envs.config import EnvConfig, own_estimator
from quad_gym.envs.spaces import (
    ACTIONS,
    LAYOUTS,
    OBSERVATIONS,
    OWN_LAYOUT,
    Table,
    layout_bounds,
    observation_space,
    policy_size,
    table_of,
    table_with_task,
)
from quad_gym.faults import named_faults
from quad_gym.params import checks as check
from quad_gym.params.suites import SensorSuite, given_suite
from quad_gym.records import Autoreset, Layout

if TYPE_CHECKING:
    from quad_gym.rendering.renderer import Rendering
    from quad_gym.tasks.batch import TaskBatch


class Flights:
    """The flights behind an environment, with its observation's table; see `QuadEnv`."""

    def __init__(
        self, config: EnvConfig, count: int, autoreset: Autoreset, threads: int | None = None
    ) -> None:
        check.whole("num_envs", count, most=MAX_FLIGHTS)
        self.config = config
        seen, vehicle = config.observation, config.vehicle
        self.name, self.task, self.observation = config.name, config.task, seen.observation
        self.action, self.layout = vehicle.action, seen.layout
        self.control_rate, self.reward_terms = vehicle.control_rate, seen.reward_terms
        c = _configuration(config, count, autoreset, threads)
        self.table: Table = table_of(c)
        c = c.replace(bounds=layout_bounds(self.table))
        self.batch: FlightBatch
        if config.tasks:
            self.batch, self.table = batch_with_task(config.tasks, c, self.table)
        else:
            check_pad(c)  # a task in Python may set where vehicles start
            self.batch = FlightBatch(c)  # type: ignore[arg-type]

    @cached_property
    def space(self) -> spaces.Box | spaces.Dict:
        """Space of the observations."""
        return observation_space(self.table)

    @cached_property
    def policy_size(self) -> int | None:
        """Elements of an observation for the policy, before privileged ones; None: without any."""
        return policy_size(self.table) if self.config.observation.privileged else None

    def start(self, options: dict[str, Any] | None) -> dict[str, Any]:
        """The start values in the options of a reset, checked before anything changes."""
        chosen = start_options(options)
        position, velocity, yaw = (chosen.get(name) for name in ("position", "velocity", "yaw"))
        count, world = self.batch.count, self.batch.world
        given = checked_start(count, position, velocity, yaw, self.task, world)
        ends_by_itself = "terminated" in getattr(self.batch, "methods", ())  # a user's task
        if position is not None and given is not None and not ends_by_itself:
            check_in_bounds(self.task, given[:, :3])
        return chosen

    def split(self, observations: NDArray[np.float32]) -> Any:
        """Observations (..., n) as the space wants them: an array, or a Dict of parts."""
        if self.policy_size is None:
            return observations
        return {
            "policy": observations[..., : self.policy_size].copy(),
            "privileged": observations[..., self.policy_size :].copy(),
        }


def _configuration(
    config: EnvConfig, count: int, autoreset: Autoreset, threads: int | None
) -> FlightConfiguration:
    """Return the configuration of a batch: that of the environment in enumerations and objects.

    Raises:
        ValueError: If a value is invalid, or a given keyword has no effect.
    """
    seen, raw = config.observation, config.observation.observation == "measurements"
    vehicle = {name: value for name, value in vars(config.vehicle).items() if name != "action"}
    c = FlightConfiguration(
        count,
        task=config.task,
        sensors=_suite(config),
        true_sensors=config.sensors.true_sensors,
        estimator=own_estimator(config.filter.estimator),
        filter_start=config.filter.filter_start,
        source=OBSERVATIONS[seen.observation],
        control=ACTIONS[config.vehicle.action],
        layout=Layout.MEASUREMENTS if raw else LAYOUTS[seen.layout],
        run_filter=config.sensors.run_filter,
        include_std=seen.include_std,
        privileged=seen.privileged,
        innovations=seen.innovations,
        autoreset=autoreset,
        threads=threads,
        **vehicle,
        **vars(config.world),
    )
    own_layout = {"layout": OWN_LAYOUT} if raw else {}
    check.effect(config.asked, arguments_without_effect(c) | own_layout)
    return c


def _suite(config: EnvConfig) -> SensorSuite:
    """Return the sensor suite that `sensors`, `camera` and `estimator` select."""
    sensors, estimator = config.sensors.sensors, config.filter.estimator
    suite = given_suite("sensors", sensors)
    if not config.sensors.camera:
        suite = suite.replace(camera=None)
    elif "camera" in config.asked and suite.camera is None:
        raise ValueError(f"camera must not be True: the sensors {sensors!r} have none")
    if estimator is None or own_estimator(estimator) is not None:
        return suite
    check.choice("estimator", estimator, ("ukf", "ekf"))
    return suite.replace(estimator=suite.estimator.replace(kind=estimator))


def checked_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Actions as finite floats of a shape, clipped to [-1, 1]."""
    if _in_order(actions, shape):
        return actions
    try:
        given = np.asarray(actions)
    except ValueError:
        raise ValueError(f"action must be {shape} numbers, got {actions!r}") from None
    if given.dtype.kind not in "biuf" or np.ma.is_masked(actions):
        raise ValueError(f"action must be {shape} numbers, got {actions!r}")
    numbers = given.astype(np.float64)
    if numbers.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {numbers.shape}")
    if not np.isfinite(numbers).all():
        place = tuple(np.argwhere(~np.isfinite(numbers))[0].tolist())
        raise ValueError(f"action must be finite, got {numbers[place]} at {list(place)}")
    return numbers.clip(-1.0, 1.0)


def _in_order(actions: Any, shape: tuple[int, ...]) -> bool:
    """Return True if actions need no check and no clipping; NaN and infinity always do."""
    if not (type(actions) is np.ndarray and actions.dtype.kind == "f" and actions.shape == shape):
        return False
    if actions.ndim == 1:  # a few numbers are sooner looked at than handed to NumPy
        return all(-1.0 <= number <= 1.0 for number in actions.tolist())
    return bool(actions.max() <= 1.0 and actions.min() >= -1.0)


def named_options(options: Any) -> dict[str, Any]:
    """A copy of the options of a reset, which are by name; none for None."""
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options must be values by name, or None, got {options!r}")
    return dict(options or {})


def start_options(options: dict[str, Any] | None) -> dict[str, Any]:
    """The start values in the options of a reset."""
    chosen = named_options(options)
    known = ("position", "velocity", "yaw")
    unknown = sorted(set(chosen) - set(known))
    if unknown:
        raise ValueError(f"options may contain {', '.join(known)}, got {unknown[0]!r}")
    return chosen


# --------------------------------------------------------------------------------------------------
# Flights with tasks in Python, which are imported when there are any.
# --------------------------------------------------------------------------------------------------


def batch_with_task(
    tasks: Sequence[Any], c: FlightConfiguration, table: Table
) -> "tuple[TaskBatch, Table]":
    """Make flights with user-defined tasks, each laid over the one before it.

    The parts that `observe` returns are found by calling it once, with a flight made for the
    purpose.

    Args:
        tasks: The tasks, or their names.
        c: Configuration of the flights.
        table: Table of the built-in observation.

    Returns:
        The flights, and the table of their observations.
    """
    from quad_gym.tasks.batch import Part, TaskBatch, laid_over

    split, task = policy_size(table), laid_over(tasks)
    task._require(c.sensors, c.world)
    if not task.has("observe"):
        return TaskBatch(c, own_task=task, split=split), table
    first = TaskBatch(c.replace(count=1, threads=1), own_task=task, split=split)
    first.reset(keys=np.zeros((1, 2), np.uint64))
    sizes = {name: part.shape[1] for name, part in first.ask_parts().items()}
    table, kept = table_with_task(table, task, sizes)
    own = {field.name: field for field in table if field.name in sizes}
    parts = {name: Part(sizes[name], own[name].low, own[name].high) for name in sizes}
    return TaskBatch(c, own_task=task, split=split, parts=parts, kept=kept), table


# --------------------------------------------------------------------------------------------------
# Faults and innovations in `info`.
# --------------------------------------------------------------------------------------------------

Parts = dict[str, dict[str, NDArray[Any]]]


def start_info(batch: FlightBatch) -> dict[str, Any]:
    """Return `info` of all flights at the start of episodes: arrays, and dictionaries of arrays."""
    return {
        "position_error": batch.record("position_error"),
        "estimation_error": batch.record("estimation_error"),
        "ending": np.zeros(batch.count, np.int64),
        "filter_status": batch.record("filter_status").astype(np.int64),
        "filter_diverged": batch.record("diverged") > 0.0,
        "gates_passed": np.zeros(batch.count, np.int64),
        **drawn_info(batch.drawn()),
        **flight_info(batch, batch.record("faults")),
    }


def drawn_info(drawn: dict[str, NDArray[np.float64]]) -> Parts:
    """Return the entry "drawn" of `info` for all flights; empty without draws."""
    return {"drawn": drawn} if drawn else {}


def flight_info(batch: FlightBatch, bits: NDArray[np.float64]) -> Parts:
    """Return the entries "faults", from their bits (n,), and "innovations" of `info`, if any."""
    found: Parts = {}
    if batch.faults:
        found["faults"] = named_faults(batch.faults, bits)
    if batch.innovations:
        found["innovations"] = innovations_of(batch)
    return found


def info_of_flight(infos: Mapping[str, Any], flight: int) -> dict[str, Any]:
    """Return the entries of one flight, with Python's booleans and numbers for arrays of one."""
    found: dict[str, Any] = {}
    for name, values in infos.items():
        if isinstance(values, dict):
            found[name] = info_of_flight(values, flight)
        elif values.ndim > 1 or values.dtype == object:
            found[name] = values[flight]
        else:
            found[name] = values[flight].item()
    return found


def replace_faults(infos: dict[str, Any], batch: FlightBatch, flights: NDArray[np.intp]) -> None:
    """Describe the present instant of some flights instead, if `info` has faults."""
    if batch.faults:
        now = named_faults(batch.faults, batch.record("faults", flights))
        for name, values in now.items():
            infos["faults"][name][flights] = values


def final_parts(infos: dict[str, Any], batch: FlightBatch, over: NDArray[np.bool_]) -> Parts:
    """Return the faults and innovations of episodes that are over, (n,)."""
    found: Parts = {}
    if "faults" in infos:
        faults = infos["faults"].items()
        found["faults"] = {name: values & over for name, values in faults}
    if batch.innovations:
        found["innovations"] = batch.final_innovations
    return found


# --------------------------------------------------------------------------------------------------
# Rendering, the same for all interfaces of an environment; imports nothing until it is used.
#
# Pygame is imported with the first picture: environments with a render mode can be made without it.
# --------------------------------------------------------------------------------------------------

RENDERING_METADATA: dict[str, Any] = {
    "render_modes": ["human", "rgb_array", "rgb_array_list"],
    "render_fps": 50,
}
"""Gymnasium's metadata; an environment's own has its control rate as the frame rate."""


class Rendered:
    """Flights with a renderer and Gymnasium's description, as the interfaces have them."""

    flights: Flights
    render_mode: str | None
    rendering: "Rendering | None"
    _spec: EnvSpec | None = None

    def _open(
        self, flights: Flights, mode: str | None, render_flights: Sequence[int] | None = None
    ) -> None:
        """Set flights, and a renderer if there is a `render_mode`, which other keywords need."""
        self.flights, self.render_mode, self.rendering = flights, mode, None
        options = {**vars(flights.config.rendering), "render_flights": render_flights}
        given = {name: value for name, value in options.items() if value is not None}
        if mode is None and given:
            raise ValueError(f"{next(iter(given))} needs a render_mode, got None")
        if mode is not None:
            from quad_gym.rendering.renderer import Rendering

            options = {name.removeprefix("render_"): value for name, value in given.items()}
            self.rendering = Rendering(flights.batch, mode, **options)

    @property
    def _begun(self) -> bool:
        """True if all flights have an episode, of a reset or of a restored snapshot."""
        batch = self.flights.batch
        return batch.begun or bool(batch.record("episode").all())

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's description of the environment, with the time limit in steps."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        """Store a description with the time limit of the environment, not of a wrapper."""
        self._spec = copy.copy(value)
        if self._spec is not None:
            self._spec.max_episode_steps = self.flights.batch.max_steps or None

    def _open_rendering(self, make: str) -> "Rendering | None":
        """Return the renderer of flights that have begun, or warn if it is missing."""
        if self.rendering is None:
            gymnasium.logger.warn(
                f"render() needs a render_mode: {make}(..., render_mode='rgb_array')"
            )
        elif not self._begun:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return self.rendering

    def close(self) -> None:
        """Close the window, if there is one; closing twice is fine."""
        if self.rendering is not None:
            self.rendering.close()
