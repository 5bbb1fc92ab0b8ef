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


class Source(NamedTuple):
    """A compiled function for a slot, and the settings that need it."""

    stage: Stage
    function: str
    """its module in `quad_gym.kernels`, and its name"""
    needed: Callable[[Any], bool]
    parts: tuple[str, ...] = ()
    """parts of a flight's record that it uses in addition to the core, see `records.PARTS`"""

    @property
    def name(self) -> str:
        """Name of the compiled function, such as "quad_gym.kernels.filter.update:update_stage"."""
        return f"quad_gym.kernels.{self.function}"


def _always(s: Any) -> bool:
    return True


def _filter(s: Any) -> bool:
    return bool(s["run_filter"])


def _air(s: Any) -> bool:
    return bool(s["air"])


def _faults(s: Any) -> bool:
    return bool(s["faults"])


def _corrupts(s: Any) -> bool:
    return _faults(s) and _filter(s)


def _late(s: Any) -> bool:
    return _filter(s) and bool(s["late"])


def _rewinds(s: Any) -> bool:
    return _late(s) and bool(s["rewinds"])


def _slow(s: Any) -> bool:
    return _filter(s) and bool(s["slow_states"])


def _warm(s: Any) -> bool:
    return _filter(s) and bool(s["warm"])


def _imu_averages(s: Any) -> bool:
    return _filter(s) and bool(s["imu_averages"])


def _imu_disturbed(s: Any) -> bool:
    return _filter(s) and bool(s["imu_errs"] or s["imu_vibrates"])


def _heading_errs(s: Any) -> bool:
    return _filter(s) and bool(s["heading_errs"])


def _lasting(s: Any) -> bool:
    return _filter(s) and bool(s["imu_errs"] or s["heading_errs"])


def _watches(s: Any) -> bool:
    return _filter(s) and bool(int(s["form"]) & (FilterForm.GATE | FilterForm.INNOVATIONS))


def _raw(s: Any) -> bool:
    return _filter(s) and bool(s["layout"] == Layout.MEASUREMENTS)


def _grounded(s: Any) -> bool:
    return bool(s["grounded"])


def _pad(s: Any) -> bool:
    return bool(s["pad"]) and not _grounded(s)


def _contacts(s: Any) -> bool:
    return bool(s["contacts"])


def _hides(s: Any) -> bool:
    return _sensor(Sensor.CAMERA)(s) and bool(s["obstacle_count"])


def _limits(s: Any) -> bool:
    return _filter(s) and bool(s["camera_limited"])


def _follows(s: Any) -> bool:
    return bool(s["harmonics"] == FOLLOWED)


def _places(s: Any) -> bool:
    return bool(s["features_drawn"])


def _drawn(s: Any) -> bool:
    return bool(s["randomized"])


def _delays(s: Any) -> bool:
    return bool(s["action_delays"] > 0)


def _sensor(sensor: Sensor) -> Callable[[Any], bool]:
    return lambda s: _filter(s) and bool(s["sensor_blocks"][sensor])


def _sensor_source(sensor: Sensor) -> Source:
    name, parts = sensor.name.lower(), () if sensor < FIRST_AID else ("aids",)
    return Source(Stage[sensor.name], f"sensors.{name}:{name}_stage", _sensor(sensor), parts)


