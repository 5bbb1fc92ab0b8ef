"""Measure what quad_gym costs: filter, tick, options, environments, memory, pictures, compiling.

    quad-gym benchmark
    quad-gym benchmark --only interfaces --n-envs 256
    quad-gym benchmark --only compile

Every figure is the best of some repeats, as other load on the machine can only slow it down;
"spread" is how much longer the median of the repeats took. All ratios are taken within one run.

Compiling and learning are measured by `--only compile` and `--only learning` alone, as they take
minutes: `learning` trains the compiled PPO with ten seeds, the whole recipe each, and says when
each first flew better than tuned PD control. `--against DIR` compares the environments with those
of another checkout, by turns in one run: on a machine that others use, too, two runs cannot be
compared.

Progress goes to stderr, tables go to stdout, and everything goes to benchmark.json with the
configuration, the versions and the processor. Run it on an idle machine.
"""

import dataclasses
import platform
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from quad_gym.analysis.reports import require_writable, text_table, versions, write_json
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.benchmark.against import against_table, time_against
from quad_gym.commands.benchmark.compiling import compile_table, time_compile
from quad_gym.commands.benchmark.filter import filter_table, time_filter
from quad_gym.commands.benchmark.interfaces import interfaces_table, time_interfaces
from quad_gym.commands.benchmark.learning import learning_table, time_learning
from quad_gym.commands.benchmark.options import options_table, time_options
from quad_gym.commands.benchmark.own_task import own_task_table, time_own_task
from quad_gym.commands.benchmark.rendering import rendering_table, time_rendering
from quad_gym.commands.benchmark.stages import tick_table, time_tick
from quad_gym.commands.benchmark.timing import Effort, Row
from quad_gym.commands.options import require_at_least, usage_errors
from quad_gym.envs.spaces import layout_bounds, observation_layout
from quad_gym.kernels.compiling.cores import available_cores
from quad_gym.records import WIDTH

Section = Literal[
    "all",
    "filter",
    "tick",
    "options",
    "interfaces",
    "tasks",
    "memory",
    "rendering",
    "compile",
    "learning",
]
ALONE = ("compile", "learning")
"""Sections that take minutes."""


@dataclass(frozen=True)
class Args:
    """Options of the benchmark."""

    only: Section = "all"
    """section to run; all: every one but compile and learning, minutes"""
    against: Path | None = None
    """folder of another checkout to compare the environments with, instead of the sections"""
    batch: int = 256
    """flights in the batches of filter, tick and options, in eights"""
    n_envs: int = 1024
    """environments in the interfaces' batches"""
    threads: int | None = None
    """most threads to use; if not given, one per core"""
    seeds: int = 10
    """training seeds of learning"""
    steps: int | None = None
    """environment steps of each training of learning; if not given, the recipe's"""
    quick: bool = False
    """2 short repeats in place of --repeats and --seconds: to see that it runs"""
    repeats: int = 7
    """repeats of each measurement, of which the best counts"""
    seconds: float = 0.3
    """length of a repeat [s]"""
    output: Path = Path("results/benchmark")
    """folder for benchmark.json; made if it is missing"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_at_least(self, batch=1, n_envs=1, repeats=1, seeds=1, steps=1, threads=1)
        if self.batch % WIDTH:
            raise ValueError(f"--batch must be a multiple of {WIDTH}, got {self.batch}")
        if self.against is not None and not (self.against / "quad_gym" / "__init__.py").is_file():
            raise ValueError(f"--against must be a checkout of quad_gym, got {self.against}")
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


# ---- memory and start ---------------------------------------------------------------------------

FIRST_USE = """
import time; began = time.perf_counter()
import gymnasium, quad_gym
imported = time.perf_counter()
env = gymnasium.make("QuadGym/Hover-v0"); env.reset(seed=0); env.step(env.action_space.sample())
print(imported - began, time.perf_counter() - began)
"""


def start_times() -> tuple[float, float]:
    """Seconds to import quad_gym, and to the end of the first step, in a new process."""
    done = subprocess.run(
        [sys.executable, "-c", FIRST_USE],
        capture_output=True,
        text=True,
        check=True,
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
    "filter": (
        lambda args: time_filter(args.batch, args.effort, 5 if args.quick else 40),
        filter_table,
    ),
    "tick": (lambda args: time_tick(args.batch, args.effort), tick_table),
    "options": (lambda args: time_options(args.batch, args.effort), options_table),
    "interfaces": (
        lambda args: time_interfaces(args.n_envs, args.most_threads, args.effort),
        interfaces_table,
    ),
    "tasks": (lambda args: time_own_task(args.effort, args.most_threads), own_task_table),
    "memory": (measure_memory, memory_table),
    "rendering": (lambda args: time_rendering(args.effort), rendering_table),
    "compile": (lambda args: time_compile(args.quick), compile_table),
    "learning": (
        lambda args: time_learning(args.seeds, args.steps, args.most_threads, args.quick),
        learning_table,
    ),
}


def chosen_sections(args: Args) -> list[str]:
    """The sections to run: all are those that take no minutes by themselves."""
    if args.against is not None:
        return ["against"]
    whole = args.only == "all"
    return [name for name in SECTIONS if args.only == name or (whole and name not in ALONE)]


def compare(args: Args) -> list[Row]:
    """The environments of another checkout by turns with these."""
    assert args.against is not None
    return time_against(args.against, args.n_envs, args.most_threads, args.effort)


def main(args: Args) -> None:
    """Run the chosen sections."""
    with usage_errors():
        require_writable("--output", args.output)
    cpu = processor()
    print(f"{cpu['model']}, {cpu['cores']} cores for this process.\n")
    sections: dict[str, list[Row]] = {}
    for name in chosen_sections(args):
        run, table = (compare, against_table) if name == "against" else SECTIONS[name]
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
