"""The golden flights by the code of a GPU's thread, emitted for this processor, flight by flight.

python -m tests.golden.device [CASE ...]              # stages compiled one by one, then linked
python -m tests.golden.device --modules [CASE ...]    # each case as one module, as for a GPU
python -m tests.golden.device --library FILE          # of the plan on standard input, to FILE
"""

import ctypes
import json
import os
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from quad_gym.device import LANES
from quad_gym.records import WARP, WIDTH, Call

ROOT = Path(__file__).parents[2]


def write_library(file, settings, stages, *, module=False):
    """Write a library with the code of a configuration; `module`: as one module, as for a GPU."""
    from quad_gym.kernels.compiling import building
    from quad_gym.kernels.library import machine

    lanes = {"x86_64": 4, "aarch64": 2}[machine()]
    host = building.PROCESSORS[machine()][lanes]
    if module:
        found = building.module_of(settings, stages, host)
        objects = [bytes(building.machine_of(host).emit_object(found))]
    else:
        names = [building.ENTRY, *sorted(set(stages.values()))]
        missing = [name for name in names if not building.is_cached(name, host)]
        if len(missing) > 1:
            building.objects_of(missing, host)
        objects = [building.object_of(name, host) for name in names]
        objects.append(building.emitted(building.dispatcher(settings, stages), host))
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, f"{k}.o") for k in range(len(objects))]
        for made, content in zip(files, objects, strict=True):
            made.write_bytes(content)
        subprocess.run(["cc", "-shared", "-o", file, *map(str, files), "-lm"], check=True)


class HostLauncher:
    """Flies the blocks of a call as the threads of a GPU do, one after another."""

    warps = 1

    def __init__(self, file):
        self._one, self._words = ctypes.CDLL(file)["qg_core_fly_one"], (ctypes.c_void_p * 2)()
        self._one.argtypes = [ctypes.c_void_p] * 2 + [ctypes.c_int64] * 5

    def __call__(self, call, blocks, command):
        first = ctypes.addressof(self._words)
        for flight in range(blocks * WARP):
            self._one(first, first + 8, call, *divmod(flight, WARP), 0, command)


def launcher_of(plan):
    """Return the launcher of a plan on this processor; another process compiles it."""
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/flights.so"
        command = [sys.executable, "-m", "tests.golden.device", "--library", file]
        given = pickle.dumps((plan.settings, dict(plan.stages)))
        subprocess.run(command, input=given, cwd=ROOT, env=os.environ | LANES, check=True)
        return HostLauncher(file)


def _by_threads(batch, command, *, module, made):
    """Fly a command of a batch by device code: in place of `FlightBatch._fly`."""
    from quad_gym.batch.memory import address_of
    from quad_gym.kernels.stages import STAGE_TABLE

    if id(batch) not in made:
        with tempfile.TemporaryDirectory() as folder:
            file = f"{folder}/flights.so"
            write_library(file, batch._settings.tobytes(), batch._stages, module=module)
            made[id(batch)] = batch, HostLauncher(file)
    words, table = np.zeros(len(Call), np.int64), np.zeros(1, STAGE_TABLE)
    table["paths"], table["pieces"] = map(address_of, batch._paths)
    given = {**batch.memory_of_call(), Call.STAGES: table}
    if hasattr(batch, "_shown"):  # fields that a user's task reads
        given |= {Call.SHOWN: batch._shown, Call.SHOWN_PITCH: batch._shown.strides[0]}
    for word, value in given.items():
        value = value[0] if isinstance(value, list) else value
        words[word] = value if isinstance(value, int) else address_of(value)
    words[Call.BLOCKS] = address_of(batch._blocks) - batch._room.skipped
    words[Call.PITCH] = batch._room.dtype.itemsize
    made[id(batch)][1](address_of(words), len(batch._blocks), int(command))
    return batch._observations.copy()


def differing(chosen, *, module=False):
    """Return the names of cases whose flights by device code differ; blocks must have WARP lanes.

    `chosen`: names of cases; none: all.
    """
    from quad_gym.batch.flight_batch import FlightBatch
    from tests.golden.flights import DIGESTS, cases, fly

    golden, found, made = json.loads(DIGESTS.read_text()), [], {}
    FlightBatch._fly = lambda batch, command: _by_threads(batch, command, module=module, made=made)
    for name, case in cases().items():
        if name in chosen or not chosen:
            same = fly(case) == golden[name]
            made.clear()
            print(f"{name}: {'the same' if same else 'differs'}", flush=True)
            found += [] if same else [name]
    return found


def main():
    """Compare in a process whose blocks have WARP flights."""
    if WIDTH != WARP:
        command = [sys.executable, "-m", "tests.golden.device", *sys.argv[1:]]
        done = subprocess.run(command, cwd=ROOT, env=os.environ | LANES, check=False)
        raise SystemExit(done.returncode)
    words = sys.argv[1:]
    if words[:1] == ["--library"]:
        write_library(words[1], *pickle.load(sys.stdin.buffer))
        return
    chosen = [word for word in words if word != "--modules"]
    if changed := differing(chosen, module="--modules" in words):
        raise SystemExit(f"these flights differ: {', '.join(changed)}")


if __name__ == "__main__":
    main()
