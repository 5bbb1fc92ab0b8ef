"""Stages, the parts of a flight: their names, their functions, and which of them a batch needs.

A stage is a compiled function of fixed arguments that other compiled code calls through a table of
addresses. Consequences:

* Stages that a configuration lacks - faults, late measurements, moving air, the filter - are not
  compiled.
* A slot that a configuration does not need is empty, and skipped. Some slots have a choice: MOVE in
  calm or in moving air, PREDICT with or without slow errors of sensors.
* A function has the same machine code in every combination, so a flight has the same bits in every
  configuration that does not change it.
* Stages compile in parallel; after an edit of a kernel, only those that reach it compile again.

A call costs a few nanoseconds for all flights of a block together.
"""

from collections.abc import Callable
from enum import IntEnum, auto
from typing import Any, NamedTuple

import numpy as np

from quad_gym.params.sensor_table import SENSOR_SHAPES
from quad_gym.records import (
    FIRST_AID,
    FOLLOWED,
    FilterForm,
    Layout,
    Sensor,
    Supply,
)


class Stage(IntEnum):
    """Slots of the table, in the order of a flight where there is one."""

    # an episode begins
    DRAW = 0
    IMPOSE = auto()
    PLACE_FEATURES = auto()
    BEGIN_LATE = auto()
    BEGIN = auto()
    BEGIN_IMPERFECT = auto()
    BEGIN_FAULTS = auto()
    BEGIN_IN_AIR = auto()
    BEGIN_GROUND = auto()
    BEGIN_CONTACTS = auto()
    ALIGN = auto()
    WARM = auto()
    # a tick: the truth
    DELAY_ACTION = auto()
    CONTROL = auto()
    SUPPLY = auto()
    KEEP_START = auto()
    MOVE = auto()
    REST_ON_PAD = auto()
    STAND = auto()
    TOUCH = auto()
    AVERAGE_IMU = auto()
    # the filter
    PREDICT = auto()
    INCREMENT = auto()
    DRIFT_BIASES = auto()
    FOLLOW = auto()
    ADVANCE_FAULTS = auto()
    SAMPLE = auto()
    LATE_UPDATE = auto()
    UPDATE = auto()
    LOOK = auto()
    SUM_IMU = auto()
    # a step
    MEET_ROTORS = auto()
    JUDGE = auto()
    JUDGE_LANDING = auto()
    JUDGE_CONTACTS = auto()
    OBSERVE = auto()
    SHOW = auto()
    # called by other stages
    GATE = auto()
    MOTION = auto()
    HEADING = auto()
    RECOVER = auto()
    FEEL_GROUND = auto()
    DISTURB_IMU = auto()
    SATURATE_IMU = auto()
    HIDE_FEATURES = auto()
    FORGET_INNOVATIONS = auto()

    # sensors, in their order, and the stages that these call
    _ignore_ = "words word"
    words = (*SENSOR_SHAPES, *(s.name for row in SENSOR_SHAPES.values() for s in row.stages))
    for word in words:
        vars()[word.upper()] = auto()


STAGES_OF = {
    "imu": (
        Stage.KEEP_START,
        Stage.SAMPLE,
        Stage.AVERAGE_IMU,
        Stage.BEGIN_IMPERFECT,
        Stage.DISTURB_IMU,
        Stage.DRIFT_BIASES,
    ),
    **{
        name: tuple(Stage[stage.upper()] for stage in (name, *(s.name for s in row.stages)))
        for name, row in SENSOR_SHAPES.items()
    },
}
"""Stages with which a sensor measures alone, by its name."""


class Kernel(NamedTuple):
    """A compiled function for a slot, and the settings that need it."""

    stage: Stage
    function: str  #: its module in `quad_gym.kernels`, and its name without `_stage`
    needed: Callable[[Any], bool]
    parts: tuple[str, ...]
    """parts of a flight's record that it uses in addition to the core, see `records.PARTS`"""

    @property
    def name(self) -> str:
        """Name of the compiled function, such as "quad_gym.kernels.filter.update:update_stage"."""
        return f"quad_gym.kernels.{self.function}_stage"


