"""Extent of the measurements of parts."""

from collections.abc import Sequence
from dataclasses import dataclass

from quad_gym.commands import benchmark


@dataclass(frozen=True, kw_only=True)
class Scope(benchmark.Scope):
    """Extent of the measurements."""

    batch: int
    """Number of flights in the batches of filter, filters and tick"""
    seeds: int
    """Number of training seeds"""
    steps: int | None
    """Environment steps of a training; None: as in the recipe"""
    quick: bool
    """True for a check that the sections run"""
    suites: Sequence[str]
    """Suites of filters"""
    estimators: Sequence[str]
    """Own estimators among filters, "module:Class" each"""
