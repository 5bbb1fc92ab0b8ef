"""The stages of this process, and a table of those that a batch needs.

They are in the library of compiled kernels, or Numba compiles or loads them on demand.
"""

import threading
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.entries import fly
from quad_gym.kernels.library import library
from quad_gym.kernels.stages import SOURCES, STAGE_TABLE, Stage

_addresses: dict[str, int] = {}
_lock = threading.Lock()


def names_of(needed: Collection[str], entries: Sequence[str] = (fly.name,)) -> list[str]:
    """The compiled functions of stages and of the entries that call them, the longest first."""
    ordered = [name for name in dict.fromkeys(s.name for s in SOURCES) if name in needed]
    return [*ordered[:2], *entries[:1], *ordered[2:], *entries[1:]]


def linked_table(needed: Mapping[Stage, str], entries: Sequence[str] = (fly.name,)) -> NDArray[Any]:
    """Table of addresses, (1,) STAGE_TABLE, of only the stages that are needed.

    A batch has memory only for the parts that these stages use, see `used_parts`: other slots stay
    empty, even if another batch has linked their stages. The entries that call them are compiled
    with them.
    """
    with _lock:
        missing = set(needed.values()) - _addresses.keys()
        if missing:
            found = library()
            if found is None:
                from quad_gym.kernels.compiling.workers import prepare  # importing it takes 1 s

                prepare(names_of(set(needed.values()), entries))
            address = _compiled if found is None else found.address_of
            _addresses.update((name, address(name)) for name in missing)
    table = np.zeros(1, STAGE_TABLE)
    for stage, name in needed.items():
        table["address"][0, stage] = _addresses[name]
    return table


def _compiled(name: str) -> int:
    """Address of the machine code of a stage."""
    from quad_gym.kernels.compiling.stages import SIGNATURE
    from quad_gym.kernels.compiling.workers import dispatcher_of

    compiled = dispatcher_of(name).overloads[tuple(SIGNATURE.args)]
    address = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name)
    if not address:
        raise RuntimeError(f"{name} has no machine code")
    return int(address)
