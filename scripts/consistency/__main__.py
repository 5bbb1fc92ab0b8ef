"""Compute a table of the filter's consistency; one configuration is `quad-gym consistency`.

    python -m scripts.consistency matrix      every suite on every task, and other conditions
    python -m scripts.consistency recovery    every suite with every fault that it can have
    python -m scripts.consistency causes      causes of failures that are not detected, and remedies
    python -m scripts.consistency compass     filters whose compass is wrong from the start
    python -m scripts.consistency filters     UKF and EKF, and the UKF without each correction
    python -m scripts.consistency models      true vehicle, world and sensors that differ

The matrix has means of the normalized squares of errors and innovations (NEES, NIS) from a cold and
from a warm start, and on one task with faults, latencies, mountings, randomization, random starts
and wind; --cells suites leaves these out. The recovery shows how many filters are consistent 10 s
after a fault, how many flag their divergence, and the rate of false alarms. The causes are of
filters that do neither. An interrupted run of these four continues when it is started again.
Filters and models fly the same seeds, and show NEES and errors.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from quad_gym import sensor_suite
from quad_gym.analysis.consistency import ASTRAY
from quad_gym.analysis.reports import require_writable, versions, write_json
from quad_gym.commands.consistency import CaseFlights
from quad_gym.commands.options import (
    SuiteName,
    Threads,
    parse,
    quiet_end,
    require_at_least,
    usage_errors,
)
from scripts.consistency import ablation, causes, compass, matrix, recovery
from scripts.consistency.tables import run_cases, unexpected

RESUMED: dict[str, Any] = {
    "matrix": matrix,
    "recovery": recovery,
    "causes": causes,
    "compass": compass,
}
"""Modules of the tables whose runs continue when they are started again."""


@dataclass(frozen=True)
class TableArgs:
    """Options of the tables."""

    table: Positional[Literal["matrix", "recovery", "causes", "compass", "filters", "models"]]
    """table to compute"""
    episodes: int | None = None
    """number of flights in each case; defaults to 400, or 1000 for filters and models"""
    seed: int = 0
    """seed of the first flight; the others have consecutive seeds"""
    duration: float = 10.0
    """length of a flight [s], but for recovery and causes"""
    cells: Literal["all", "suites", "conditions"] = "all"
    """of matrix: the suites on all tasks, other conditions on one task, or both"""
    sensors: SuiteName = "rtk"
    """suite of filters and models"""
    filter_start: Literal["cold", "warm"] = "cold"
    """start of the filter of filters and models"""
    output: Path | None = None
    """folder for the numbers; defaults to results/consistency_TABLE"""
    threads: Threads = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_at_least(self, episodes=2, seed=0, threads=1)
        least = ablation.SETTLED + 0.1
        if not (math.isfinite(self.duration) and self.duration >= least):
            raise ValueError(f"--duration must be at least {least:g} s, got {self.duration:g}")

    @property
    def folder(self) -> Path:
        """Output folder."""
        return self.output or Path("results") / f"consistency_{self.table}"


def main(args: TableArgs) -> None:
    """Compute a table."""
    with usage_errors():
        require_writable("--output", args.folder)
    count = args.episodes or (400 if args.table in RESUMED else 1000)
    flights = CaseFlights(count, args.seed, args.duration, args.threads)
    if args.table in RESUMED:
        _fly_cells(args, flights)
    else:
        _ablate(args, flights)


def _fly_cells(args: TableArgs, flights: CaseFlights) -> None:
    table = RESUMED[args.table]
    cases = matrix.cases_of(args.cells) if table is matrix else table.cases()
    head = {"duration": args.duration} if table in (matrix, compass) else {}
    files = args.folder / args.table
    found = run_cases(cases, files, flights, table.measure, table.table_of, **head)
    print(f"{len(found)} cells, {unexpected(found)} unexpected misses; see {files}.md.")


def _ablate(args: TableArgs, flights: CaseFlights) -> None:
    with usage_errors():
        cases = ablation.cases_of(args.table, sensor_suite(args.sensors), args.filter_start)
        for case in cases:
            case.batch(8, 1)  # rejects invalid cases before any flight
    rows = ablation.run_ablation(args.table, cases, flights)
    print(
        f"{flights.count:,} flights of {args.duration:g} s on random trajectories, suite "
        f"{args.sensors}, {args.filter_start} start.\n"
    )
    print(ablation.table_of(args.table, rows))
    print(
        f"\nErrors are root mean squares after {ablation.SETTLED:g} s; a flight {ASTRAY:g} m off "
        "its\nreference is astray, and its tracking error does not count."
    )
    found = {
        "rows": rows,
        "cases": [ablation.as_fields(case) for case in cases],
        "configuration": args,
        "seeds": flights.seed_limits,
        "versions": versions("numpy", "numba", "scipy"),
    }
    print(f"\nWrote {write_json(args.folder / f'{args.table}.json', found)}.")


if __name__ == "__main__":
    with quiet_end():
        main(parse(TableArgs, prog="python -m scripts.consistency", description=__doc__))
