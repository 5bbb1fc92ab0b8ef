"""The plan of a batch for a GPU, and the PTX of its kernel."""

import hashlib
import os
import pickle
import subprocess
import sys
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.device.plan import DevicePlan, FieldPlace, Words
from quad_gym.kernels.library import FOLDER
from quad_gym.kernels.sources import sources_digest
from quad_gym.params import checks as check
from quad_gym.records import RESULTS, SHOWN_SIZE, WARP, WIDTH, WORK_BLOCK, offset_of

LANES = {"QUAD_GYM_LANES": str(WARP), "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
"""Environment of a process with the blocks of a GPU."""


def plan_of(batch: FlightBatch) -> DevicePlan:
    """Return the plan of a batch that has never been reset, for any number of flights.

    Raises:
        ValueError: If the batch needs Python during its steps, other than the methods of a task.
    """
    c = batch.configuration
    for python, what in (
        (c.estimator is not None, "an own estimator"),
        (c.begins_after_step, 'innovations with autoreset_mode="SameStep"'),
    ):
        if python:
            raise ValueError(f"flights on a GPU need compiled steps, and {what} runs in Python")
    room, line = batch._room, 8 * WIDTH
    fields = {}
    for name in room.dtype.names or ():
        kind = room.dtype[name]
        first = offset_of(room.dtype, name) // line
        fields[name] = FieldPlace(first, kind.shape[:-1], kind.base.str[1:])
    paths, pieces = (np.frombuffer(array.tobytes(), np.uint8) for array in batch._paths)
    return DevicePlan(
        settings=batch._settings.tobytes(),
        stages=batch._stages,
        flight=batch.copied_record(0),
        skipped=room.skipped // line,
        fields=fields,
        world=_first_lane(batch._world),
        model=_first_lane(batch._model),
        paths=paths,
        pieces=pieces,
        low=batch._low,
        high=batch._high,
        work=WORK_BLOCK.itemsize // line,
        results=RESULTS,
        autoreset=int(c.compiled_autoreset),
        shown=SHOWN_SIZE if batch._settings["shown"][0] else 0,
    )


def _first_lane(block: NDArray[Any]) -> Words:
    return block.view(np.uint64).reshape(-1, WIDTH)[:, 0].copy()


def ptx_of(plan: DevicePlan) -> bytes:
    """Return the PTX of a plan's kernel: from a wheel, or cached by sources and settings.

    Raises:
        ImportError: If Numba is needed and not installed.
        RuntimeError: If the kernel cannot be emitted.
    """
    file = _packed(plan)
    return zlib.decompress(file.read_bytes()) if file.is_file() else _emitted(plan)


def pack(plans: Iterable[DevicePlan]) -> Iterator[Path]:
    """Write the PTX of plans for a wheel, in place of all that is there; yield the files.

    Raises:
        ImportError: If Numba is not installed.
        RuntimeError: If a kernel cannot be emitted.
    """
    for old in FOLDER.glob("*.ptx.z"):
        old.unlink()
    FOLDER.mkdir(exist_ok=True)
    for plan in plans:
        file = _packed(plan)
        file.write_bytes(zlib.compress(_emitted(plan), 9))
        yield file


def _packed(plan: DevicePlan) -> Path:
    """Return the file of a wheel with the PTX of a plan, which need not exist."""
    key = repr((plan.settings, sorted(plan.stages.items())))
    sources = sources_digest(Path(__file__).parents[1])
    return FOLDER / f"{sources[:12]}_{hashlib.sha256(key.encode()).hexdigest()[:12]}.ptx.z"


def _emitted(plan: DevicePlan) -> bytes:
    """Return the PTX of a plan, which another process emits, as blocks have another size there."""
    check.package("numba", "flying on a GPU", "compile")
    path = os.pathsep.join(part for part in sys.path if isinstance(part, str))
    done = subprocess.run(
        [sys.executable, "-c", "from quad_gym.kernels.compiling.device import write; write()"],
        input=pickle.dumps((plan.settings, dict(plan.stages))),
        stdout=subprocess.PIPE,
        env={**os.environ, **LANES, "PYTHONPATH": path},
        check=False,
    )
    if done.returncode:
        raise RuntimeError("the kernel could not be emitted for a GPU, see above")
    return done.stdout
