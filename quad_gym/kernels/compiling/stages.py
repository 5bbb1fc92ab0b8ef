"""Stages, the parts of a flight, each compiled separately and only where a flight needs it.

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
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling.decorators import entry, kernel
from quad_gym.records import (
    FIRST_AID,
    FLIGHT_BLOCK,
    FOLLOWED,
    PARAMS_BLOCK,
    SETTINGS,
    WORK_BLOCK,
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
    FEEL_GROUND = auto()
    DISTURB_IMU = auto()
    SATURATE_IMU = auto()
    TURN_BASELINE = auto()
    CORRUPT_GNSS = auto()
    LIMIT_CAMERA = auto()
    HIDE_FEATURES = auto()
    CORRUPT_FEATURES = auto()
    FORGET_INNOVATIONS = auto()
    _ignore_ = "sensor"
    for sensor in Sensor:  # last, in their order
        vars()[sensor.name] = auto()


class Kernel(NamedTuple):
    """A compiled function for a slot, and the settings that need it."""

    stage: Stage
    function: str
    """its module in `quad_gym.kernels`, and its name without `_stage`"""
    needed: Callable[[Any], bool]
    parts: tuple[str, ...] = ()
    """parts of a flight's record that it uses in addition to the core, see `records.PARTS`"""

    @property
    def name(self) -> str:
        """Name of the compiled function, such as "quad_gym.kernels.filter.update:update_stage"."""
        return f"quad_gym.kernels.{self.function}_stage"


def _with(*names: str) -> Callable[[Any], bool]:
    """Make a test of settings: all of these are set."""
    return lambda settings: all(settings[name] > 0 for name in names)


_always, _filter, _faults = _with(), _with("run_filter"), _with("faults")
_corrupts, _air = _with("run_filter", "faults"), _with("air")
_late, _slow = _with("run_filter", "late"), _with("run_filter", "slow_states")
_own = _with("run_filter", "own_estimator")
_grounded, _contacts, _drawn = _with("grounded"), _with("contacts"), _with("randomized")


def _built_in(*names: str) -> Callable[[Any], bool]:
    """Make a test of settings: the built-in filter runs, and all of these are set."""
    runs = _with("run_filter", *names)
    return lambda settings: runs(settings) and not settings["own_estimator"]


def _pad(s: Any) -> bool:
    return bool(s["pad"]) and not _grounded(s)


def _keeps_start(s: Any) -> bool:
    return bool(_pad(s) or _grounded(s) or (_filter(s) and s["imu_averages"]))


def _imu_disturbed(s: Any) -> bool:
    return _filter(s) and bool(s["imu_errs"] or s["imu_vibrates"])


def _has_constant_errors(s: Any) -> bool:
    return _filter(s) and bool(s["imu_errs"] or s["heading_errs"])


def _watches(s: Any) -> bool:
    return _filter(s) and bool(int(s["form"]) & (FilterForm.GATE | FilterForm.INNOVATIONS))


def _observes_measurements(s: Any) -> bool:
    return _filter(s) and bool(s["layout"] == Layout.MEASUREMENTS)


def _hides(s: Any) -> bool:
    return _sensor(Sensor.CAMERA)(s) and bool(s["obstacle_count"])


def _sensor(sensor: Sensor) -> Callable[[Any], bool]:
    return lambda s: _filter(s) and bool(s["sensor_blocks"][sensor])


def _sensor_source(sensor: Sensor) -> Kernel:
    name, parts = sensor.name.lower(), () if sensor < FIRST_AID else ("aids",)
    return Kernel(Stage[sensor.name], f"sensors.{name}:{name}", _sensor(sensor), parts)


