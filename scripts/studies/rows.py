"""Rows of studies: the numbers of one policy in its test episodes, and intervals from them.

`docs/data/NAME.csv` has a row for each arm, number of steps and training seed, so that every
interval and conclusion can be computed again. A fixed rule has one row without a seed.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quad_gym.analysis.metrics import (
    Estimated,
    center_of,
    half_width,
    rate_over_trainings,
    variance_of,
)
from scripts.studies.scores import SIGNIFICANT, difference, permutation_p

RATES = ("success", "crashed")  #: columns that are shares of episodes

FIRST = (
    "arm",
    "label",
    "seed",
    "steps",
    "episodes",
    *RATES,
    "return",
    "return_sd",
    "seconds",
    "flights",
)
"""First columns of a file. `return_sd` is the standard deviation over episodes, `seconds` the
processor time of the training, `flights` the digest of the golden flights."""


@dataclass(frozen=True)
class Rows:
    """Rows of one study, each a mapping from columns to values."""

    rows: Sequence[Mapping[str, Any]]

    @classmethod
    def read(cls, file: Path) -> "Rows":
        """Read a file; one that does not exist has no rows."""
        if not file.exists():
            return cls(())
        with file.open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            missing = sorted(set(FIRST) - set(reader.fieldnames or ()))
            if missing:
                raise ValueError(f"{file} must have a column {missing[0]}, and one row per seed")
            return cls([{name: _value(name, text) for name, text in row.items()} for row in reader])

    def write(self, file: Path) -> None:
        """Write a file, sorted by steps, arm in order of appearance, and seed."""
        places = {arm: k for k, arm in enumerate(dict.fromkeys(row["arm"] for row in self.rows))}
        ordered = sorted(
            self.rows, key=lambda row: (row["steps"] or 0, places[row["arm"]], row["seed"] or 0)
        )
        more = dict.fromkeys(name for row in ordered for name in row if name not in FIRST)
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow([*FIRST, *more])
            for row in ordered:
                writer.writerow([_text(row.get(name)) for name in (*FIRST, *more)])

    def of(self, arm: str, steps: int | None = None) -> "Rows":
        """Rows of an arm, trained with a number of steps unless None."""
        chosen = [row for row in self.rows if row["arm"] == arm]
        if steps is not None:
            chosen = [row for row in chosen if row["steps"] in (steps, None)]
        return Rows(chosen)

    def where(self, **columns: Any) -> "Rows":
        """Rows with these values of columns."""
        wanted = columns.items()
        return Rows([row for row in self.rows if all(row.get(k) == v for k, v in wanted)])

    @property
    def seeds(self) -> int:
        """Number of rows, so of trainings of an arm."""
        return len(self.rows)

    @property
    def steps(self) -> int:
        """Number of steps of the trainings of an arm."""
        return int(self.rows[0]["steps"])

    @property
    def trained(self) -> bool:
        """True for an arm with trainings, False for a fixed rule."""
        return self.rows[0]["seed"] is not None

    @property
    def label(self) -> str:
        """Label of the arm."""
        return str(self.rows[0]["label"])

    @property
    def episodes(self) -> int:
        """Number of test episodes of each policy."""
        return int(self.rows[0]["episodes"])

    def values(self, column: str) -> list[float]:
        """Values of a column."""
        return [float(row[column]) for row in self.rows]

    def estimated(self, column: str) -> Estimated:
        """Mean over trainings with a 95 % interval that covers trainings and episodes.

        A rate has the interval of `rate_over_trainings`. Of a return, the half width is the root of
        the sum of squares of Student's t of the trainings and of the episodes. Trainings share
        their episodes, so that the variance over these does not shrink with their number. Another
        column has Student's t interval of the trainings.
        """
        if not self.rows:
            raise ValueError(f"rows must have at least one training for {column}, got none")
        x = np.array(self.values(column))
        if column in RATES:
            return rate_over_trainings(x, self.episodes)
        half, s, value = 0.0, len(x), center_of(x)
        if s > 1:
            half = half_width(variance_of(x) / s, s - 1)
        if column == "return":
            sd, e = np.array(self.values("return_sd")), self.episodes
            half = math.hypot(half, half_width(float((sd**2).mean()) / e, e - 1))
        return Estimated(value, value - half, value + half)


class Effect(NamedTuple):
    """Difference between arms, first less second, with its interval and p value."""

    size: Estimated
    p: float | None
    """of the permutation test over trainings; None where an arm is a fixed rule"""

    @property
    def significant(self) -> bool:
        """True if p is below `SIGNIFICANT`; of a fixed rule, if the interval excludes zero."""
        return not self.size.holds(0.0) if self.p is None else self.p < SIGNIFICANT

    def scaled(self, factor: float) -> "Effect":
        """Effect in another unit, or with the other sign."""
        value, *ends = (factor * number for number in self.size)
        return Effect(Estimated(value, min(ends), max(ends)), self.p)


def effect(first: Rows, second: Rows, column: str = "success") -> Effect:
    """Difference of a column between two arms, first less second."""
    return mean_effect([(first, second)], column)


def mean_effect(pairs: Sequence[tuple[Rows, Rows]], column: str = "success") -> Effect:
    """Mean of the effects of several independent pairs; the interval is the MOVER."""
    found = [difference(a.estimated(column), b.estimated(column)) for a, b in pairs]
    n, p = len(found), None
    value = sum(each.value for each in found) / n
    below = math.hypot(*(each.value - each.low for each in found)) / n
    above = math.hypot(*(each.high - each.value for each in found)) / n
    if all(each.trained for pair in pairs for each in pair):
        p = permutation_p([(a.values(column), b.values(column)) for a, b in pairs])
    return Effect(Estimated(value, value - below, value + above), p)


_TEXTS, _WHOLE = ("arm", "label", "task", "suite", "flights"), ("seed", "steps", "episodes")


def _value(name: str, text: str) -> Any:
    if name in _TEXTS:
        return text
    if text == "":
        return None
    return int(text) if name in _WHOLE else float(text)


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.10g}" if isinstance(value, float) else str(value)
