"""Measure the speed of flights on this machine: environments, and a tick with each sensor suite.

    quad-gym benchmark
    quad-gym benchmark --only interfaces --n-envs 256

A time is the best of several repeats, because other load on the machine can only increase it. The
column "spread" is the excess of the median. The suites take a minute. Progress goes to stderr,
tables go to stdout, and everything goes to benchmark.json with the configuration, the versions and
the processor. Run it on an idle machine.
"""

import dataclasses
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from quad_gym.analysis.reports import require_writable, versions, write_json
from quad_gym.commands.options import require_at_least, usage_errors
from quad_gym.experiments.benchmark import interfaces, suites
from quad_gym.experiments.benchmark.timing import Effort, Row, Scope, Section, processor
from quad_gym.kernels.cores import available_cores


@dataclass(frozen=True)
class BenchmarkArgs:
    """Options of the benchmark."""

    only: Literal["all", "interfaces", "suites"] = "all"
    """section to run"""
    n_envs: int = 1024
    """number of environments in the batches of interfaces, of flights in suites"""
    threads: int | None = None
    """largest number of threads; defaults to one per core"""
    quick: bool = False
    """two short repeats of each measurement, to check that it runs"""
    output: Path = Path("results/benchmark")
    """folder for benchmark.json"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_at_least(self, n_envs=1, threads=1)

    @property
    def extent(self) -> dict[str, Any]:
        """Fields of the `Scope`."""
        threads = available_cores() if self.threads is None else self.threads
        effort = Effort(2, 0.01) if self.quick else Effort(7, 0.3)
        return {"envs": self.n_envs, "threads": threads, "effort": effort}


SECTIONS = {"interfaces": interfaces.SECTION, "suites": suites.SECTION}


def main(args: BenchmarkArgs) -> None:
    """Run the chosen sections."""
    names = list(SECTIONS) if args.only == "all" else [args.only]
    with usage_errors():
        require_writable("--output", args.output)
    run_sections({name: SECTIONS[name] for name in names}, Scope(**args.extent), args)


def run_sections(sections: Mapping[str, Section], scope: Scope, args: BenchmarkArgs) -> None:
    """Run sections, print their tables, and write benchmark.json."""
    cpu = processor()
    print(f"{cpu['model']}, {cpu['cores']} cores for this process.\n")
    rows: dict[str, list[Row]] = {}
    for name, section in sections.items():
        print(f"{name}:", file=sys.stderr, flush=True)
        rows[name] = section.measure(scope)
        print(section.table(rows[name]), end="\n\n", flush=True)
    found = {
        "sections": rows,
        "configuration": dataclasses.asdict(args),
        "processor": cpu,
        "versions": versions("numpy", "numba", "gymnasium", "stable-baselines3", "filterpy"),
    }
    print(f"Wrote {write_json(args.output / 'benchmark.json', found)}.")
