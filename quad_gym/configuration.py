"""`FlightConfiguration`: the keywords of `FlightBatch`, checked."""

import math
from dataclasses import KW_ONLY, fields
from enum import IntEnum
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from quad_gym.faults import Fault, FaultsGiven, faults_of, needs_sensors
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.params.filter import FilterParams
from quad_gym.params.randomization import DrawingTable, Randomization, check_draws
from quad_gym.params.suites import ALL_SUITES, SensorSuite, given_suite, sensor_suite
from quad_gym.params.task import TaskParams, check_limit
from quad_gym.params.vehicle import (
    ActionParams,
    Clocks,
    PDGains,
    VehicleParams,
    pd_gains,
    vehicle_params,
)
from quad_gym.params.world import WorldParams, world_params
from quad_gym.records import COLUMNS, MAX_ACTION_DELAY, Autoreset, Control, Layout, Source

MAX_FLIGHTS = 10**7  #: largest number of flights in a batch
_CONTROLS_WITHOUT = {
    "gains": tuple(control for control in Control if control is not Control.PD),
    "action_params": (Control.PD, Control.MOTOR, Control.WRENCH),
}
"""Arguments of controllers, and the meanings of an action with which they have no effect."""
FILTER_ARGUMENTS = ("estimator", "filter_start", "truncate_when_diverged")
"""Arguments that have an effect only where a filter runs."""
_UNFILTERED = (
    'where no filter runs, as with observation="truth" or "noisy" unless run_filter, include_std '
    "or innovations ask for it"
)


def _vehicle(name: str, given: Any) -> VehicleParams:
    return check.instance(
        name, vehicle_params(given) if isinstance(given, str | Path) else given, VehicleParams
    )


def _unresolved(_: str, given: Any) -> Any:
    return given


def _member(kind: type[IntEnum]) -> check.Rule:
    """Return the rule of a member of an enumeration, or its number."""

    def rule(name: str, given: Any) -> IntEnum:
        try:
            return kind(given)
        except (TypeError, ValueError):
            names = ", ".join(member.name for member in kind)
            raise ValueError(
                f"{name} must be a {kind.__name__}, one of {names}, got {given!r}"
            ) from None

    return rule


def _task(name: str, given: Any) -> TaskParams:
    return check.instance(name, TaskParams() if given is None else given, TaskParams)


def _randomization(_: str, given: Any) -> Randomization:
    return Randomization.of(given)


