"""Stages: what a flight is made of, each compiled by itself and only where a flight needs it.

A stage is a compiled function of fixed arguments that other compiled code calls through a table of
addresses. What follows from it:

* What a configuration lacks - faults, late measurements, moving air, the filter - is not compiled.
* There are no variants: a stage is the same machine code whatever it is combined with, so a flight
  has the same bits in every configuration that does not change it.
* Stages compile side by side, and an edit of a kernel compiles the stages again that reach it.

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
    FLIGHT_BLOCK,
    FOLLOWED,
    PARAMS_BLOCK,
    SETTINGS,
    WORK_BLOCK,
    Aid,
    FilterForm,
    Layout,
    Supply,
)


class Stage(IntEnum):
    """The stages, by their places in the table of addresses."""

    CONTROL = 0
    DELAY_ACTION = auto()
    SUPPLY = auto()
    MOVE = auto()
    MOVE_IN_AIR = auto()
    REST_ON_PAD = auto()
    BEGIN_IN_AIR = auto()
    DRIFT_BIASES = auto()
    AVERAGE_IMU = auto()
    SAMPLE = auto()
    BEGIN_IMPERFECT = auto()
    DISTURB_IMU = auto()
    TURN_BASELINE = auto()
    LIMIT_CAMERA = auto()
    BEGIN_FAULTS = auto()
    ADVANCE_FAULTS = auto()
    MEET_ROTORS = auto()
    SATURATE_IMU = auto()
    SUM_IMU = auto()
    CORRUPT_GNSS = auto()
    CORRUPT_FEATURES = auto()
    PREDICT = auto()
    UPDATE = auto()
    ALIGN = auto()
    WARM = auto()
    BEGIN_LATE = auto()
    INCREMENT = auto()
    SET_ASIDE = auto()
    EXCHANGE = auto()
    LATE_UPDATE = auto()
    BEGIN = auto()
    DRAW = auto()
    IMPOSE = auto()
    LOOK = auto()
    PLACE_FEATURES = auto()
    JUDGE = auto()
    OBSERVE = auto()
    SHOW = auto()
    BEGIN_CONTACTS = auto()
    TOUCH = auto()
    JUDGE_CONTACTS = auto()
    HIDE_FEATURES = auto()
    BEGIN_GROUND = auto()
    STAND = auto()
    FEEL_GROUND = auto()
    JUDGE_LANDING = auto()
    PREDICT_WITH_SLOW = auto()
    UPDATE_WITH_SLOW = auto()
    LATE_UPDATE_WITH_SLOW = auto()
    WARM_WITH_SLOW = auto()
    FOLLOW = auto()
    _ignore_ = "aid"
    for aid in Aid:  # one for each aiding sensor, last and in their order
        vars()[aid.name] = auto()


class Source(NamedTuple):
    """Where a stage is, and which settings need it."""

    module: str
    function: str
    needed: Callable[[Any], bool]


def _always(s: Any) -> bool:
    return True


def _filter(s: Any) -> bool:
    return bool(s["run_filter"])


def _air(s: Any) -> bool:
    return bool(s["air"])


def _faults(s: Any) -> bool:
    return bool(s["faults"])


def _corrupts(s: Any) -> bool:
    return bool(s["faults"] and s["run_filter"])


def _late(s: Any) -> bool:
    return bool(s["run_filter"] and s["late"] > 0)


def _imu_disturbed(s: Any) -> bool:
    return bool(s["run_filter"] and s["imu_errs"] + s["imu_vibrates"] > 0)


def _lasting(s: Any) -> bool:
    return bool(s["run_filter"] and s["imu_errs"] + s["heading_errs"] > 0)


def _rewinds(s: Any) -> bool:
    return bool(_late(s) and s["rewinds"] > 0)


def _with_slow(s: Any) -> bool:
    return bool(s["run_filter"] and s["slow_states"] > 0)


def _without_slow(s: Any) -> bool:
    return bool(s["run_filter"] and not s["slow_states"] > 0)


def _aid(aid: Aid) -> Callable[[Any], bool]:
    return lambda s: bool(s["run_filter"] and s["aid_on"][aid] > 0)


def _raw(s: Any) -> bool:
    return bool(s["run_filter"] and s["layout"] == Layout.MEASUREMENTS)


def _pad(s: Any) -> bool:
    return bool(s["pad"] and not s["grounded"])


def _grounded(s: Any) -> bool:
    return bool(s["grounded"])


def _contacts(s: Any) -> bool:
    return bool(s["contacts"])


def _hides(s: Any) -> bool:
    return bool(s["run_filter"] and s["camera_ticks"] > 0 and s["obstacle_count"] > 0)


def _follows(s: Any) -> bool:
    return bool(s["harmonics"] == FOLLOWED)


def _places(s: Any) -> bool:
    return bool(s["features_drawn"])


def _drawn(s: Any) -> bool:
    return bool(s["randomized"])


SOURCES = {
    Stage.UPDATE_WITH_SLOW: Source("filter.update", "update_with_slow_stage", _with_slow),
    Stage.UPDATE: Source("filter.update", "update_stage", _without_slow),
    Stage.PREDICT_WITH_SLOW: Source("filter.predict", "predict_with_slow_stage", _with_slow),
    Stage.PREDICT: Source("filter.predict", "predict_stage", _without_slow),
    Stage.LATE_UPDATE_WITH_SLOW: Source(
        "filter.late", "late_update_with_slow_stage", lambda s: _with_slow(s) and _rewinds(s)
    ),
    Stage.LATE_UPDATE: Source(
        "filter.late", "late_update_stage", lambda s: _without_slow(s) and _rewinds(s)
    ),
    **{
        Stage[aid.name]: Source(
            f"measurements.{aid.name.lower()}", f"{aid.name.lower()}_stage", _aid(aid)
        )
        for aid in Aid
    },
    Stage.SAMPLE: Source("sensors.sample", "sample_stage", _filter),
    Stage.DRAW: Source("task.draws", "draw_stage", _drawn),
    Stage.IMPOSE: Source("task.draws", "impose_stage", _drawn),
    Stage.PLACE_FEATURES: Source("task.places", "place_features_stage", _places),
    Stage.BEGIN: Source("task.episode", "begin_stage", _always),
    Stage.MOVE_IN_AIR: Source("vehicle.air", "move_in_air_stage", _air),
    Stage.ALIGN: Source("filter.align", "align_stage", _filter),
    Stage.OBSERVE: Source("task.observation", "observe_stage", _always),
    Stage.SHOW: Source("task.show", "show_stage", lambda s: bool(s["shown"])),
    Stage.ADVANCE_FAULTS: Source("sensors.faults", "advance_faults_stage", _faults),
    Stage.BEGIN_FAULTS: Source("sensors.faults", "begin_faults_stage", _faults),
    Stage.CONTROL: Source("vehicle.control", "control_stage", _always),
    Stage.MOVE: Source("vehicle.dynamics", "move_stage", lambda s: not _air(s)),
    Stage.BEGIN_IN_AIR: Source("vehicle.air", "begin_in_air_stage", _air),
    Stage.WARM_WITH_SLOW: Source(
        "filter.warm", "warm_with_slow_stage", lambda s: _with_slow(s) and s["warm"] > 0
    ),
    Stage.WARM: Source("filter.warm", "warm_stage", lambda s: _without_slow(s) and s["warm"] > 0),
    Stage.AVERAGE_IMU: Source(
        "sensors.imu", "average_imu_stage", lambda s: _filter(s) and s["imu_averages"] > 0
    ),
    Stage.CORRUPT_FEATURES: Source("sensors.faults", "corrupt_features_stage", _corrupts),
    Stage.CORRUPT_GNSS: Source("sensors.faults", "corrupt_gnss_stage", _corrupts),
    Stage.EXCHANGE: Source("filter.waiting", "exchange_stage", _late),
    Stage.INCREMENT: Source("filter.waiting", "increment_stage", _late),
    Stage.LOOK: Source("task.look", "look_stage", _always),
    Stage.JUDGE: Source("task.reward_and_endings", "judge_stage", _always),
    Stage.DRIFT_BIASES: Source("sensors.imu", "drift_biases_stage", _filter),
    Stage.FOLLOW: Source("task.follow", "follow_stage", _follows),
    Stage.REST_ON_PAD: Source("vehicle.pad", "rest_on_pad_stage", _pad),
    Stage.SUPPLY: Source("vehicle.air", "supply_stage", lambda s: s["supply"] != Supply.NOMINAL),
    Stage.BEGIN_LATE: Source("filter.waiting", "begin_late_stage", _late),
    Stage.SET_ASIDE: Source("filter.waiting", "set_aside_stage", _late),
    Stage.BEGIN_IMPERFECT: Source("sensors.imperfect", "begin_imperfect_stage", _lasting),
    Stage.DISTURB_IMU: Source("sensors.imperfect", "disturb_imu_stage", _imu_disturbed),
    Stage.TURN_BASELINE: Source(
        "sensors.imperfect", "turn_baseline_stage", lambda s: _filter(s) and s["heading_errs"] > 0
    ),
    Stage.LIMIT_CAMERA: Source(
        "sensors.imperfect", "limit_camera_stage", lambda s: _filter(s) and s["camera_limited"] > 0
    ),
    Stage.DELAY_ACTION: Source(
        "vehicle.delay", "delay_action_stage", lambda s: s["action_delays"] > 0
    ),
    Stage.HIDE_FEATURES: Source("obstacles.sight", "hide_features_stage", _hides),
    Stage.BEGIN_CONTACTS: Source("obstacles.contact", "begin_contacts_stage", _contacts),
    Stage.TOUCH: Source("obstacles.contact", "touch_stage", _contacts),
    Stage.JUDGE_CONTACTS: Source("obstacles.contact", "judge_contacts_stage", _contacts),
    Stage.BEGIN_GROUND: Source("vehicle.ground", "begin_ground_stage", _grounded),
    Stage.STAND: Source("vehicle.ground", "stand_stage", _grounded),
    Stage.FEEL_GROUND: Source(
        "vehicle.ground", "feel_ground_stage", lambda s: _grounded(s) and _filter(s)
    ),
    Stage.JUDGE_LANDING: Source("vehicle.ground", "judge_landing_stage", _grounded),
    Stage.SATURATE_IMU: Source("sensors.faults", "saturate_imu_stage", _corrupts),
    Stage.MEET_ROTORS: Source("sensors.faults", "meet_rotors_stage", _faults),
    Stage.SUM_IMU: Source("sensors.sample", "sum_imu_stage", _raw),
}
"""Every stage; those that take longest to compile come first."""

STAGE_TABLE = np.dtype([("address", "u8", (len(Stage),))], align=True)
"""The addresses of the stages, 0 where one is not there."""


def needed_stages(settings: Any) -> frozenset[Stage]:
    """The stages that a batch of these settings (a SETTINGS record) flies through."""
    return frozenset(stage for stage, source in SOURCES.items() if source.needed(settings))


def used_parts(settings: Any) -> frozenset[str]:
    """The parts of a flight's record that a batch of these settings uses; see `records.PARTS`."""
    watches = FilterForm(int(settings["form"])) & (FilterForm.GATE | FilterForm.INNOVATIONS)
    uses = {
        "ground": _grounded(settings),
        "contacts": _contacts(settings),
        "path": _follows(settings),
        "faults": _faults(settings),
        "draws": _drawn(settings),
        "places": _places(settings),
        "filter": _filter(settings),
        "actions": bool(settings["action_delays"] > 0),
        "raw": _raw(settings),
        "errors": _lasting(settings),
        "watch": _filter(settings) and bool(watches),
        "late": _late(settings),
        "slow": _with_slow(settings),
        "aids": bool(settings["run_filter"] and settings["aids"] > 0),
        "late_aids": bool(settings["run_filter"] and (settings["aid_delay"] > 0).any()),
    }
    return frozenset(name for name, used in uses.items() if used)


_DTYPES = (FLIGHT_BLOCK, PARAMS_BLOCK, PARAMS_BLOCK, SETTINGS, WORK_BLOCK, STAGE_TABLE)
_ARGUMENTS = (*map(from_dtype, _DTYPES), types.int64)
SIGNATURE = types.none(*_ARGUMENTS)
"""Of every stage: flight, world, model, settings, work, stages, flag."""


def stage(function: Callable[..., Any]) -> Any:
    """Compile `function` as a stage.

    Its arguments are a block of flights, the parameters as they are and as they are believed to be,
    the settings, the workspace, the table of stages, and a number whose meaning is the stage's own.
    `work.mask` holds the lanes that it is to work on.
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
def call_stage(stages, number, flight, world, model, settings, work, flag):
    """Call a stage; the records are those that it is compiled for."""
    address = stages.address[number]
    if address == 0:
        raise RuntimeError("a stage that the settings need is missing from the table")
    _call(address, flight, world, model, settings, work, stages, flag)
