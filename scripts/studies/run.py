"""Run everything behind the conclusions of the pages, and continue where it stopped.

    python -m scripts.studies run --all                    # all tables
    python -m scripts.studies run --all --jobs 2           # in two processes
    python -m scripts.studies run --tables look_around     # one of them
    python -m scripts.studies run --all --parts "Circle: PPO" indoor   # some parts
    python -m scripts.studies run --all --list             # remaining rows and core hours
    python -m scripts.studies run --all --write            # write the rows so far into docs/data

Work is done in the order of `scripts/studies/parts.py`, so that the most important conclusions are
complete first, at the lowest priority of the processor. Stop it with Ctrl-C, and start the same
command again to continue. Whenever a part is complete, its rows are written into docs/data. Rows in
docs/data that were measured on the present flights are not measured again, so that one machine
continues what another one began. After a change of the flights everything begins again, in another
folder.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from quad_gym.commands import options
from quad_gym.experiments import stopped
from scripts.estimate_bench.rows import PARTS as BENCH_PARTS
from scripts.studies.campaign import (
    DATA,
    FLIGHT_SECONDS,
    OUTPUT,
    Cell,
    Part,
    StoppedError,
    is_complete,
    row_key,
    tables,
)
from scripts.studies.parts import PARTS as STUDY_PARTS
from scripts.studies.rows import Rows

PARTS = (*STUDY_PARTS, *BENCH_PARTS)  #: everything, in its order
TABLES = tuple(dict.fromkeys(part.table for part in PARTS))  #: names of the tables

NICENESS = 19  #: the lowest priority, so that other work on the machine goes first


@dataclass(frozen=True)
class RunArgs:
    """Options of the campaign."""

    all: bool = False
    """run all tables"""
    tables: tuple[str, ...] = ()
    """names of tables to run; docs/data/NAME.csv"""
    parts: tuple[str, ...] = ()
    """words of the parts to run, as `--list` names them, such as "Circle: PPO"; all if none"""
    jobs: int = 1
    """number of processes, each with one thread"""
    list: bool = False
    """print the remaining rows and core hours, and stop"""
    write: bool = False
    """write the rows so far into docs/data, and stop"""
    seeds: int | None = None
    """limit of the number of seeds, for a trial"""
    cells: int | None = None
    """stop after this number of cells, for a trial"""
    output: Path = OUTPUT
    """folder of trainings and rows"""


def chosen_parts(args: RunArgs) -> list[Part]:
    """Parts that the options name, in their order."""
    if args.all == bool(args.tables):
        raise ValueError(f"run must have --all or --tables, of {', '.join(TABLES)}")
    for name in args.tables:
        if name not in TABLES:
            raise ValueError(f"--tables must be of {', '.join(TABLES)}, got {name}")
    tables = [part for part in PARTS if args.all or part.table in args.tables]
    parts = [p for p in tables if not args.parts or any(words in p.decides for words in args.parts)]
    if not parts:
        raise ValueError(
            f"--parts must have words of a part that --list prints, got {', '.join(args.parts)}"
        )
    return parts


def cells_of(parts: Sequence[Part], root: Path, seeds: int | None = None) -> list[Cell]:
    """All cells in their order, with at most a number of seeds."""
    return [
        cell
        for part in parts
        for cell in part.cells(root)
        if seeds is None or cell.seed is None or cell.seed < seeds
    ]


def hours_left(cells: Sequence[Cell]) -> float:
    """Estimate the core hours of the cells that are not done, by the cells like them that are."""
    measured: dict[tuple[str, ...], list[float]] = {}
    left = []
    for cell in cells:
        row, kind = cell.row, (cell.part.table, cell.arm.name, str(cell.trains))
        if row is None:
            left.append((cell, kind))
        else:
            spent = row["seconds"] + row.get("flown_in", FLIGHT_SECONDS)
            measured.setdefault(kind, []).append(spent / cell.expected_seconds)
    factors = {kind: float(np.median(ratios)) for kind, ratios in measured.items()}
    other = float(np.median(list(factors.values()))) if factors else 1.0
    return sum(c.expected_seconds * factors.get(kind, other) for c, kind in left) / 3600.0


def report(parts: Sequence[Part], root: Path, seeds: int | None = None) -> str:
    """Lines of the remaining rows, part by part."""
    lines, total = [], 0.0
    for part in parts:
        cells = cells_of([part], root, seeds)
        done, hours = sum(cell.row is not None for cell in cells), hours_left(cells)
        total += hours
        state = "complete" if done == len(cells) else f"{hours:.1f} core hours left"
        lines.append(f"{part.decides}: {done} of {len(cells)} rows, {state}")
    return "\n".join([*lines, f"Total: {total:.1f} core hours left"])


def write_tables(parts: Sequence[Part], root: Path, *, partial: bool) -> list[Path]:
    """Write the rows of tables into docs/data.

    Args:
        parts: Parts whose tables are written, with the rows of all parts of these.
        root: Folder of the rows, into which those of docs/data were taken over.
        partial: True: also the rows of incomplete parts; False: of these only the rows that
            docs/data has already.
    """
    written = []
    for table in dict.fromkeys(part.table for part in parts):
        own = [part for part in PARTS if part.table == table]
        cells = cells_of(own, root)
        rows = tables(cells).get(table)
        if rows is None:
            continue
        complete = [part for part in own if is_complete(part, rows)]
        if not partial:
            known = {row_key(row) for row in Rows.read(DATA / f"{table}.csv").rows}
            kept = [cell for cell in cells if cell.part in complete or cell.key in known]
            rows = tables(kept).get(table)
        if rows is not None:
            with FileLock(root / "tables.lock"):  # two processes may complete a part at once
                rows.write(DATA / f"{table}.csv")
            written.append(DATA / f"{table}.csv")
    return written


def take_over(cells: Sequence[Cell]) -> int:
    """Take the rows over that docs/data has of cells, or of equal cells of another table.

    Returns:
        Number of rows that were taken over.
    """
    known = {
        table: {row_key(row): row for row in Rows.read(DATA / f"{table}.csv").rows}
        for table in TABLES
    }
    count, left = 0, []
    for cell in cells:
        if cell.row is not None:
            continue
        row = known[cell.part.table].get(cell.key)
        if row is None:
            left.append(cell)
        else:
            cell.write(row)
            count += 1
    measured = {
        cell.definition: row
        for cell in cells_of(PARTS, OUTPUT)
        if (row := known[cell.part.table].get(cell.key)) is not None
    }
    for cell in left:
        row = measured.get(cell.definition)
        if row is not None:
            cell.write(cell.relabeled(row))
            count += 1
    return count


def work(cells: Sequence[Cell], limit: int | None = None) -> None:
    """Complete cells one after the other, except for those in work elsewhere."""
    count = 0
    for cell in cells:
        if cell.row is not None:
            continue
        if limit is not None and count >= limit:
            break
        # arms that fly the policies of another share its training, and so its lock
        where = cell.file.parent if cell.training is None else cell.training.folder
        where.mkdir(parents=True, exist_ok=True)
        with suppress(Timeout), FileLock(where / "cell.lock", timeout=0):
            if cell.row is None:
                row = cell.run()
                count += 1
                print(
                    f"{cell.name}: success {row['success']:.1%}, crashed "
                    f"{row['crashed']:.1%}; {hours_left(cells):.1f} core hours left",
                    flush=True,
                )


def main(args: RunArgs) -> int:
    """Run the campaign; returns the exit code."""
    with options.usage_errors():
        parts = chosen_parts(args)
        options.require_at_least(args, jobs=1, seeds=1, cells=1)
    written = {part.table for part in parts}  # whole, even if some of their parts are chosen
    take_over(cells_of([part for part in PARTS if part.table in written], args.output))
    if args.list:
        print(report(parts, args.output, args.seeds))
        return 0
    if args.write:
        for file in write_tables(parts, args.output, partial=True):
            print(f"Wrote {file}")
        return 0
    os.nice(max(0, NICENESS - os.nice(0)))
    print(report(parts, args.output, args.seeds), flush=True)
    helpers = [subprocess.Popen(_words(args)) for _ in range(args.jobs - 1)]
    try:
        for part in parts:
            cells = cells_of([part], args.output, args.seeds)
            work(cells, args.cells)
            if all(cell.row is not None for cell in cells):
                write_tables([part], args.output, partial=False)
        for helper in helpers:
            helper.wait()
        if helpers:  # cells whose training was in work elsewhere when their turn came
            work(cells_of(parts, args.output, args.seeds), args.cells)
    except (StoppedError, KeyboardInterrupt):
        for helper in helpers:
            helper.terminate()
            helper.wait()
        return stopped()
    write_tables(parts, args.output, partial=False)
    print(report(parts, args.output, args.seeds))
    return 0


def _words(args: RunArgs) -> list[str]:
    """Command of a further process."""
    names = ["--all"] if args.all else ["--tables", *args.tables]
    more = ["--parts", *args.parts] if args.parts else []
    more += [] if args.seeds is None else ["--seeds", str(args.seeds)]
    return [
        sys.executable,
        "-m",
        "scripts.studies",
        "run",
        *names,
        *more,
        "--output",
        str(args.output),
    ]
