"""Run of a kind in its own process, which may crash or hang, and its row in the log."""

import contextlib
import faulthandler
import multiprocessing
import os
import signal
import statistics
from multiprocessing.connection import Connection
from typing import Any

from quad_gym.commands.benchmark import processor
from quad_gym.records.sizes import WIDTH
from tests.soak import log
from tests.soak.cases import Case, Kind, cases

LONGEST = 900.0  #: time after which a case hangs [s]


def work(name: str, kind: Kind, first: int, seconds: float, pipe: Connection) -> None:
    """Run the cases of a kind, and send their results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process ends this one
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)  # of the libraries that read logs
    faulthandler.dump_traceback_later(LONGEST, exit=True)
    for case in cases(name, kind, first, seconds):
        faulthandler.dump_traceback_later(LONGEST, exit=True)
        pipe.send(case)
    pipe.close()


class Run:
    """Run of a kind.

    Args:
        name: Name of the kind.
        kind: The kind.
        first: Number of the first case.
        seconds: Processor time [s].
        bar: Progress bar of processor time.
    """

    def __init__(self, name: str, kind: Kind, first: int, seconds: float, bar: Any) -> None:
        self.name, self.kind, self.first, self.seconds, self.bar = name, kind, first, seconds, bar

    def row(self) -> log.Row:
        """Run all cases; return the row of the log. An interruption ends the run early."""
        context = multiprocessing.get_context("spawn")
        mine, other = context.Pipe(duplex=False)
        told = self.name, self.kind, self.first, self.seconds, other
        process = context.Process(target=work, args=told)
        process.start()
        other.close()
        found: list[Case] = []
        interrupted = False
        try:
            with contextlib.suppress(EOFError):
                while True:
                    found.append(mine.recv())
                    self._show(found)
        except KeyboardInterrupt:
            interrupted = True
            process.terminate()
        process.join()
        ended = "" if interrupted or process.exitcode == 0 else self._crash(found, process.exitcode)
        return row_of(self.name, self.first, found, ended)

    def _show(self, found: list[Case]) -> None:
        before = found[-2].seconds if len(found) > 1 else 0.0
        self.bar.update(min(found[-1].seconds - before, self.bar.total - self.bar.n))
        failed = sum(bool(case.failure) for case in found)
        self.bar.set_postfix_str(f"{self.name}, {failed} failed", refresh=False)

    def _crash(self, found: list[Case], code: int | None) -> str:
        hung = f" (1 after {LONGEST:g} s: the case hung)" if code == 1 else ""
        return f"{self.first + len(found)}: the process ended with the exit code {code}{hung}"


def row_of(name: str, first: int, found: list[Case], crash: str = "") -> log.Row:
    """Return the row of a run; a crash is one more case, which failed.

    The first half of the cases is the warm-up, in which compiled stages are loaded. The memory
    after it and at the end are medians of a tenth of the cases.
    """
    failures = [f"{case.number}: {case.failure}" for case in found if case.failure]
    failures += [crash] if crash else []
    half, tenth = len(found) // 2, max(1, len(found) // 10)
    memory = [case.memory for case in found[half:]]
    growth = statistics.median(memory[-tenth:]) - statistics.median(memory[:tenth]) if found else 0
    row = log.Row(
        date=log.today(),
        commit=log.commit(),
        processor=processor()["model"],
        lanes=WIDTH,
        kind=name,
        first=first,
        cases=len(found) + bool(crash),
        seconds=round(found[-1].seconds, 1) if found else 0.0,
        refused=sum(case.refused for case in found),
        differing=len(failures),
        growth=round(growth, 1),
        grown_in=max(0, len(memory) - tenth),
        failure=failures[0] if failures else "",
    )
    if row.grows and not failures:
        limit = f"the limit is {log.MEMORY_LIMIT:g} MB in 1,000 cases"
        return log.Row(**{**vars(row), "failure": f"the memory has grown; {limit}"})
    return row
