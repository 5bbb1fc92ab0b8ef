"""`FlightConfiguration`: the keywords of `FlightBatch`, checked; packing reads them."""

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from quad_gym.faults import Fault
from quad_gym.faults.presets import FaultsGiven, faults_of
from quad_gym.params import checks as check
from quad_gym.params.clocks import Clocks
from quad_gym.params.control import ActionParams, PDGains, pd_gains
from quad_gym.params.draw_limits import check_draws
from quad_gym.params.filter import FilterParams
from quad_gym.params.randomization import DrawingTable, Randomization
from quad_gym.params.randomization import Given as Drawn
from quad_gym.params.resolved import Resolved, resolving
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.suites import ALL_SUITES, sensor_suite
from quad_gym.params.task import TaskParams, check_limit
from quad_gym.params.vehicle import VehicleParams, vehicle_params
from quad_gym.params.world import WorldParams, world_params
from quad_gym.records import COLUMNS, MAX_ACTION_DELAY, Autoreset, Control, Layout, Source

MAX_FLIGHTS = 10**7  #: largest number of flights in a batch
FILTER_STARTS = ("cold", "warm")  #: values of the keyword `filter_start`

_WITHOUT = {
    "gains": tuple(control for control in Control if control is not Control.PD),
    "action_params": (Control.PD, Control.MOTOR, Control.WRENCH),
}
"""Arguments of controllers, and the meanings of an action with which they have no effect."""


class _World(Resolved[WorldParams | str, WorldParams]):
    """Field for a world; a preset is that of the flown vehicle."""

    def __set__(self, instance: "FlightConfiguration", given: WorldParams | str) -> None:
        if isinstance(given, str):
            vehicle = check.instance("true_vehicle", instance.flown_vehicle, VehicleParams)
            given = world_params(given, vehicle)
        super().__set__(instance, given)


