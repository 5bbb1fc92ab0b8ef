"""The process that writes an exported filter, with one flight in a block."""

import concurrent.futures
import multiprocessing
import os
import pickle
import sys
from typing import Any

from baselines.exporting.filter_library import LIBRARY, TARGETS, archive
from baselines.exporting.filter_sources import Sources
from quad_gym.kernels.compiling.foreign import (
    Processor,
    emitted,
    is_cached,
    loaded_size,
    object_of,
)
from quad_gym.kernels.library import core_symbol, say
from quad_gym.params.sensors import SensorSuite


def write() -> None:
    """Write the files for a pickled suite on standard input, pickled, to standard output."""
    sys.stdout.buffer.write(pickle.dumps(_contents(*pickle.load(sys.stdin.buffer))))


def _contents(
    suite: SensorSuite, label: str, target: str, policy: dict[str, Any], imu_rate: float
) -> dict[str, bytes]:
    """Return the files by name; records must have one lane."""
    sources = Sources(suite, label, target, policy, imu_rate)
    processor = Processor(*TARGETS[target].processor)
    missing = [name for name in sources.functions if not is_cached(name, processor)]
    if missing:
        say(f"quad_gym: compiling {len(missing)} kernels of the filter for {target} (once)")
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(min(4, os.cpu_count() or 1), context) as pool:
            tasks = [pool.submit(object_of, name, processor) for name in missing]
            for task in tasks:
                task.result()
    objects = {core_symbol(name): object_of(name, processor) for name in sources.functions}
    for symbol, numbers in sources.constants.items():
        text = "".join(f"\\{byte:02X}" for byte in numbers)
        ir = f'@{symbol} = constant [{len(numbers)} x i8] c"{text}", align 64\n'
        objects[symbol] = emitted(ir, processor)
    flash = sum(map(loaded_size, objects.values()))
    return {LIBRARY: archive(objects), **sources.texts(flash)}
