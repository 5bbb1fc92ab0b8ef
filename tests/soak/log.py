"""Log of the soak, docs/data/soak.csv, with a row for each kind of each run, and its summary."""

import csv
import datetime
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from docs.renewal.pages import ROOT, table

FILE = ROOT / "docs/data/soak.csv"
GOAL = 24  #: processor time that the soak shall have [h]
MEMORY_LIMIT = 20.0
"""Largest growth of the resident memory in 1,000 cases, and of a shorter run [MB]"""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A run of one kind."""

    date: str  #: day, UTC
    commit: str  #: with a plus sign if files had changed
    processor: str
    lanes: int
    kind: str
    first: int  #: number of the first case
    cases: int
    seconds: float  #: processor time [s]
    refused: int  #: cases whose input was refused by name
    differing: int  #: cases that failed
    growth: float  #: resident memory at the end minus the memory after the warm-up [MB]
    grown_in: int  #: number of cases between the two
    failure: str  #: number and message of the first failure

    @property
    def grows(self) -> bool:
        """True if the memory has grown beyond the limit."""
        return self.growth > MEMORY_LIMIT * max(1.0, self.grown_in / 1000)


COLUMNS = tuple(field.name for field in fields(Row))


def read(file: Path = FILE) -> list[Row]:
    """Return the rows of a log; none if there is no file."""
    if not file.exists():
        return []
    with file.open(encoding="utf-8", newline="") as stream:
        kinds = {field.name: field.type for field in fields(Row)}
        return [Row(**{n: kinds[n](v) for n, v in row.items()}) for row in csv.DictReader(stream)]


def append(row: Row, file: Path = FILE) -> None:
    """Append a row to a log."""
    new = not file.exists()
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(asdict(row))


def next_case(kind: str, rows: Iterable[Row]) -> int:
    """Return the number after the last case of a kind."""
    return max((row.first + row.cases for row in rows if row.kind == kind), default=0)


def today() -> str:
    """Return the day, UTC."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def commit() -> str:
    """Return the commit of the checkout, with a plus sign if files other than the log differ."""

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        command = ["git", "-C", str(ROOT), *words]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    changed = git("diff", "--quiet", "HEAD", "--", ".", f":(exclude){FILE.relative_to(ROOT)}")
    found = git("rev-parse", "--short=8", "HEAD").stdout.strip()
    return f"{found}{'+' * (changed.returncode != 0)}" if found else "unknown"


# --------------------------------------------------------------------------------------------------
# Summary: the texts of the page.
# --------------------------------------------------------------------------------------------------

HEADS = ("kind", "cases", "refused by name", "processor time", "failed", "growth of memory")


def texts(rows: Sequence[Row] | None = None) -> dict[str, str]:
    """Return the texts between marks: a sentence and a table."""
    rows = read() if rows is None else rows
    if not rows:
        return {"soak": "The log has no run yet.", "soak.kinds": "\n"}
    by_kind: dict[str, list[Row]] = {}
    for row in rows:
        by_kind.setdefault(row.kind, []).append(row)
    return {"soak": sentence(rows), "soak.kinds": table(HEADS, map(_line, by_kind.items()))}


def sentence(rows: Sequence[Row]) -> str:
    """Return total, period, machines and failures as sentences."""
    hours = sum(row.seconds for row in rows) / 3600.0
    days = sorted({row.date for row in rows})
    period = f"on {days[0]}" if len(days) == 1 else f"from {days[0]} to {days[-1]}"
    machines = " and ".join(sorted({f"{row.processor} ({row.lanes} lanes)" for row in rows}))
    failed, cases = sum(row.differing for row in rows), sum(row.cases for row in rows)
    ended = f"{cases:,} cases ran {period}, on {machines}, and {failed:,} of them failed"
    return f"The log has {hours:.2f} of {GOAL} h of processor time: {ended}."


def _line(found: tuple[str, list[Row]]) -> list[str]:
    kind, rows = found
    seconds, grown_in = sum(row.seconds for row in rows), sum(row.grown_in for row in rows)
    growth = sum(row.growth for row in rows)
    return [
        kind.replace("_", " "),
        f"{sum(row.cases for row in rows):,}",
        f"{sum(row.refused for row in rows):,}",
        f"{seconds / 60.0:,.1f} min",
        f"{sum(row.differing for row in rows):,}",
        f"{growth:+.1f} MB in {grown_in:,} cases" if grown_in else "",
    ]
