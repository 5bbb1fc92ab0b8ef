"""Fly the policies of the studies again, in other episodes, and compare them with their rows.

    python -m scripts.studies again                     # all rows whose policies are here
    python -m scripts.studies again --parts StaleRace   # only some parts
    python -m scripts.studies again --write             # also write docs/data/again.csv

Each fixed rule, and each policy whose training is in the folder of the studies, flies episodes that
neither its training nor the row has flown. Prints the rate of success and of crashes for each arm
and the row, and whether it lies within the interval of the page.
"""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from baselines.recipes import first_seed
from quad_gym.commands import options
from scripts.studies.campaign import DATA, EPISODES, FIRST_EPISODE, OUTPUT, Cell, Part
from scripts.studies.rows import RATES, Rows
from scripts.studies.run import RunArgs, chosen_parts

FILE = "again.csv"
NAMES = ("table", "task", "suite", "arm", "steps", "flights")
"""Columns that name an arm; rows of an arm differ in their seeds."""
COLUMNS = (*NAMES, "seed", "episodes", *RATES)
SECOND_EPISODE = FIRST_EPISODE + EPISODES  #: seed of the first of the other episodes


@dataclass(frozen=True)
class AgainArgs:
    """Options of flying again."""

    tables: tuple[str, ...] = ()
    """names of tables; all if none"""
    parts: tuple[str, ...] = ()
    """words of the parts, as `run --all --list` names them; all if none"""
    episodes: int = 300
    """number of episodes of each policy"""
    output: Path = OUTPUT
    """folder of trainings and rows"""
    write: bool = False
    """write the rows into docs/data/again.csv, and replace earlier ones of these policies"""


def cells(parts: Sequence[Part], root: Path) -> Iterator[Cell]:
    """Cells with a row and a policy to fly."""
    for part in parts:
        for cell in part.cells(root):
            here = cell.training is None or Path(cell.training.best).exists()
            if cell.row is not None and here:
                yield cell


def fly(cell: Cell, episodes: int) -> dict[str, Any]:
    """Fly the policy of a cell in other episodes; returns a row of `COLUMNS`."""
    first = first_seed("test", SECOND_EPISODE, episodes)
    trial = replace(cell.trial, episodes=episodes, first_episode=first)
    policy = cell.arm.policy if cell.training is None else cell.training.best
    assert policy is not None
    flown = trial.flown(policy)
    row = {name: (cell.row or {}).get(name) for name in (*NAMES, "seed")}
    success, crashed = cell.study.about.success(flown), flown.episodes.crashed
    rates = {"success": float(success.mean()), "crashed": float(crashed.mean())}
    return {**row, "table": cell.part.table, "episodes": episodes, **rates}


# ---- rows and their comparison -------------------------------------------------------------------


def read(folder: Path = DATA) -> list[dict[str, Any]]:
    """Rows of the file; none if it does not exist."""
    file = folder / FILE
    if not file.exists():
        return []
    with file.open(encoding="utf-8", newline="") as stream:
        found = list(csv.DictReader(stream))
    return [{name: _value(name, row[name]) for name in COLUMNS} for row in found]


def write(rows: Sequence[Mapping[str, Any]], folder: Path = DATA) -> Path:
    """Write rows, which replace earlier ones of these policies."""
    found = {_key(row): row for row in (*read(folder), *rows)}
    with (folder / FILE).open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for key in sorted(found):
            row = {name: found[key].get(name) for name in COLUMNS}
            writer.writerow({name: "" if x is None else x for name, x in row.items()})
    return folder / FILE


@dataclass(frozen=True)
class Compared:
    """Rate of an arm in the rows' episodes and in the others, with the same trainings."""

    name: str
    column: str
    trainings: int
    trained: bool
    """False for a fixed rule"""
    rate: float
    """in the others"""
    value: float
    """mean of these trainings' rows"""
    low: float
    """of the page's interval, over all trainings"""
    high: float
    sigma: float
    """standard deviation of the difference over episodes, where all policies fly the same"""

    @property
    def within(self) -> bool:
        """True if the rate lies within the interval of the page."""
        return self.low <= self.rate <= self.high


