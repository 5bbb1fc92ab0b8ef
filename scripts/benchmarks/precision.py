"""Time of flights in single precision, compared with double precision.

A process computes in one precision. Both are measured by turns, each in its own process, so that
other load on the machine affects both.
"""

import os
import statistics
import subprocess
import sys

from quad_gym.commands import benchmark
from quad_gym.commands.benchmark import TRUTH, Effort, Row, flying, measure, ticks_of
from quad_gym.records.sizes import PRECISIONS
from scripts.benchmarks.scope import Scope

TURNS = 3  #: processes in each precision


def seconds_of(precision: str, suite: str, flights: int, effort: Effort) -> float:
    """Time of a tick of one flight, measured by a process in a precision [s]."""
    words = (suite, str(flights), str(effort.repeats), str(effort.seconds))
    done = subprocess.run(
        [sys.executable, "-m", __name__, *words],
        env={**os.environ, "QUAD_GYM_PRECISION": precision},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return float(done.stdout)


def compare(suite: str, scope: Scope) -> Row:
    """Measure flights with a suite, or on the true state, by turns in both precisions."""
    turns = [
        {name: seconds_of(name, suite, scope.envs, scope.effort) for name in PRECISIONS}
        for _ in range(1 if scope.quick else TURNS)
    ]
    seconds = {name: statistics.median(turn[name] for turn in turns) for name in PRECISIONS}
    ratios = [turn["single"] / turn["double"] for turn in turns]
    row = {
        "suite": suite,
        "flights": scope.envs,
        **seconds,
        "ratio": seconds["single"] / seconds["double"],
        "ratios": ratios,
        "smallest": min(ratios),
        "largest": max(ratios),
    }
    print(f"  {suite}: {row['ratio']:.2f}", file=sys.stderr, flush=True)
    return row


def time_precision(scope: Scope) -> list[Row]:
    """Compare flights with each suite, and on the true state."""
    return [compare(suite, scope) for suite in (*scope.suites, TRUTH)]


SECTION = benchmark.Section(
    time_precision,
    {
        "One flight's tick at 50 Hz, medians": {
            "suite": benchmark.column("suite"),
            "flights": benchmark.column("flights", ","),
            "us, double": benchmark.column("double", ".3f", 1e6),
            "us, single": benchmark.column("single", ".3f", 1e6),
        },
        "single / double": {
            "of medians": benchmark.column("ratio", ".2f"),
            "smallest": benchmark.column("smallest", ".2f"),
            "largest": benchmark.column("largest", ".2f"),
        },
    },
)


def main(suite: str, flights: str, repeats: str, seconds: str) -> None:
    """Print the time of a tick of one flight in the precision of this process [s]."""
    batch = flying(int(flights), 1, suite)
    effort = Effort(int(repeats), float(seconds))
    print(measure(batch.step, effort).per(ticks_of(batch)).best)


if __name__ == "__main__":
    main(*sys.argv[1:])
