"""Run random cases for some minutes of processor time, and append the result to a log.

    python -m tests.soak --minutes 60                      # all kinds, the next cases of the log
    python -m tests.soak --minutes 5 --kinds snapshots
    python -m tests.soak --case damaged_logs 1234          # one case again, with its traceback

Each case follows from its kind and its number. A case fails if numbers differ by a bit, an error is
not a ValueError with a sentence, the process crashes, or a case takes a quarter of an hour. A run
also fails if its resident memory grows by more than 20 MB in 1,000 cases. The kinds share the time
equally, each in its own process. The exit code is 1 after a failure, which is in the row of the
log. Cases compare:

"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from quad_gym.commands.options import parse, quiet_end, require_at_least
from quad_gym.params import checks as check
from tests.soak import log
from tests.soak.cases import generator
from tests.soak.kinds import KINDS
from tests.soak.running import Run

ABOUT = __doc__ + "\n".join(f"- {name}: {kind.about}" for name, kind in KINDS.items())


@dataclass(frozen=True)
class SoakArgs:
    """Options of the soak."""

    minutes: float = 10.0
    """processor time of all kinds together [min]"""
    kinds: tuple[str, ...] = tuple(KINDS)
    """kinds of cases"""
    seed: int | None = None
    """number of the first case; defaults to the one after the last case of a kind in the log"""
    case: tuple[str, int] | None = None
    """kind and number of one case to run here, without an entry in the log"""
    log: Path = log.FILE
    """file (.csv) to which each kind appends its row"""

    def __post_init__(self) -> None:
        """Check names and numbers."""
        require_at_least(self, seed=0)
        check.number("--minutes", self.minutes, least=0.0)
        for name in (*self.kinds, *(self.case or ())[:1]):
            check.choice("--kinds" if name in self.kinds else "--case", name, tuple(KINDS))
        if self.case is not None:
            check.whole("--case", self.case[1], least=0)


def main(args: SoakArgs) -> int:
    """Run the cases of each kind; return the exit code."""
    if args.case is not None:
        name, number = args.case
        refused = KINDS[name].run(generator(name, number))
        print(f"{name} {number}: {'refused by name' if refused else 'no difference'}")
        return 0
    runs, failed = [], False
    for name in args.kinds:
        if missing := KINDS[name].missing():
            print(f"{name} are left out, as this machine lacks {', '.join(missing)}.")
        else:
            runs.append(name)
    with _bar(60.0 * args.minutes) as bar:
        for name in runs:
            first = log.next_case(name, log.read(args.log)) if args.seed is None else args.seed
            row = Run(name, KINDS[name], first, 60.0 * args.minutes / len(runs), bar).row()
            log.append(row, args.log)
            failed |= row.differing > 0 or row.grows
            bar.write(sentence(row))
    return int(failed)


@contextmanager
def _bar(seconds: float) -> Iterator[Any]:
    """Progress bar of processor time."""
    look = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s of processor time{postfix}"
    with tqdm(total=seconds, desc="soak", bar_format=look, mininterval=1.0) as bar:
        yield bar


def sentence(row: log.Row) -> str:
    """Return the result of a run in a line."""
    numbers = f"{row.cases:,} cases from {row.first}, {row.refused:,} of them refused by name"
    memory = f"memory {row.growth:+.1f} MB in {row.grown_in:,} cases"
    ended = f"{row.differing:,} failed" if row.differing else "no difference"
    why = f"\n  {row.failure}" if row.failure else ""
    return f"{row.kind}: {numbers}, {row.seconds:,.0f} s, {ended}, {memory}{why}"


if __name__ == "__main__":
    with quiet_end():
        sys.exit(main(parse(SoakArgs, prog="python -m tests.soak", description=ABOUT)))
