"""Measure what quad_gym costs: filter, tick, options, environments, memory, pictures.

Every figure is the best of some repeats, as whatever else the machine does can only slow it down;
"spread" is how much longer the median of the repeats took. All ratios are taken within one run.

Progress goes to stderr, tables go to stdout, and everything goes to benchmark.json with the
configuration, the versions and the processor. Run it on an idle machine.
"""

import dataclasses
import os
import platform
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

import quad_gym
from quad_gym.cli import option, parse, usage_errors
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.envs.spaces import layout_bounds, observation_layout
from quad_gym.kernels.parts import Part, filter_cycle_of_blocks, filter_cycle_of_flights, run_part
from quad_gym.packing import params_block, params_record
from quad_gym.records import FLIGHT, FLIGHT_BLOCK, WIDTH, WORK, WORK_BLOCK, aligned_zeros
from quad_gym.reports import text_table, versions, write_json
from quad_gym.simulation import FlightBatch
from quad_gym.threads import available_cores

sys.path.insert(0, str(Path(__file__).resolve().parent))
from benchmark_faces import faces_table, time_faces
from benchmark_options import options_table, time_options
from benchmark_peers import Measured, filterpy_cycles, plain_cycles
from benchmark_rendering import rendering_table, time_rendering
from benchmark_timing import Effort, Row, Timing, measure, percent, report


@dataclass(frozen=True)
class Args:
    """Options of the benchmark."""

    only: Literal["all", "filter", "tick", "options", "faces", "memory", "rendering"] = option(
        "all", "section to run", group="what to measure"
    )
    batch: int = option(256, "flights in the batches of filter, tick and options, in eights")
    envs: int = option(1024, "environments in the faces' batches")
    threads: int | None = option(None, "most threads to use; if not given, one per core")
    cold: bool = option(False, "measure the first use with an empty cache too: a minute or more")

    quick: bool = option(
        False,
        "2 short repeats in place of --repeats and --seconds: to see that it runs",
        group="how to measure",
    )
    repeats: int = option(7, "repeats of each measurement, of which the best counts")
    seconds: float = option(0.3, "length of a repeat [s]")
    output: Path = option(
        Path("results/benchmark"), "folder for benchmark.json; made if it is missing"
    )

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in ("batch", "envs", "repeats", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name} must be at least 1, got {value}")
        if self.batch % WIDTH:
            raise ValueError(f"--batch must be a multiple of {WIDTH}, got {self.batch}")
        if not self.seconds > 0.0:
            raise ValueError(f"--seconds must be above 0, got {self.seconds}")

    @property
    def effort(self) -> Effort:
        """How long to measure."""
        return Effort(2, 0.01) if self.quick else Effort(self.repeats, self.seconds)

    @property
    def most_threads(self) -> int:
        """Threads to use at most."""
        return available_cores() if self.threads is None else self.threads


# ---- the filter ---------------------------------------------------------------------------------


def hovering(count: int, **options: Any) -> FlightBatch:
    """A batch that hovers by the PD controller on the estimate, half a second after its start."""
    task = TASK_DEFAULTS["hover"].replace(duration=0.0)
    batch = FlightBatch(count, task=task, gains="tuned", threads=1, **options)
    batch.reset(seeds=range(count))
    for _ in range(100):
        batch.step()
    return batch


def record_one(batch: FlightBatch, flight: int, ticks: int) -> list[Measured]:
    """What one flight measures in the coming ticks."""
    recorded = []
    for _ in range(ticks):
        names = ("gyro", "accel", "gnss_position", "gnss_baseline", "pixels")
        gyro, accel, position, baseline, pixels = (batch.read(name)[flight] for name in names)
        features = int(batch.read("feature_valid")[flight].sum())
        recorded.append(Measured(gyro, accel, position, baseline, pixels[:features]))
        batch.step()
    return recorded


