"""Piecewise polynomials as numbers, which become a `Trajectory`."""

from collections.abc import Hashable
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
HeadingRule = Literal["given", "along", "toward"]


class Pieces(NamedTuple):
    """Fields of a `Trajectory`, which explains them."""

    times: Floats
    coefficients: Floats
    closed: bool
    heading: HeadingRule
    point: tuple[float, float]


class Reference(Hashable, Protocol):
    """Desired position and heading over time, as functions; `Trajectory` explains them."""

    @property
    def times(self) -> Floats:
        """(m + 1,) times between segments [s]."""

    @property
    def coefficients(self) -> Floats:
        """(8, m, 4) coefficients, the highest power first."""

    @property
    def closed(self) -> bool:
        """True if the reference repeats."""

    def __call__(self, t: ArrayLike, derivative: int = 0) -> Floats:
        """Return the position in I, or one of its derivatives."""

    def yaw(self, t: ArrayLike, derivative: int = 0) -> Floats:
        """Return the heading, or one of its derivatives."""

    def instants(self, count: int) -> Floats:
        """Return `count` times per segment, and the end [s]."""


def derivative(terms: Floats, order: int) -> Floats:
    """Coefficients (8 - order, ...) of a derivative of polynomials, the highest power first."""
    for _ in range(order):
        powers = np.arange(len(terms) - 1, 0, -1, dtype=np.float64)
        terms = terms[:-1] * powers.reshape(-1, *[1] * (terms.ndim - 1))
    return terms
