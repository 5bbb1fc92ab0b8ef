"""Memory of flights, start of a process, and the processor."""

import platform
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.spaces import layout_bounds, observation_layout
from quad_gym.experiments.benchmark import timing
from quad_gym.kernels.compiling.cores import available_cores

FIRST_USE = """
import time; began = time.perf_counter()
import gymnasium, quad_gym
imported = time.perf_counter()
env = gymnasium.make("QuadGym/Hover-v0"); env.reset(seed=0); env.step(env.action_space.sample())
print(imported - began, time.perf_counter() - began)
"""


def start_times() -> list[float]:
    """Time to import quad_gym, and to the end of the first step, in a new process [s]."""
    line = [sys.executable, "-c", FIRST_USE]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    return list(map(float, done.stdout.split()))


def measure_memory(quick: bool) -> list[timing.Row]:
    """Measure the memory of 4,096 flights, and the first step of a new process."""
    count = 4096
    tracemalloc.start()
    try:
        batch = FlightBatch(count, bounds=layout_bounds(observation_layout()))
        batch.reset(seeds=range(count))
        batch.step()
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    start_times()  # fills the cache, if necessary
    starts = [start_times() for _ in range(1 if quick else 3)]
    imported, stepped = (min(values) for values in zip(*starts, strict=True))
    values = {
        "records of a flight": (batch.snapshot().nbytes / count, "bytes"),
        "batch of 4,096, held, per flight": (held / count, "bytes"),
        "batch of 4,096, peak, per flight": (peak / count, "bytes"),
        "import quad_gym": (imported, "s"),
        "first step, warm cache, import included": (stepped, "s"),
    }
    return [{"name": name, "value": v, "unit": unit} for name, (v, unit) in values.items()]


def memory_table(rows: list[timing.Row]) -> str:
    """Format the section."""

    def value(row: timing.Row) -> str:
        return format(row["value"], ",.0f" if row["unit"] == "bytes" else ".2f")

    return timing.table(
        "Memory and start",
        rows,
        {"what": timing.NAME, "value": value, "unit": timing.column("unit")},
    )


def processor() -> dict[str, Any]:
    """Name and vector instructions of the processor, as far as the system reports them."""
    found: dict[str, Any] = {"machine": platform.machine(), "cores": available_cores()}
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return found | {"model": platform.processor()}
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        fields.setdefault(name.strip(), value.strip())
    flags = fields.get("flags", fields.get("Features", "")).split()
    vector = [flag for flag in flags if flag.startswith(("avx", "fma", "sse4", "asimd", "sve"))]
    return found | {"model": fields.get("model name", ""), "vector_instructions": vector}