def time_filter(args: Args) -> list[Row]:
    """Cycles of update and prediction on one core, in lanes, scalar and elsewhere."""
    rows: list[Row] = []
    with_camera = quad_gym.sensor_suite("lab")
    for measurements, sensors in ((6, with_camera.replace(camera=None)), (12, with_camera)):
        features = (measurements - 6) // 3
        batch = hovering(args.batch, sensors=sensors)
        seeing = np.flatnonzero(batch.read("feature_valid").sum(axis=1) == features)
        flights = np.zeros(args.batch, FLIGHT)
        blocks = aligned_zeros(args.batch // WIDTH, FLIGHT_BLOCK)
        for name in FLIGHT.names or ():  # the flights that see all features, over and over
            flights[name] = batch.read(name)[np.resize(seeing, args.batch)]
            lanes = flights[name].reshape(-1, WIDTH, *FLIGHT[name].shape)
            blocks[name] = np.moveaxis(lanes, 1, -1)
        model = params_record(batch.vehicle, sensors)
        model_block, work = params_block(model), np.zeros(1, WORK)
        work_block = aligned_zeros(1, WORK_BLOCK)

        def in_lanes(*arrays: Any, n: int = features) -> None:
            filter_cycle_of_blocks(*arrays, n, 0)

        def scalar(*arrays: Any, n: int = features) -> None:
            filter_cycle_of_flights(*arrays, n, 0)

        def add(name: str, timing: Timing, n: int = measurements) -> None:
            rows.append(report(f"{name}, {n} measurements", timing, kind=name, measurements=n))

        for name, cycle, records, others in (
            ("lanes", in_lanes, blocks, (model_block, work_block)),
            ("scalar", scalar, flights, (model, work)),
        ):
            start, states = records.copy(), records

            def again(states: Any = states, start: Any = start) -> None:
                states[:] = start

            def cycles(cycle: Any = cycle, states: Any = states, others: Any = others) -> None:
                cycle(states, *others)

            add(name, measure(cycles, args.effort, again).per(args.batch))
        recorded = record_one(batch, int(seeing[0]), 5 if args.quick else 40)
        recorded = [now for now in recorded if len(now.pixels) == features]
        for name, make in (("plain NumPy", plain_cycles), ("filterpy", filterpy_cycles)):
            run = make(sensors, recorded)
            if run is None:
                print(f"  {name}: not installed", file=sys.stderr)
            else:
                add(name, measure(run, args.effort).per(len(recorded)))
    for row in rows:
        lanes_row = next(
            r for r in rows if r["kind"] == "lanes" and r["measurements"] == row["measurements"]
        )
        row["times_lanes"] = row["seconds"] / lanes_row["seconds"]
    return rows


def filter_table(rows: list[Row]) -> str:
    """The filter's figures."""
    cells = [
        (r["name"], f"{1e6 * r['seconds']:,.2f}", percent(r["spread"]), f"{r['times_lanes']:,.1f}")
        for r in rows
    ]
    return text_table({"UKF cycle, one core": ["filter", "us", "spread", "x lanes"]}, cells)


# ---- the tick -----------------------------------------------------------------------------------


def time_tick(args: Args) -> list[Row]:
    """A whole tick on one core, and its parts, per flight."""
    batch = hovering(args.batch, bounds=layout_bounds(observation_layout()))
    start = batch.snapshot()
    blocks, low, high = batch._blocks, batch._low, batch._high
    observations = np.zeros((args.batch, low.size), np.float32)
    world, model, settings, work = batch._world, batch._model, batch._settings, batch._work[0]
    features = int(settings["feature_count"][0])

    def again() -> None:
        batch.restore(start)

    rows = []
    timing = measure(batch.step, args.effort, again).per(args.batch)
    rows.append(report("whole tick", timing))
    for part in Part:

        def run(part: int = int(part)) -> None:
            run_part(blocks, part, world, model, settings, work, low, high, observations)

        rows.append(report(part.name.lower(), measure(run, args.effort, again).per(args.batch)))

    def run_filter() -> None:
        filter_cycle_of_blocks(blocks, model, work, features, 0)

    rows.append(report("filter", measure(run_filter, args.effort, again).per(args.batch)))
    total = Timing(sum(row["seconds"] for row in rows[1:]), 0.0)
    rows.append(report("sum of parts", total))
    for row in rows:
        row["share"] = row["seconds"] / rows[0]["seconds"]
    return rows


def tick_table(rows: list[Row]) -> str:
    """The tick's figures."""
    cells = [
        (r["name"], f"{1e6 * r['seconds']:.3f}", percent(r["spread"]), percent(r["share"]))
        for r in rows
    ]
    heading = "One flight's tick, one core"
    return text_table({heading: ["part", "us", "spread", "of the whole"]}, cells)


# ---- memory and start ---------------------------------------------------------------------------

FIRST_USE = """
import time; began = time.perf_counter()
import gymnasium, quad_gym
imported = time.perf_counter()
env = gymnasium.make("QuadGym/Hover-v0"); env.reset(seed=0); env.step(env.action_space.sample())
print(imported - began, time.perf_counter() - began)
"""


def start_times(**environment: str) -> tuple[float, float]:
    """Seconds to import quad_gym, and to the end of the first step, in a new process."""
    done = subprocess.run(
        [sys.executable, "-c", FIRST_USE],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )
    imported, stepped = map(float, done.stdout.split())
    return imported, stepped


def measure_memory(args: Args) -> list[Row]:
    """Memory of 4,096 flights, and how long a new process takes to fly its first step."""
    count = 4096
    tracemalloc.start()
    try:
        batch = FlightBatch(count, bounds=layout_bounds(observation_layout()))
        batch.reset(seeds=range(count))
        batch.step()
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    rows: list[Row] = [
        {"name": "records of a flight", "value": batch.snapshot().nbytes / count, "unit": "bytes"},
        {"name": "batch of 4,096, held, per flight", "value": held / count, "unit": "bytes"},
        {"name": "batch of 4,096, peak, per flight", "value": peak / count, "unit": "bytes"},
    ]
    if args.cold:
        print("  compiling into an empty cache", file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            _, cold = start_times(NUMBA_CACHE_DIR=folder)
        rows.append({"name": "first step, cold cache", "value": cold, "unit": "s"})
    start_times()  # fills the cache, if need be
    starts = [start_times() for _ in range(1 if args.quick else 3)]
    imported, stepped = (min(values) for values in zip(*starts, strict=True))
    rows.append({"name": "import quad_gym", "value": imported, "unit": "s"})
    rows.append({"name": "first step, warm cache, import included", "value": stepped, "unit": "s"})
    return rows


def memory_table(rows: list[Row]) -> str:
    """Memory and start."""
    cells = [
        (
            r["name"],
            f"{r['value']:,.0f}" if r["unit"] == "bytes" else f"{r['value']:.2f}",
            r["unit"],
        )
        for r in rows
    ]
    return text_table({"Memory and start": ["what", "value", "unit"]}, cells)


# ---- the run ------------------------------------------------------------------------------------


def processor() -> dict[str, Any]:
    """The processor's name and vector instructions, as far as the system tells."""
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


SECTIONS: dict[str, tuple[Callable[[Args], list[Row]], Callable[[list[Row]], str]]] = {
    "filter": (time_filter, filter_table),
    "tick": (time_tick, tick_table),
    "options": (lambda args: time_options(args.batch, args.effort), options_table),
    "faces": (
        lambda args: time_faces(args.envs, args.most_threads, args.effort),
        faces_table,
    ),
    "memory": (measure_memory, memory_table),
    "rendering": (lambda args: time_rendering(args.effort), rendering_table),
}


def main(args: Args) -> None:
    """Run the chosen sections."""
    with usage_errors():
        args.output.mkdir(parents=True, exist_ok=True)
    cpu = processor()
    print(f"{cpu['model']}, {cpu['cores']} cores for this process.\n")
    sections: dict[str, list[Row]] = {}
    for name, (run, table) in SECTIONS.items():
        if args.only in ("all", name):
            print(f"{name}:", file=sys.stderr, flush=True)
            sections[name] = run(args)
            print(table(sections[name]), end="\n\n", flush=True)
    found = {
        "sections": sections,
        "configuration": dataclasses.asdict(args),
        "processor": cpu,
        "versions": versions("numpy", "numba", "gymnasium", "stable-baselines3", "filterpy"),
    }
    print(f"Wrote {write_json(args.output / 'benchmark.json', found)}.")


if __name__ == "__main__":
    main(parse(Args, description=__doc__))
