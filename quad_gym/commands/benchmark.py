"""Measure the speed of all parts: filter, tick, options, environments, rendering, compilation.

    quad-gym benchmark
    quad-gym benchmark --only interfaces --n-envs 256
    quad-gym benchmark --only compile

A time is the best of several repeats, because other load on the machine can only increase it;
"spread" is the excess of the median. All ratios are measured within one run. The sections compile
and learning take minutes and run only with `--only`; learning trains the compiled PPO with ten
seeds, and reports when each was first better than tuned PD control.

Progress goes to stderr, tables go to stdout, and everything goes to benchmark.json with the
configuration, the versions and the processor. Run it on an idle machine.
"""

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from quad_gym.analysis.reports import require_writable, versions, write_json
from quad_gym.commands.options import require_at_least, usage_errors
from quad_gym.experiments.benchmark import (
    compiling,
    filter,
    interfaces,
    learning,
    machine,
    options,
    own_task,
    rendering,
    stages,
)
from quad_gym.experiments.benchmark.timing import Effort, Row
from quad_gym.kernels.compiling.cores import available_cores
from quad_gym.records import WIDTH

ALONE = ("compile", "learning")
"""Sections that take minutes."""


@dataclass(frozen=True)
class Args:
    """Options of the benchmark."""

    only: Literal[
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
    ] = "all"
    """section to run; all: every section but compile and learning"""
    batch: int = 256
    """number of flights in the batches of filter, tick and options, a multiple of eight"""
    n_envs: int = 1024
    """number of environments in the batches of interfaces"""
    threads: int | None = None
    """largest number of threads; if not given, one per core"""
    seeds: int = 10
    """number of training seeds of learning"""
    steps: int | None = None
    """number of environment steps of each training of learning; if not given, the recipe's"""
    quick: bool = False
    """two short repeats instead of --repeats and --seconds, to check that it runs"""
    repeats: int = 7
    """number of repeats of each measurement, of which the best counts"""
    seconds: float = 0.3
    """length of a repeat [s]"""
    output: Path = Path("results/benchmark")
    """folder for benchmark.json"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_at_least(self, batch=1, n_envs=1, repeats=1, seeds=1, steps=1, threads=1)
        if self.batch % WIDTH:
            raise ValueError(f"--batch must be a multiple of {WIDTH}, got {self.batch}")
        if not self.seconds > 0.0:
            raise ValueError(f"--seconds must be above 0, got {self.seconds}")

    @property
    def effort(self) -> Effort:
        """Number and length of the repeats."""
        return Effort(2, 0.01) if self.quick else Effort(self.repeats, self.seconds)

    @property
    def most_threads(self) -> int:
        """Largest number of threads."""
        return available_cores() if self.threads is None else self.threads


SECTIONS: dict[str, tuple[Callable[[Args], list[Row]], Callable[[list[Row]], str]]] = {
    "filter": (
        lambda args: filter.time_filter(args.batch, args.effort, 5 if args.quick else 40),
        filter.filter_table,
    ),
    "tick": (lambda args: stages.time_tick(args.batch, args.effort), stages.tick_table),
    "options": (lambda args: options.time_options(args.batch, args.effort), options.options_table),
    "interfaces": (
        lambda args: interfaces.time_interfaces(args.n_envs, args.most_threads, args.effort),
        interfaces.interfaces_table,
    ),
    "tasks": (
        lambda args: own_task.time_own_task(args.effort, args.most_threads),
        own_task.own_task_table,
    ),
    "memory": (lambda args: machine.measure_memory(args.quick), machine.memory_table),
    "rendering": (lambda args: rendering.time_rendering(args.effort), rendering.rendering_table),
    "compile": (lambda args: compiling.time_compile(args.quick), compiling.compile_table),
    "learning": (
        lambda args: learning.time_learning(args.seeds, args.steps, args.most_threads, args.quick),
        learning.learning_table,
    ),
}
"""Functions that measure the rows of each section and format them."""


def chosen_sections(args: Args) -> list[str]:
    """Names of the sections to run."""
    whole = [name for name in SECTIONS if name not in ALONE]
    return whole if args.only == "all" else [args.only]


def main(args: Args) -> None:
    """Run the chosen sections."""
    with usage_errors():
        require_writable("--output", args.output)
    cpu = machine.processor()
    print(f"{cpu['model']}, {cpu['cores']} cores for this process.\n")
    sections: dict[str, list[Row]] = {}
    for name in chosen_sections(args):
        print(f"{name}:", file=sys.stderr, flush=True)
        time_section, table = SECTIONS[name]
        sections[name] = time_section(args)
        print(table(sections[name]), end="\n\n", flush=True)
    found = {
        "sections": sections,
        "configuration": dataclasses.asdict(args),
        "processor": cpu,
        "versions": versions("numpy", "numba", "gymnasium", "stable-baselines3", "filterpy"),
    }
    print(f"Wrote {write_json(args.output / 'benchmark.json', found)}.")
