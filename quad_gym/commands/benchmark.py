"""Measure the speed of all parts: filter, tick, options, environments, tasks, compilation, peers.

    quad-gym benchmark
    quad-gym benchmark --only interfaces --n-envs 256
    quad-gym benchmark --only compile

A time is the best of several repeats, because other load on the machine can only increase it;
"spread" is the excess of the median. All ratios are measured within one run. The sections suites,
compile, filters and learning take minutes and run only with `--only`. Learning trains the compiled
PPO with ten seeds, and reports when each was first better than tuned PD control; filters compares
the built-in filters and `--estimators` on the same flights.

Progress goes to stderr, tables go to stdout, and everything goes to benchmark.json with the
configuration, the versions and the processor. Run it on an idle machine.
"""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from quad_gym.analysis.linear_sensors import SuiteModel
from quad_gym.analysis.reports import require_writable, versions, write_json
from quad_gym.commands.options import SuiteNames, require_at_least, usage_errors
from quad_gym.estimation.own import Estimator
from quad_gym.experiments.benchmark import (
    comparison,
    compiling,
    filter,
    filters,
    interfaces,
    learning,
    machine,
    options,
    own_task,
    stages,
    suites,
)
from quad_gym.experiments.benchmark.timing import Effort, Row, Scope
from quad_gym.kernels.cores import available_cores
from quad_gym.params import checks as check
from quad_gym.params.suites import sensor_suite
from quad_gym.records import WIDTH

ALONE = ("suites", "compile", "filters", "learning")  #: sections that take minutes


@dataclass(frozen=True)
class BenchmarkArgs:
    """Options of the benchmark."""

    only: Literal[
        "all",
        "filter",
        "filters",
        "tick",
        "suites",
        "busy",
        "peers",
        "options",
        "interfaces",
        "tasks",
        "compile",
        "learning",
    ] = "all"
    """section to run; all: every section but suites, compile, filters and learning"""
    batch: int = 256
    """number of flights in the batches of filter, filters, tick and options, a multiple of eight"""
    n_envs: int = 1024
    """number of environments in the batches of interfaces, of flights in suites and busy"""
    threads: int | None = None
    """largest number of threads; if not given, one per core"""
    seeds: int = 10
    """number of training seeds of learning"""
    steps: int | None = None
    """number of environment steps of each training of learning; if not given, the recipe's"""
    sensors: SuiteNames = ("standard", "rtk", "consumer", "indoor")
    estimators: tuple[str, ...] = ()
    """own estimators among filters, module:Class each"""
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
    def scope(self) -> Scope:
        """Extent of the measurements."""
        return Scope(
            batch=self.batch,
            envs=self.n_envs,
            threads=available_cores() if self.threads is None else self.threads,
            seeds=self.seeds,
            steps=self.steps,
            effort=Effort(2, 0.01) if self.quick else Effort(self.repeats, self.seconds),
            quick=self.quick,
            suites=self.sensors,
            estimators=self.estimators,
        )


SECTIONS = {
    "filter": filter.SECTION,
    "filters": filters.SECTION,
    "tick": stages.SECTION,
    "suites": suites.SECTION,
    "busy": suites.BUSY,
    "peers": comparison.SECTION,
    "options": options.SECTION,
    "interfaces": interfaces.SECTION,
    "tasks": own_task.SECTION,
    "compile": compiling.SECTION,
    "learning": learning.SECTION,
}


def chosen_sections(args: BenchmarkArgs) -> list[str]:
    """Names of the sections to run."""
    whole = [name for name in SECTIONS if name not in ALONE]
    return whole if args.only == "all" else [args.only]


def main(args: BenchmarkArgs) -> None:
    """Run the chosen sections."""
    with usage_errors():
        require_writable("--output", args.output)
        for name in args.sensors:
            SuiteModel(sensor_suite(name))
        for name in args.estimators:
            check.own("--estimators", name, Estimator)
    cpu = machine.processor()
    print(f"{cpu['model']}, {cpu['cores']} cores for this process.\n")
    sections: dict[str, list[Row]] = {}
    for name in chosen_sections(args):
        print(f"{name}:", file=sys.stderr, flush=True)
        sections[name] = SECTIONS[name].measure(args.scope)
        print(SECTIONS[name].table(sections[name]), end="\n\n", flush=True)
    found = {
        "sections": sections,
        "configuration": dataclasses.asdict(args),
        "processor": cpu,
        "versions": versions("numpy", "numba", "gymnasium", "stable-baselines3", "filterpy"),
    }
    print(f"Wrote {write_json(args.output / 'benchmark.json', found)}.")