def _stage(function: str, needed: Callable[[Any], bool], *parts: str) -> Kernel:
    """A function for the slot of its name."""
    slot = function.partition(":")[2].removesuffix("_with_slow")
    return Kernel(Stage[slot.upper()], function, needed, parts)


def _with(*names: str) -> Callable[[Any], bool]:
    """Make a test of settings: all of these are set."""
    return lambda settings: all(settings[name] > 0 for name in names)


def _filter_and(needed: Callable[[Any], Any]) -> Callable[[Any], bool]:
    """Make a test of settings: there is a filter, and `needed`."""
    return lambda settings: bool(settings["run_filter"] and needed(settings))


def _built_in(*names: str) -> Callable[[Any], bool]:
    """Make a test of settings: the built-in filter runs, and all of these are set."""
    needed = _with("run_filter", *names)
    return lambda settings: needed(settings) and not settings["own_estimator"]


_always, _filter, _faults = _with(), _with("run_filter"), _with("faults")
_corrupts, _air = _with("run_filter", "faults"), _with("air")
_late, _slow = _with("run_filter", "late"), _with("run_filter", "slow_states")
_own = _with("run_filter", "own_estimator")
_REWINDS = ("run_filter", "late", "rewinds")
_grounded, _contacts, _drawn = _with("grounded"), _with("contacts"), _with("randomized")
_MONITORED = FilterForm.GATE | FilterForm.INNOVATIONS


def _formed(form: FilterForm, *names: str) -> Callable[[Any], bool]:
    """Make a test of settings: the built-in filter has one of these forms; the names are set."""
    needed = _built_in(*names)
    return lambda settings: needed(settings) and bool(int(settings["form"]) & form)


def _keeps_start(s: Any) -> bool:
    return bool(s["pad"] or s["grounded"] or (s["run_filter"] and s["imu_averages"]))


def _measured(sensor: Sensor) -> Callable[[Any], bool]:
    """Make a test of settings: a sensor measures."""
    return _filter_and(lambda s: s["sensor_blocks"][sensor])


def _of_sensors() -> list[Kernel]:
    """The stages of sensors, and those that they call."""
    found = []
    for sensor, (name, row) in zip(Sensor, SENSOR_SHAPES.items(), strict=True):
        parts = () if sensor < FIRST_AID else ("aids",)
        found.append(_stage(f"sensors.{name}:{name}", _measured(sensor), *parts))
        for further in row.stages:
            needed = _with("run_filter", further.needed_by)
            found.append(_stage(f"sensors.{name}:{further.name}", needed, *further.parts))
    return found


