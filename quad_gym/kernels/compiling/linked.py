"""The table of stages of this process: compiled or loaded when a batch first needs them."""

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.compiling.stages import SIGNATURE, SOURCES, STAGE_TABLE, Stage
from quad_gym.kernels.compiling.workers import dispatcher_of, prepare

FLY = "quad_gym.kernels.batch:fly"
_table: NDArray[Any] = np.zeros(1, STAGE_TABLE)
_linked: set[Stage] = set()
_lock = threading.Lock()


def name_of(stage: Stage) -> str:
    """The name of a stage's compiled function, such as "quad_gym.kernels.filter.update:..."."""
    source = SOURCES[stage]
    return f"quad_gym.kernels.{source.module}:{source.function}"


def names_of(needed: frozenset[Stage]) -> list[str]:
    """The compiled functions that flights through these stages take, the longest first."""
    ordered = [name_of(stage) for stage in SOURCES if stage in needed]
    return [*ordered[:2], FLY, *ordered[2:]]


def linked_table(needed: frozenset[Stage]) -> NDArray[Any]:
    """The table of addresses, (1,) STAGE_TABLE, with at least the stages that are needed."""
    if needed <= _linked:
        return _table
    with _lock:
        prepare(names_of(needed))
        for stage in needed - _linked:
            _table["address"][0, stage] = _address(name_of(stage))
            _linked.add(stage)
    return _table


def _address(name: str) -> int:
    """Where the machine code of a stage begins."""
    dispatcher = dispatcher_of(name)
    arguments = tuple(SIGNATURE.args)
    compiled = dispatcher.overloads[arguments]
    address = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
    if not address:
        raise RuntimeError(f"{name} has no machine code")
    return int(address)
