"""Measure the speed of parts: filters, stages, tasks, compilation, learning, peers.

    python -m scripts.benchmarks filter
    python -m scripts.benchmarks filters --batch 64 --sensors rtk --estimators mine:Simple

All ratios are measured within one run; see `quad-gym benchmark` for the rest. Learning trains the
compiled PPO with ten seeds, and reports when each was first better than tuned PD control; filters
compares the built-in filters and `--estimators` on the same flights; peers measures other
simulators as far as they are installed; precision compares single with double precision, by turns.
"""

from dataclasses import dataclass
from typing import Literal

from tyro.conf import Positional

from quad_gym.analysis.reports import require_writable
from quad_gym.batch.own_estimator import Estimator
from quad_gym.commands.benchmark import BenchmarkArgs, run_sections
from quad_gym.commands.options import SuiteNames, parse, quiet_end, require_at_least, usage_errors
from quad_gym.params import checks as check
from quad_gym.params.suites import sensor_suite
from quad_gym.records import WIDTH
from scripts.benchmarks import (
    comparison,
    compiling,
    filter,
    filters,
    learning,
    own_task,
    precision,
    stages,
)
from scripts.benchmarks.linear_sensors import SuiteModel
from scripts.benchmarks.scope import Scope

SECTIONS = {
    "filter": filter.SECTION,
    "filters": filters.SECTION,
    "tick": stages.SECTION,
    "peers": comparison.SECTION,
    "tasks": own_task.SECTION,
    "compile": compiling.SECTION,
    "learning": learning.SECTION,
    "precision": precision.SECTION,
}

SectionName = Literal[
    "filter", "filters", "tick", "peers", "tasks", "compile", "learning", "precision"
]


@dataclass(frozen=True)
class PartsArgs(BenchmarkArgs):
    """Options of the benchmark of parts."""

    section: Positional[SectionName] = "filter"
    """section to run"""
    batch: int = 256
    """number of flights in the batches of filter, filters and tick, a multiple of eight"""
    seeds: int = 10
    """number of training seeds of learning"""
    steps: int | None = None
    """number of environment steps of each training of learning; defaults to the recipe's"""
    sensors: SuiteNames = ("standard", "rtk", "consumer", "indoor")
    estimators: tuple[str, ...] = ()
    """own estimators among filters, module:Class each"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        super().__post_init__()
        require_at_least(self, batch=1, seeds=1, steps=1)
        if self.batch % WIDTH:
            raise ValueError(f"--batch must be a multiple of {WIDTH}, got {self.batch}")


def main(args: PartsArgs) -> None:
    """Run a section."""
    with usage_errors():
        require_writable("--output", args.output)
        for name in args.sensors:
            SuiteModel(sensor_suite(name))
        for name in args.estimators:
            check.own("--estimators", name, Estimator)
    scope = Scope(
        **args.extent,
        batch=args.batch,
        seeds=args.seeds,
        steps=args.steps,
        quick=args.quick,
        suites=args.sensors,
        estimators=args.estimators,
    )
    run_sections({args.section: SECTIONS[args.section]}, scope, args)


if __name__ == "__main__":
    with quiet_end():
        main(parse(PartsArgs, prog="python -m scripts.benchmarks", description=__doc__))