def compared(again: Sequence[Mapping[str, Any]], folder: Path = DATA) -> list[Compared]:
    """Compare rows with the tables; rows of other flights are left out."""
    found: list[Compared] = []
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in again:
        groups.setdefault(tuple(row[name] for name in NAMES), []).append(row)
    tables = {row["table"]: Rows.read(folder / f"{row['table']}.csv") for row in again}
    for key, rows in groups.items():
        table, task, suite, arm, steps, flights = key
        labels = {name: x for name, x in (("task", task), ("suite", suite)) if x is not None}
        known = tables[table].where(**labels, flights=flights, arm=arm, steps=steps)
        seeds = {row["seed"] for row in rows}
        same = Rows([row for row in known.rows if row["seed"] in seeds])
        if not same.rows:
            continue
        for column in RATES:
            interval = known.estimated(column)
            rate = math.fsum(row[column] for row in rows) / len(rows)
            value = math.fsum(same.values(column)) / same.seeds
            # with one more failure and success, so that no rate has a deviation of zero
            p = (value * same.episodes + 1.0) / (same.episodes + 2.0)
            sigma = math.sqrt(p * (1.0 - p) * (1.0 / same.episodes + 1.0 / rows[0]["episodes"]))
            name = ", ".join(str(x) for x in (task or table, suite, same.label, steps) if x)
            ends = interval.low, interval.high
            trained = rows[0]["seed"] is not None
            found.append(Compared(name, column, len(rows), trained, rate, value, *ends, sigma))
    return found


def report(again: Sequence[Mapping[str, Any]], folder: Path = DATA) -> str:
    """Lines of the comparison, one for each arm and rate."""
    lines = []
    for one in compared(again, folder):
        where = "within" if one.within else "outside"
        lines.append(
            f"{one.name}: {one.column} {one.rate:.1%} of {one.trainings} policies, {where} "
            f"[{one.low:.1%}, {one.high:.1%}]; {one.value:.1%} in the episodes of the rows"
        )
    return "\n".join(lines)


def texts(folder: Path = DATA) -> dict[str, str]:
    """Sentence about the comparison, by its mark."""
    rows = read(folder)
    found = compared(rows, folder)
    if not found:
        return {"studies.again": "No policy has been flown again with the present flights."}
    trained = [one for one in found if one.trained]
    rules = [one for one in found if not one.trained]
    policies = sum(row["seed"] is not None for row in rows)
    said = (
        f"{policies} policies flew {rows[0]['episodes']} other episodes "
        "(`python -m scripts.studies again`): of the rates of success and of crashes of "
        f"{len(trained) // 2} trained arms, {_share(trained)} lie within the intervals of these "
        "pages."
    )
    if rules:
        worst = max(abs(one.rate - one.value) / one.sigma for one in rules)
        said += (
            f" Of {len(rules) // 2} fixed rules, {_share(rules)} rates do. These differ from their "
            f"rows by at most {worst:.1f} standard deviations of a difference between "
            f"{rows[0]['episodes']} and {EPISODES:,} episodes."
        )
    return {"studies.again": said}


def _share(found: Sequence[Compared]) -> str:
    """How many rates are within the intervals of the pages."""
    return f"{sum(one.within for one in found)} of {len(found)}"


def main(args: AgainArgs) -> int:
    """Fly again; returns the exit code."""
    with options.usage_errors():
        parts = chosen_parts(RunArgs(all=not args.tables, tables=args.tables, parts=args.parts))
        options.require_at_least(args, episodes=1)
    chosen = list(cells(parts, args.output))
    rows = [fly(cell, args.episodes) for cell in tqdm(chosen, unit=" policies")]
    print(report(rows) or "No policy is here. `python -m scripts.studies run` trains them.")
    if args.write:
        print(f"Wrote {write(rows)}")
    return 0


def _key(row: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(str(row.get(name) or "").zfill(9) for name in (*NAMES, "seed"))


def _value(name: str, text: str) -> Any:
    if name in RATES:
        return float(text)
    if name in ("seed", "steps", "episodes"):
        return None if text == "" else int(text)
    return text or None
