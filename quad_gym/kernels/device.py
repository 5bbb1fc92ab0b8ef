"""Entry that steps or resets one flight: the code of a thread of a GPU.

The flights of a block are next to each other in memory, so that the threads of a warp, which fly
them, read and write consecutive numbers. The numbers of a flight are 8 bytes behind those of the
flight before it, in single precision 4: with addresses shifted by that, the code is the code of the
batch, with one flight in a register.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.batch import _begin_step, _end_block
from quad_gym.kernels.compiling import Stage, entry, kernel
from quad_gym.kernels.flight import block_address, look, move_and_measure, run, update
from quad_gym.kernels.numbers.blocks import array_at, lanes_at, record_at
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.records import (
    FLIGHT_BLOCK,
    PARAMS_BLOCK,
    REAL_BYTES,
    SETTINGS,
    WIDTH,
    WORK_BLOCK,
    Call,
    Command,
)

SETTINGS_SYMBOL = "qg_settings"
"""The settings of a configuration, a constant that `compiling/building.py` writes."""
HELD_IN = "=r,0"
"""Registers of a held number; those of a GPU are in `compiling/building.py`."""
_CALL_WORDS = len(Call)
_WORK_SIZE, _PARAMS_SIZE = WORK_BLOCK.itemsize, PARAMS_BLOCK.itemsize
_flight_at, _params_at, _work_at = map(lanes_at, (FLIGHT_BLOCK, PARAMS_BLOCK, WORK_BLOCK))
_stages_at, _words_at = record_at(STAGE_TABLE), array_at("i8")


@intrinsic
def _copied(typing_context, words):  # type: ignore[no-untyped-def]
    """Return a copy of the words of a call, in registers."""
    kind = types.Array(types.int64, 1, "C")

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        word = ir.IntType(64)
        given = make_array(sig.args[0])(context, builder, args[0])
        data = cgutils.alloca_once(builder, word, size=_CALL_WORDS)
        for k in range(_CALL_WORDS):
            place = [ir.Constant(word, k)]
            builder.store(builder.load(builder.gep(given.data, place)), builder.gep(data, place))
        array = make_array(kind)(context, builder)
        populate_array(
            array,
            data=data,
            shape=cgutils.pack_array(builder, [context.get_constant(types.intp, _CALL_WORDS)]),
            strides=cgutils.pack_array(builder, [context.get_constant(types.intp, 8)]),
            itemsize=context.get_constant(types.intp, 8),
            meminfo=None,
            parent=None,
        )
        return array._getvalue()

    return kind(words), lower


@intrinsic
def _constant_settings(typing_context):  # type: ignore[no-untyped-def]
    """Return the settings that are linked as a constant."""
    kind = from_dtype(SETTINGS)

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        found = builder.module.globals.get(SETTINGS_SYMBOL)
        if found is None:
            found = ir.GlobalVariable(builder.module, ir.IntType(8), SETTINGS_SYMBOL)
            found.global_constant = True
        return builder.bitcast(found, context.get_value_type(kind))

    return kind(), lower


@intrinsic
def _held(typing_context, number):  # type: ignore[no-untyped-def]
    """Return a number that is computed here, and not once more in each branch that needs it."""

    def lower(context, builder, sig, args):  # type: ignore[no-untyped-def]
        kind = ir.FunctionType(args[0].type, [args[0].type])
        return builder.asm(kind, "", HELD_IN, args, side_effect=True)

    return types.int64(types.int64), lower


@kernel
def _fly_ticks(call, index, world, model, settings, work, stages):
    """Fly the ticks of a step."""
    flight = _flight_at(block_address(call, index))
    for left in range(settings.ticks_per_step - 1, -1, -1):
        within = min(left, 1)
        move_and_measure(flight, world, model, settings, work, stages, within)
        if settings.run_filter:
            update((flight, world, model, settings, work, stages))
        look(flight, world, model, settings, work, stages, within)


@entry(signature=types.none(*[types.int64] * 5))
def fly_one(call_at, index, lane, worker, command):
    """Step or reset one flight.

    Args:
        call_at: Address of the (len(Call),) arguments of all threads; WORK, OWN and BELIEVED point
            to one block for each warp.
        index: Index of the flight's block.
        lane: Index of the flight in its block.
        worker: Index of the warp that flies it.
        command: A `Command`, STEP or RESET.
    """
    call = _copied(_words_at(call_at, _CALL_WORDS))
    if index * WIDTH + lane >= call[Call.COUNT]:
        return
    shift, row = REAL_BYTES * lane, 8 * lane  # of numbers in blocks, and of what Python reads
    call[Call.LANE] = lane
    # once: of a sum in both branches of the command, ptxas stores one on a wrong condition
    call[Call.BLOCKS] = _held(block_address(call, index) + shift)
    call[Call.PITCH] = 0
    call[Call.RESULTS] += row
    call[Call.SHOWN] += row
    call[Call.ACTIONS] += 4 * row
    call[Call.WORK] += worker * _WORK_SIZE + shift
    call[Call.OWN] += worker * _PARAMS_SIZE + shift
    call[Call.BELIEVED] += worker * _PARAMS_SIZE + shift
    settings, work = _constant_settings(), _work_at(call[Call.WORK])
    stages, nominal = _stages_at(call[Call.STAGES]), _params_at(call[Call.WORLD])
    differ = settings.randomized > 0 or settings.faults > 0
    true = _params_at(call[Call.OWN] if differ else call[Call.WORLD])
    model = call[Call.BELIEVED] if settings.features_drawn else call[Call.MODEL]
    believed = true if settings.known else _params_at(model)
    flight = _flight_at(block_address(call, index))
    run(Stage.IMPOSE, (flight, true, nominal, settings, work, stages))
    run(Stage.PLACE_FEATURES, (flight, true, believed, settings, work, stages))
    run(Stage.MEET_ROTORS, (flight, true, believed, settings, work, stages))
    if command == Command.STEP:
        _begin_step(call, index, settings)
        _fly_ticks(call, index, true, believed, settings, work, stages)
    _end_block(call, index, command, nominal, true, believed, settings, work, stages)