SOURCES = (
    _stage("filter.update:update_with_slow", _built_in("slow_states"), "filter", "slow"),
    _stage("filter.update:update", _built_in(), "filter"),
    _stage("filter.recovery:recover_with_slow", _formed(FilterForm.GATE, "slow_states"), "watch"),
    _stage("filter.recovery:recover", _formed(FilterForm.GATE), "watch"),
    _stage(
        "filter.motion:motion_with_slow", _built_in("by_motion", "slow_states"), "filter", "slow"
    ),
    _stage("filter.motion:motion", _built_in("by_motion"), "filter"),
    _stage(
        "filter.motion:heading_with_slow", _built_in("by_motion", "slow_states"), "filter", "slow"
    ),
    _stage("filter.motion:heading", _built_in("by_motion"), "filter"),
    _stage("filter.gate:gate", _formed(_MONITORED), "watch"),
    _stage("filter.predict:predict_with_slow", _built_in("slow_states"), "filter", "slow"),
    _stage("filter.predict:predict", _built_in(), "filter"),
    _stage("filter.delayed:late_update_with_slow", _built_in(*_REWINDS, "slow_states"), "late"),
    _stage("filter.delayed:late_update", _built_in(*_REWINDS), "late"),
    *_of_sensors(),
    _stage("sensors.imu:sample", _filter, "filter"),
    _stage("task.draws:draw", _drawn, "draws"),
    _stage("task.draws:impose", _drawn, "draws"),
    _stage("task.draws:place_features", _with("features_drawn"), "places"),
    _stage("task.episode:begin", _always),
    Kernel(Stage.MOVE, "vehicle.air:move_in_air", _air, ()),
    _stage("filter.starts:align", _slow, "filter", "slow"),
    _stage("filter.starts:align", _filter, "filter"),
    _stage("task.observation:observe", _always),
    _stage("task.observation:show", _with("shown")),
    _stage("sensors.faults:advance_faults", _faults, "faults"),
    _stage("sensors.faults:begin_faults", _faults, "faults"),
    _stage("vehicle.control:control", _always),
    _stage("vehicle.dynamics:move", _always),
    _stage("vehicle.air:begin_in_air", _air),
    _stage("filter.starts:warm_with_slow", _with("run_filter", "slow_states", "warm")),
    _stage("filter.starts:warm", _with("run_filter", "warm")),
    _stage("sensors.imu:average_imu", _with("run_filter", "imu_averages")),
    _stage("filter.preintegration:increment", _late, "late"),
    Kernel(Stage.LOOK, "task.observation:look_at_own", _own, ("own",)),
    _stage("task.observation:look", _always),
    _stage("task.reward_and_endings:judge", _always),
    _stage("sensors.imu:drift_biases", _filter),
    _stage("task.reference:follow", lambda s: bool(s["harmonics"] == FOLLOWED), "path"),
    _stage("vehicle.ground:rest_on_pad", lambda s: bool(s["pad"] and not s["grounded"])),
    _stage("vehicle.ground:keep_start", _keeps_start),
    _stage("vehicle.air:supply", lambda s: s["supply"] != Supply.NOMINAL),
    _stage("filter.preintegration:begin_late", _late, "late"),
    _stage(
        "sensors.imu:begin_imperfect",
        _with("run_filter", "imu_errs"),
        "errors",
    ),
    _stage("sensors.imu:disturb_imu", _filter_and(lambda s: s["imu_errs"] or s["imu_vibrates"])),
    _stage("vehicle.control:delay_action", _with("action_delays"), "actions"),
    _stage("obstacles:hide_features", _with("run_filter", "feature_count", "obstacle_count")),
    _stage("obstacles:begin_contacts", _contacts),
    _stage("obstacles:touch", _contacts, "contacts"),
    _stage("obstacles:judge_contacts", _contacts),
    _stage("vehicle.ground:begin_ground", _grounded),
    _stage("vehicle.ground:stand", _grounded, "ground"),
    _stage("vehicle.ground:feel_ground", _with("run_filter", "grounded")),
    _stage("vehicle.ground:judge_landing", _grounded),
    _stage("sensors.imu:saturate_imu", _corrupts),
    _stage("sensors.faults:meet_rotors", _faults),
    _stage("sensors.imu:sum_imu", _filter_and(lambda s: s["layout"] == Layout.MEASUREMENTS), "raw"),
    _stage(
        "filter.starts:forget_innovations",
        _filter_and(lambda s: int(s["form"]) & _MONITORED),
        "watch",
    ),
)
"""Every function of a stage, the longest to compile first. A slot with several functions gets the
first one that is needed."""

STAGE_TABLE = np.dtype(
    [("address", "u8", (len(Stage),)), ("paths", "i8"), ("pieces", "i8")], align=True
)
"""Addresses of the stages, 0 where a slot is empty, of a task's trajectories, (path_count,) of
PATH, and of their segments, of PIECE."""


def _chosen(settings: Any) -> dict[Stage, Kernel]:
    chosen: dict[Stage, Kernel] = {}
    for source in SOURCES:
        if source.stage not in chosen and source.needed(settings):
            chosen[source.stage] = source
    return chosen


def needed_stages(settings: Any) -> dict[Stage, str]:
    """Names of the stages that a batch with these settings (a SETTINGS record) flies through."""
    return {stage: source.name for stage, source in _chosen(settings).items()}


def used_parts(settings: Any) -> frozenset[str]:
    """Parts of a flight's record that a batch with these settings uses, see `records.PARTS`."""
    return frozenset(part for source in _chosen(settings).values() for part in source.parts)
