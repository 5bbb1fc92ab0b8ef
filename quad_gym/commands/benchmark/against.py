"""Two checkouts compared: the same environments by turns, each in a process of its own.

Other load on the machine slows both alike, and the best of all turns counts, so that ratios are
valid even where times are not.
"""

import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

from quad_gym.analysis.reports import text_table
from quad_gym.commands.benchmark.timing import Effort, Row, by_turns, percent

WORKER = Path(__file__).resolve().parent / "worker.py"
HERE = Path(__file__).resolve().parents[3]
FEWEST_TURNS = 5


class RefusedError(Exception):
    """A checkout could not do what it was asked."""


class Checkout:
    """A process that steps environments of one checkout.

    Args:
        folder: The checkout.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self._process = subprocess.Popen(
            [sys.executable, str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(self.folder)},
        )

    def __enter__(self) -> "Checkout":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.communicate()

    def ask(self, **question: Any) -> Any:
        """The answer of the process.

        Raises:
            RefusedError: If it failed.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(question) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except OSError:
            line = ""
        if not line:
            raise RuntimeError(f"the process of {self.folder} has ended")
        found = json.loads(line)
        if "error" in found:
            raise RefusedError(found["error"])
        return found["answer"]


def rows_to_compare(envs: int, threads: int, suite: str) -> list[Row]:
    """What is compared: the interfaces at 50 Hz, and the vector interface at 200 Hz."""
    rows: list[Row] = []
    for rate, interfaces in ((50, ("vector", "sb3", "single")), (200, ("vector",))):
        for observation in ("estimate", "truth", "measurements"):
            for interface in interfaces:
                count, most = (1, 1) if interface == "single" else (envs, threads)
                options = {"observation": observation, "control_rate": rate, "sensors": suite}
                name = f"{interface}, {observation}, {rate} Hz, {suite}"
                rows.append({"name": name, "interface": interface, "envs": count, "threads": most})
                rows[-1] |= {"suite": suite, "options": options}
    return rows


def common_suite(checkouts: tuple[Checkout, Checkout]) -> str:
    """The suite that both fly: the default one, or the laboratory's where one lacks it."""
    for checkout in checkouts:
        file = Path(checkout.ask(suite="lab")).resolve()
        if checkout.folder not in file.parents:
            raise RuntimeError(f"quad_gym of {checkout.folder} is not used, but {file}")
    try:
        for checkout in checkouts:
            checkout.ask(suite="standard")
    except RefusedError:
        return "lab"
    return "standard"


def time_against(folder: Path, envs: int, threads: int, effort: Effort) -> list[Row]:
    """Steps of environments here and of another checkout, by turns.

    Args:
        folder: The other checkout.
        envs: Environments in a batch.
        threads: Most threads.
        effort: How long to measure; a repeat is a turn of each.
    """
    found = []
    with Checkout(HERE) as here, Checkout(folder) as there:
        both = (here, there)
        for row in rows_to_compare(envs, threads, common_suite(both)):
            try:
                longest = max(checkout.ask(make=row) for checkout in both)
                calls = max(1, round(effort.seconds / longest))
                jobs = [partial(checkout.ask, calls=calls) for checkout in both]
                mine, others = by_turns(jobs, max(effort.repeats, FEWEST_TURNS))
            except RefusedError as error:
                print(f"  {row['name']}: left out: {error}", file=sys.stderr, flush=True)
                continue
            best, other = (timing.per(row["envs"]).best for timing in (mine, others))
            found.append({**row, "seconds": best, "other": other, "ratio": best / other})
            found[-1]["spread"] = max(mine.spread, others.spread)
            print(f"  {row['name']}: {best / other:.3f}", file=sys.stderr, flush=True)
    return found


def against_table(rows: list[Row]) -> str:
    """The comparison's figures."""
    cells = [
        (
            r["name"],
            f"{r['envs']:,}",
            str(r["threads"]),
            f"{1e6 * r['seconds']:,.3f}",
            f"{1e6 * r['other']:,.3f}",
            f"{r['ratio']:.3f}",
            percent(r["spread"]),
        )
        for r in rows
    ]
    columns = ["interface, observation, control, suite", "envs", "threads", "here", "there"]
    heading = "A step of one flight [us], here and of the other checkout"
    return text_table({heading: [*columns, "here / there", "spread"]}, cells)
