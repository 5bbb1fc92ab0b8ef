"""Cases of the soak: a number gives each its random choices, and each ends with a result.

A case fails with an exception. Its message and the place are kept for the log.
"""

import gc
import os
import resource
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of cases."""

    run: Callable[[np.random.Generator], bool]
    """function that runs a case, and returns True if its input was refused by name"""
    about: str
    """compared things, as half a sentence"""
    missing: Callable[[], list[str]] = list
    """function that returns the names of programs that this kind needs and the machine lacks"""


@dataclass(frozen=True)
class Case:
    """Result of a case."""

    number: int
    refused: bool
    failure: str  #: empty if nothing differed
    seconds: float  #: processor time since the beginning of the process, with its children [s]
    memory: float  #: resident memory of the process after the case [MB]


def generator(kind: str, number: int) -> np.random.Generator:
    """Random numbers of a case."""
    return np.random.default_rng([*kind.encode(), number])


def processor_seconds() -> float:
    """Processor time of this process and of those that it has started and that have ended."""
    used = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in used)


def resident_memory() -> float:
    """Resident memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE / 1e6


def run_case(name: str, kind: Kind, number: int) -> Case:
    """Run a case, and keep its failure."""
    refused, failure = False, ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of rates, starts and filters that random choices give
        try:
            refused = kind.run(generator(name, number))
        except Exception as error:
            failure = described(error)
    gc.collect()
    return Case(number, refused, failure, processor_seconds(), resident_memory())


def described(error: Exception) -> str:
    """Return kind and message of an error, and the last line of our code that it left."""
    frames = traceback.extract_tb(error.__traceback__)
    last = next((f for f in reversed(frames) if "site-packages" not in f.filename), frames[-1])
    text = " ".join(str(error).split())[:300]
    return f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {text}"


def cases(name: str, kind: Kind, first: int, seconds: float) -> Iterator[Case]:
    """Run cases until their processor time is over, at least one."""
    end, number = processor_seconds() + seconds, first
    while number == first or processor_seconds() < end:
        yield run_case(name, kind, number)
        number += 1