SOURCES = (
    Kernel(
        Stage.UPDATE, "filter.update:update_with_slow", _built_in("slow_states"), ("filter", "slow")
    ),
    Kernel(Stage.UPDATE, "filter.update:update", _built_in(), ("filter",)),
    Kernel(
        Stage.PREDICT,
        "filter.predict:predict_with_slow",
        _built_in("slow_states"),
        ("filter", "slow"),
    ),
    Kernel(Stage.PREDICT, "filter.predict:predict", _built_in(), ("filter",)),
    Kernel(
        Stage.LATE_UPDATE,
        "filter.delayed:late_update_with_slow",
        _built_in("slow_states", "late", "rewinds"),
        ("late",),
    ),
    Kernel(
        Stage.LATE_UPDATE,
        "filter.delayed:late_update",
        _built_in("late", "rewinds"),
        ("late",),
    ),
    *map(_sensor_source, Sensor),
    Kernel(Stage.SAMPLE, "sensors.imu:sample", _filter, ("filter",)),
    Kernel(Stage.DRAW, "task.draws:draw", _drawn, ("draws",)),
    Kernel(Stage.IMPOSE, "task.draws:impose", _drawn, ("draws",)),
    Kernel(
        Stage.PLACE_FEATURES, "task.places:place_features", _with("features_drawn"), ("places",)
    ),
    Kernel(Stage.BEGIN, "task.episode:begin", _always),
    Kernel(Stage.MOVE, "vehicle.air:move_in_air", _air),
    Kernel(Stage.ALIGN, "filter.align:align", _slow, ("filter", "slow")),
    Kernel(Stage.ALIGN, "filter.align:align", _filter, ("filter",)),
    Kernel(Stage.OBSERVE, "task.observation:observe", _always),
    Kernel(Stage.SHOW, "task.show:show", _with("shown")),
    Kernel(Stage.ADVANCE_FAULTS, "sensors.faults:advance_faults", _faults, ("faults",)),
    Kernel(Stage.BEGIN_FAULTS, "sensors.faults:begin_faults", _faults, ("faults",)),
    Kernel(Stage.CONTROL, "vehicle.control:control", _always),
    Kernel(Stage.MOVE, "vehicle.dynamics:move", _always),
    Kernel(Stage.BEGIN_IN_AIR, "vehicle.air:begin_in_air", _air),
    Kernel(Stage.WARM, "filter.warm:warm_with_slow", _with("run_filter", "slow_states", "warm")),
    Kernel(Stage.WARM, "filter.warm:warm", _with("run_filter", "warm")),
    Kernel(Stage.AVERAGE_IMU, "sensors.imu:average_imu", _with("run_filter", "imu_averages")),
    Kernel(Stage.CORRUPT_FEATURES, "sensors.faults:corrupt_features", _corrupts),
    Kernel(Stage.CORRUPT_GNSS, "sensors.faults:corrupt_gnss", _corrupts),
    Kernel(Stage.INCREMENT, "filter.preintegration:increment", _late, ("late",)),
    Kernel(Stage.LOOK, "task.look:look_at_own", _own, ("own",)),
    Kernel(Stage.LOOK, "task.look:look", _always),
    Kernel(Stage.JUDGE, "task.reward_and_endings:judge", _always),
    Kernel(Stage.DRIFT_BIASES, "sensors.imu:drift_biases", _filter),
    Kernel(
        Stage.FOLLOW, "task.follow:follow", lambda s: bool(s["harmonics"] == FOLLOWED), ("path",)
    ),
    Kernel(Stage.REST_ON_PAD, "vehicle.pad:rest_on_pad", _pad),
    Kernel(Stage.KEEP_START, "vehicle.pad:keep_start", _keeps_start),
    Kernel(Stage.SUPPLY, "vehicle.air:supply", lambda s: s["supply"] != Supply.NOMINAL),
    Kernel(Stage.BEGIN_LATE, "filter.preintegration:begin_late", _late, ("late",)),
    Kernel(
        Stage.BEGIN_IMPERFECT,
        "sensors.imperfect:begin_imperfect",
        _has_constant_errors,
        ("errors",),
    ),
    Kernel(Stage.DISTURB_IMU, "sensors.imperfect:disturb_imu", _imu_disturbed),
    Kernel(
        Stage.TURN_BASELINE, "sensors.imperfect:turn_baseline", _with("run_filter", "heading_errs")
    ),
    Kernel(
        Stage.LIMIT_CAMERA, "sensors.imperfect:limit_camera", _with("run_filter", "camera_limited")
    ),
    Kernel(Stage.DELAY_ACTION, "vehicle.delay:delay_action", _with("action_delays"), ("actions",)),
    Kernel(Stage.HIDE_FEATURES, "obstacles.sight:hide_features", _hides),
    Kernel(Stage.BEGIN_CONTACTS, "obstacles.contact:begin_contacts", _contacts),
    Kernel(Stage.TOUCH, "obstacles.contact:touch", _contacts, ("contacts",)),
    Kernel(Stage.JUDGE_CONTACTS, "obstacles.contact:judge_contacts", _contacts),
    Kernel(Stage.BEGIN_GROUND, "vehicle.ground:begin_ground", _grounded),
    Kernel(Stage.STAND, "vehicle.ground:stand", _grounded, ("ground",)),
    Kernel(Stage.FEEL_GROUND, "vehicle.ground:feel_ground", _with("run_filter", "grounded")),
    Kernel(Stage.JUDGE_LANDING, "vehicle.ground:judge_landing", _grounded),
    Kernel(Stage.SATURATE_IMU, "sensors.faults:saturate_imu", _corrupts),
    Kernel(Stage.MEET_ROTORS, "sensors.faults:meet_rotors", _faults),
    Kernel(Stage.SUM_IMU, "sensors.imu:sum_imu", _observes_measurements, ("raw",)),
    Kernel(Stage.FORGET_INNOVATIONS, "filter.align:forget_innovations", _watches, ("watch",)),
)
"""Every function of a stage, the longest to compile first. A slot with several functions gets the
first one that is needed."""

STAGE_TABLE = np.dtype([("address", "u8", (len(Stage),))], align=True)
"""The addresses of the stages, 0 where a slot is empty."""


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


_DTYPES = (FLIGHT_BLOCK, PARAMS_BLOCK, PARAMS_BLOCK, SETTINGS, WORK_BLOCK, STAGE_TABLE)
_ARGUMENTS = (*map(from_dtype, _DTYPES), types.int64)
SIGNATURE = types.none(*_ARGUMENTS)
"""Signature of every stage: flight, world, model, settings, work, stages, flag."""


def stage(function: Callable[..., Any]) -> Any:
    """Compile `function` as a stage.

    Its arguments are a block of flights, the true parameters and the assumed ones, the settings,
    the workspace, the table of stages, and a number whose meaning depends on the stage. `work.mask`
    holds the lanes to work on.
    """
    return entry(function, SIGNATURE)


@intrinsic
def _call(typing_context, address, flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        kind = context.call_conv.get_function_type(types.none, _ARGUMENTS)
        pointers = [
            builder.bitcast(value, context.get_value_type(wanted))
            for value, wanted in zip(args[1:7], _ARGUMENTS, strict=False)
        ]
        last = context.cast(builder, args[7], sig.args[7], types.int64)
        context.call_conv.call_function(
            builder,
            builder.inttoptr(args[0], ir.PointerType(kind)),
            types.none,
            _ARGUMENTS,
            [*pointers, last],
        )
        return context.get_dummy_value()

    return types.none(address, flight, world, model, settings, work, stages, flag), lower


@kernel
def call_stage(stages, stage, flight, world, model, settings, work, flag):
    """Call a stage unless its slot is empty; the records are those that it is compiled for."""
    address = stages.address[stage]
    if address != 0:
        _call(address, flight, world, model, settings, work, stages, flag)
