"""Measure the effects of filter corrections and of model mismatch.

  quad-gym ablation models    true vehicle, world and sensors that differ from the model
  quad-gym ablation filters   UKF and EKF, and the UKF without each correction

All cases fly the same seeds. The table has the normalized estimation error squared (NEES) of the
state and of each part (15 and 3 for a consistent filter), and the errors. It is printed, and
written with the configuration to TABLE.json.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from quad_gym import sensor_suite
from quad_gym.analysis.consistency_flights import ASTRAY
from quad_gym.analysis.reports import require_writable, versions, write_json
from quad_gym.commands.options import SuiteName, Threads, require_at_least, usage_errors
from quad_gym.experiments.consistency import ablation
from quad_gym.experiments.consistency.cases import CaseFlights


@dataclass(frozen=True)
class AblationArgs:
    """Options of the tables."""

    table: Positional[Literal["models", "filters"]] = "models"
    """table to compute"""
    sensors: SuiteName = "rtk"
    episodes: int = 1000
    """number of flights in each case"""
    seed: int = 0
    """seed of the first flight; the others have consecutive seeds"""
    duration: float = 10.0
    """length of a flight [s]"""
    filter_start: Literal["cold", "warm"] = "cold"
    """start of the filter"""
    output: Path = Path("results/ablation")
    """folder for the numbers"""
    threads: Threads = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_at_least(self, episodes=2, seed=0, threads=1)
        least = ablation.SETTLED + 0.1
        if not (math.isfinite(self.duration) and self.duration >= least):
            raise ValueError(f"--duration must be at least {least:g} s, got {self.duration:g}")


def main(args: AblationArgs) -> None:
    """Fly all cases, and print and write the table."""
    with usage_errors():
        cases = ablation.cases_of(args.table, sensor_suite(args.sensors), args.filter_start)
        for case in cases:
            case.batch(8, 1)  # rejects invalid cases before any flight
        require_writable("--output", args.output)
    flights = CaseFlights(args.episodes, args.seed, args.duration, args.threads)
    rows = ablation.run_ablation(args.table, cases, flights)
    print(
        f"{args.episodes:,} flights of {args.duration:g} s on random trajectories, suite "
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
    print(f"\nWrote {write_json(args.output / f'{args.table}.json', found)}.")