@dataclass(frozen=True, eq=False)
class FlightConfiguration:
    """Arguments of `FlightBatch`: number of flights, and everything that they have in common.

    `quad_gym.QuadEnv` explains the fields that are keywords of environments, too. See
    `quad_gym.batch.cold_start` and `warm_start` for the bounds and the details of `filter_start`.

    Raises:
        ValueError: If a value is invalid, or has no effect with the others.
    """

    count: int
    """number of flights"""
    _: KW_ONLY
    vehicle: Resolved[VehicleParams | str, VehicleParams] = Resolved(
        resolving(VehicleParams, vehicle_params), "lab"
    )
    sensors: Resolved[SensorSuite | str, SensorSuite] = Resolved(
        resolving(SensorSuite, sensor_suite), "standard"
    )
    gains: PDGains | str | None = None
    """gains of `Control.PD`, or the name of a preset; None: "lab\""""
    action_params: ActionParams | None = None
    task: Resolved[TaskParams | None, TaskParams] = Resolved(resolving(TaskParams), None)
    """reference, start and termination"""
    source: Source = Source.ESTIMATE
    """source of the state that the controller observes"""
    control: Control = Control.PD
    """meaning of an action; `Control.PD` flies without actions"""
    control_rate: float | None = None
    """actions per second, which must divide the IMU rate; None: the IMU rate [Hz]"""
    substeps: int = 1
    action_delay: float = 0.0
    layout: Layout = Layout.RELATIVE
    """layout of the observations"""
    include_std: bool = False
    privileged: bool = False
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    """(low, high) of the observations, each (n,); None: no observations"""
    autoreset: Autoreset = Autoreset.DISABLED
    """start of the next episode after one has ended"""
    run_filter: bool | None = None
    """True: sensors and filter run; None: they run if another argument needs them"""
    estimator: object = None
    """an own `quad_gym.Estimator`, its class, or "module:Class"; None: the filter of the sensors"""
    filter_start: str = "cold"
    innovations: bool = False
    """True: keep innovations and NIS block by block, for `record`: "innovation",
    "innovation_sigma", "block_nis". Filters with an innovation gate, with `faults`, or with
    `truncate_when_diverged` in their task always keep them"""
    threads: int | None = None
    true_vehicle: VehicleParams | None = None
    true_sensors: SensorSuite | None = None
    world: Resolved[WorldParams | str, WorldParams] = _World(
        resolving(WorldParams, world_params), "calm"
    )
    randomization: Resolved[Randomization | Mapping[str, Drawn] | None, Randomization] = Resolved(
        lambda _, given: Randomization.of(given), None
    )
    faults: FaultsGiven = None

    def __post_init__(self) -> None:
        check.whole("count", self.count, most=MAX_FLIGHTS)
        for name, kind in (
            ("source", Source),
            ("control", Control),
            ("layout", Layout),
            ("autoreset", Autoreset),
        ):
            object.__setattr__(self, name, kind(getattr(self, name)))
        check.instance("gains", self.pd_gains, PDGains)
        check.instance("action_params", self.actions, ActionParams)
        check.instance("true_vehicle", self.flown_vehicle, VehicleParams)
        check.instance("true_sensors", self.flown_sensors, SensorSuite)
        for name in ("innovations", "include_std", "privileged"):
            check.flag(name, getattr(self, name))
        check.choice("filter_start", self.filter_start, FILTER_STARTS)
        check_limit(self.task, self.clocks.imu_rate, "IMU rate")
        self.sensors.require_like(self.flown_sensors)
        self._require_effect()
        if self.filters:
            self.sensors.require_filter()
        check.number("action_delay", self.action_delay, least=0.0, most=float(MAX_ACTION_DELAY))
        if self.longest_delay > 0 and self.control is Control.PD:
            raise ValueError("action_delay needs actions: Control.PD flies without any")
        check_draws(self.draws, self.flown_vehicle, self.world, self.clocks)

    def _require_effect(self) -> None:
        """Refuse arguments of another controller, and of a filter that does not run."""
        for name, without in _WITHOUT.items():
            if getattr(self, name) is not None and self.control in without:
                raise ValueError(
                    f"{name} must not be given with Control.{self.control.name}: it uses none"
                )
        if self.filters:
            if self.estimator is not None:
                self._require_effect_on_own()
            return
        for name, value, idle in (
            ("estimator", self.estimator, None),
            ("include_std", self.include_std, False),
            ("innovations", self.innovations, False),
            ("truncate_when_diverged", self.task.truncate_when_diverged, False),
            ("filter_start", self.filter_start, "cold"),
        ):
            if value != idle:
                raise ValueError(f"{name} needs a filter, and none runs here, got {value!r}")

    def _require_effect_on_own(self) -> None:
        """Refuse arguments that have an effect on the built-in filter only."""
        for name, value in (
            ("innovations", self.innovations),
            ("truncate_when_diverged", self.task.truncate_when_diverged),
        ):
            if value:
                raise ValueError(
                    f"{name} has no effect with an own estimator, and must not be given"
                )
        presets = [sensor_suite(name).estimator for name in ALL_SUITES]
        for field in fields(FilterParams):
            value = getattr(self.sensors.estimator, field.name)
            chosen = all(value != getattr(preset, field.name) for preset in presets)
            if chosen and not field.name.startswith("initial") and field.name != "reuse_first_fix":
                raise ValueError(
                    f"SensorSuite.estimator.{field.name} has no effect with an own estimator, and "
                    f"must have the value of a preset, got {value!r}"
                )

    @property
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
        if self.run_filter is not None:
            return check.flag("run_filter", self.run_filter)
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

    @cached_property
    def draws(self) -> DrawingTable:
        """Distributions of the parameters that episodes draw."""
        true = (self.flown_vehicle, self.flown_sensors, self.world)
        return DrawingTable(self.randomization, *true, self.action_delay)

    @property
    def longest_delay(self) -> int:
        """Longest delay of an action, drawn or not [control steps]."""
        return math.ceil(self.draws.high[COLUMNS["action_delay"]][0])