class FlightConfiguration(Checked, kw_only=False, eq=False, bare=True):
    """Arguments of `FlightBatch`: number of flights, and everything that they have in common.

    `quad_gym.QuadEnv` explains the fields that are keywords of environments, too. Vehicle, sensors
    and world may be given by their names. See `quad_gym.batch.starts` and `warm_start` for the
    bounds and the details of `filter_start`.

    Raises:
        ValueError: If a value is invalid, or has no effect with the others.
    """

    count: Annotated[int, partial(check.whole, most=MAX_FLIGHTS)]
    """number of flights"""
    _: KW_ONLY
    vehicle: Annotated[VehicleParams, _vehicle] = cast(Any, "lab")
    """vehicle that filter and control assume"""
    sensors: Annotated[SensorSuite, given_suite] = cast(Any, "standard")
    """sensors that the filter assumes, and the filter"""
    gains: PDGains | str | None = None
    """gains of `Control.PD`, or the name of a preset; None: "lab\""""
    action_params: ActionParams | None = None
    """scales of actions; None: the defaults"""
    task: Annotated[TaskParams, _task] = cast(Any, None)
    """reference, start and termination"""
    source: Annotated[Source, _member(Source)] = Source.ESTIMATE
    """source of the state that the controller observes"""
    control: Annotated[Control, _member(Control)] = Control.PD
    """meaning of an action; `Control.PD` flies without actions"""
    control_rate: float | None = None
    """actions per second, which must divide the IMU rate; None: the IMU rate [Hz]"""
    substeps: int = 1
    """Runge-Kutta steps per tick"""
    action_delay: Annotated[float, check.between(0.0, float(MAX_ACTION_DELAY))] = 0.0
    """delay of actions [control steps]"""
    layout: Annotated[Layout, _member(Layout)] = Layout.RELATIVE
    """layout of the observations"""
    include_std: bool = False
    """True: observations contain the filter's 15 standard deviations"""
    privileged: bool = False
    """True: observations end with the truth, for a critic"""
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    """(low, high) of the observations, each (n,); None: no observations"""
    autoreset: Annotated[Autoreset, _member(Autoreset)] = Autoreset.DISABLED
    """start of the next episode after one has ended"""
    run_filter: bool | None = None
    """True: sensors and filter run; None: they run if another argument needs them"""
    estimator: object = None
    """an own `quad_gym.Estimator`, its class, or "module:Class"; None: the filter of the sensors"""
    filter_start: Literal["cold", "warm"] = "cold"
    """start of the filter: "cold", from its first measurements, or "warm", when it has converged"""
    innovations: bool = False
    """True: keep innovations and NIS block by block, for `record`: "innovation",
    "innovation_sigma", "block_nis". Filters with an innovation gate, with `faults`, or with
    `truncate_when_diverged` in their task always keep them"""
    threads: int | None = None
    """number of threads; None: one for each core"""
    true_vehicle: VehicleParams | None = None
    """vehicle that flies; None: `vehicle`"""
    true_sensors: SensorSuite | None = None
    """sensors that measure; None: `sensors`"""
    world: Annotated[WorldParams, _unresolved] = cast(Any, "calm")
    """a preset is that of the flown vehicle"""
    randomization: Annotated[Randomization, _randomization] = cast(Any, None)
    """parameters that each episode draws; None: none"""
    faults: FaultsGiven = None
    """faults, or their names; None: none"""

    def __post_init__(self) -> None:
        super().__post_init__()
        world: Any = self.world
        if isinstance(world, str | Path):
            world = world_params(world, self.flown_vehicle)
        self._set("world", check.instance("world", world, WorldParams))
        check.instance("gains", self.pd_gains, PDGains)
        check_limit(self.task, self.clocks.imu_rate, "IMU rate")
        self.sensors.require_like(self.flown_sensors)
        if self.run_filter is not None:
            check.flag("run_filter", self.run_filter)
        if self.run_filter is False and self._needs_filter:
            raise ValueError(
                "run_filter must not be False where the observation, include_std or innovations "
                "need the filter"
            )
        given = {**check.changed(self), **check.changed(self.task)}
        if self.estimator is not None:
            given |= _chosen_of_filter(self)
        check.effect(given, arguments_without_effect(self))
        if self.filters:
            self.sensors.require_filter()
        if self.longest_delay > 0 and self.control is Control.PD:
            raise ValueError("action_delay needs actions: Control.PD flies without any")
        check_draws(self.draws, self.flown_vehicle, self.clocks)

    @cached_property
    def pd_gains(self) -> PDGains:
        """Gains of `Control.PD`."""
        if isinstance(self.gains, str | None):
            return pd_gains(self.gains or "lab", self.vehicle)
        return self.gains

    @property
    def actions(self) -> ActionParams:
        """Scales of the actions."""
        return ActionParams() if self.action_params is None else self.action_params

    @property
    def flown_vehicle(self) -> VehicleParams:
        """The true vehicle."""
        return self.vehicle if self.true_vehicle is None else self.true_vehicle

    @property
    def flown_sensors(self) -> SensorSuite:
        """The true sensors."""
        return self.sensors if self.true_sensors is None else self.true_sensors

    @cached_property
    def clocks(self) -> Clocks:
        """Rates of simulation and control."""
        rate = self.sensors.imu.rate if self.control_rate is None else self.control_rate
        return Clocks(imu_rate=self.sensors.imu.rate, control_rate=rate, substeps=self.substeps)

    @cached_property
    def possible_faults(self) -> tuple[Fault, ...]:
        """Faults that can occur, at most one of each kind."""
        return faults_of(self.faults, self.flown_sensors)

    @property
    def filters(self) -> bool:
        """True if sensors and filter run."""
        return self._needs_filter if self.run_filter is None else self.run_filter

    @property
    def _needs_filter(self) -> bool:
        """True if another argument needs sensors and filter."""
        needed = self.include_std or self.innovations
        return needed or self.source in (Source.ESTIMATE, Source.MEASUREMENTS)

    @property
    def keeps_innovations(self) -> bool:
        """True if innovations are kept block by block."""
        diverges = self.task.truncate_when_diverged
        return self.filters and (self.innovations or bool(self.possible_faults) or diverges)

    @property
    def begins_after_step(self) -> bool:
        """True if the batch itself begins episodes after a step.

        The kernels would begin them before the last innovations can be read.
        """
        return self.innovations and self.autoreset is Autoreset.SAME_STEP

    @property
    def compiled_autoreset(self) -> Autoreset:
        """The mode of the kernels."""
        return Autoreset.DISABLED if self.begins_after_step else self.autoreset

    @cached_property
    def draws(self) -> DrawingTable:
        """Distributions of the parameters that episodes draw."""
        true = (self.flown_vehicle, self.flown_sensors, self.world)
        return DrawingTable(self.randomization, *true, self.action_delay)

    @property
    def longest_delay(self) -> int:
        """Longest delay of an action, drawn or not [control steps]."""
        return math.ceil(self.draws.high[COLUMNS["action_delay"]][0])


def arguments_without_effect(c: FlightConfiguration) -> dict[str, str]:
    """Return the arguments that have no effect with the others, each with the reason.

    `FlightConfiguration` refuses those that differ from their defaults. An environment, which knows
    the keywords that were given, refuses each of them.
    """
    found = {
        name: f"with Control.{c.control.name}, which uses none"
        for name, controls in _CONTROLS_WITHOUT.items()
        if c.control in controls
    }
    if not c.filters:
        found |= dict.fromkeys(FILTER_ARGUMENTS, _UNFILTERED)
        of_sensors = [type(f).__name__ for f in c.possible_faults if needs_sensors(f)]
        if of_sensors:
            found["faults"] = f"on sensors ({of_sensors[0]}) {_UNFILTERED}"
    if c.estimator is not None:
        of_filter = ("innovations", "truncate_when_diverged", *_chosen_of_filter(c))
        found |= dict.fromkeys(of_filter, "with an own estimator")
    return found


def _chosen_of_filter(c: FlightConfiguration) -> dict[str, Any]:
    """Return parameters of the built-in filter that no preset has, but those of its start."""
    presets = [sensor_suite(name).estimator for name in ALL_SUITES]
    found = {}
    for name in (field.name for field in fields(FilterParams)):
        of_start = name.startswith("initial") or name == "reuse_first_fix"
        value = getattr(c.sensors.estimator, name)
        if not of_start and all(value != getattr(preset, name) for preset in presets):
            found[f"SensorSuite.estimator.{name}"] = value
    return found