SOURCES = (
    Source(Stage.UPDATE, "filter.update:update_with_slow_stage", _slow, ("filter", "slow")),
    Source(Stage.UPDATE, "filter.update:update_stage", _filter, ("filter",)),
    Source(Stage.PREDICT, "filter.predict:predict_with_slow_stage", _slow, ("filter", "slow")),
    Source(Stage.PREDICT, "filter.predict:predict_stage", _filter, ("filter",)),
    Source(
        Stage.LATE_UPDATE,
        "filter.delayed:late_update_with_slow_stage",
        lambda s: _slow(s) and _rewinds(s),
        ("late",),
    ),
    Source(Stage.LATE_UPDATE, "filter.delayed:late_update_stage", _rewinds, ("late",)),
    *map(_sensor_source, Sensor),
    Source(Stage.SAMPLE, "sensors.imu:sample_stage", _filter, ("filter",)),
    Source(Stage.DRAW, "task.draws:draw_stage", _drawn, ("draws",)),
    Source(Stage.IMPOSE, "task.draws:impose_stage", _drawn, ("draws",)),
    Source(Stage.PLACE_FEATURES, "task.places:place_features_stage", _places, ("places",)),
    Source(Stage.BEGIN, "task.episode:begin_stage", _always),
    Source(Stage.MOVE, "vehicle.air:move_in_air_stage", _air),
    Source(Stage.ALIGN, "filter.align:align_stage", _filter, ("filter",)),
    Source(Stage.OBSERVE, "task.observation:observe_stage", _always),
    Source(Stage.SHOW, "task.show:show_stage", lambda s: bool(s["shown"])),
    Source(Stage.ADVANCE_FAULTS, "sensors.faults:advance_faults_stage", _faults, ("faults",)),
    Source(Stage.BEGIN_FAULTS, "sensors.faults:begin_faults_stage", _faults, ("faults",)),
    Source(Stage.CONTROL, "vehicle.control:control_stage", _always),
    Source(Stage.MOVE, "vehicle.dynamics:move_stage", _always),
    Source(Stage.BEGIN_IN_AIR, "vehicle.air:begin_in_air_stage", _air),
    Source(Stage.WARM, "filter.warm:warm_with_slow_stage", lambda s: _slow(s) and _warm(s)),
    Source(Stage.WARM, "filter.warm:warm_stage", _warm),
    Source(Stage.AVERAGE_IMU, "sensors.imu:average_imu_stage", _imu_averages),
    Source(Stage.CORRUPT_FEATURES, "sensors.faults:corrupt_features_stage", _corrupts),
    Source(Stage.CORRUPT_GNSS, "sensors.faults:corrupt_gnss_stage", _corrupts),
    Source(Stage.INCREMENT, "filter.preintegration:increment_stage", _late, ("late",)),
    Source(Stage.LOOK, "task.look:look_stage", _always),
    Source(Stage.JUDGE, "task.reward_and_endings:judge_stage", _always),
    Source(Stage.DRIFT_BIASES, "sensors.imu:drift_biases_stage", _filter),
    Source(Stage.FOLLOW, "task.follow:follow_stage", _follows, ("path",)),
    Source(Stage.REST_ON_PAD, "vehicle.pad:rest_on_pad_stage", _pad),
    Source(
        Stage.KEEP_START,
        "vehicle.pad:keep_start_stage",
        lambda s: _pad(s) or _grounded(s) or _imu_averages(s),
    ),
    Source(Stage.SUPPLY, "vehicle.air:supply_stage", lambda s: s["supply"] != Supply.NOMINAL),
    Source(Stage.BEGIN_LATE, "filter.preintegration:begin_late_stage", _late, ("late",)),
    Source(Stage.BEGIN_IMPERFECT, "sensors.imperfect:begin_imperfect_stage", _lasting, ("errors",)),
    Source(Stage.DISTURB_IMU, "sensors.imperfect:disturb_imu_stage", _imu_disturbed),
    Source(Stage.TURN_BASELINE, "sensors.imperfect:turn_baseline_stage", _heading_errs),
    Source(Stage.LIMIT_CAMERA, "sensors.imperfect:limit_camera_stage", _limits),
    Source(Stage.DELAY_ACTION, "vehicle.delay:delay_action_stage", _delays, ("actions",)),
    Source(Stage.HIDE_FEATURES, "obstacles.sight:hide_features_stage", _hides),
    Source(Stage.BEGIN_CONTACTS, "obstacles.contact:begin_contacts_stage", _contacts),
    Source(Stage.TOUCH, "obstacles.contact:touch_stage", _contacts, ("contacts",)),
    Source(Stage.JUDGE_CONTACTS, "obstacles.contact:judge_contacts_stage", _contacts),
    Source(Stage.BEGIN_GROUND, "vehicle.ground:begin_ground_stage", _grounded),
    Source(Stage.STAND, "vehicle.ground:stand_stage", _grounded, ("ground",)),
    Source(
        Stage.FEEL_GROUND,
        "vehicle.ground:feel_ground_stage",
        lambda s: _grounded(s) and _filter(s),
    ),
    Source(Stage.JUDGE_LANDING, "vehicle.ground:judge_landing_stage", _grounded),
    Source(Stage.SATURATE_IMU, "sensors.faults:saturate_imu_stage", _corrupts),
    Source(Stage.MEET_ROTORS, "sensors.faults:meet_rotors_stage", _faults),
    Source(Stage.SUM_IMU, "sensors.imu:sum_imu_stage", _raw, ("raw",)),
    Source(Stage.FORGET_INNOVATIONS, "filter.align:forget_innovations_stage", _watches, ("watch",)),
)
"""Every function of a stage, the longest to compile first. A slot with several functions gets the
first one that is needed."""

STAGE_TABLE = np.dtype([("address", "u8", (len(Stage),))], align=True)
"""The addresses of the stages, 0 where a slot is empty."""


def _chosen(settings: Any) -> dict[Stage, Source]:
    chosen: dict[Stage, Source] = {}
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
