"""Pieces of rewards, to weight and add up: `Tracking() + 0.1 * Heading() - 0.02 * ActionRate()`.

A piece is a function of a `View` that returns a number per flight, (n,). Sums, differences and
multiples of pieces are pieces. The rewards that ship are such sums: `TRACKING`, and `RACING` for
gates.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.task import reward_and_endings as shipped
from quad_gym.params import checks as check
from quad_gym.records import Ending

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

Floats = NDArray[np.float64]

BLOCKS = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
"""Blocks of the filter's covariance."""

_CRASHES = (
    *(Ending.OUT_OF_BOUNDS, Ending.TIPPED_OVER, Ending.BELOW_MIN_HEIGHT),
    *(Ending.COLLISION, Ending.LEFT_GEOFENCE),
)
_CRASHED = np.array([float(ending in _CRASHES) for ending in range(max(Ending) + 1)])


class Term:
    """A term of a reward; called with a view, it returns (n,)."""

    def __call__(self, view: "View") -> Floats:
        """(n,) its value in this step."""
        raise NotImplementedError

    def __add__(self, other: Any) -> "Term":
        return Sum(_terms(self) + _terms(other))

    def __radd__(self, other: Any) -> "Term":
        return Sum(_terms(other) + _terms(self))

    def __sub__(self, other: Any) -> "Term":
        return self + -1.0 * _piece(other)

    def __rsub__(self, other: Any) -> "Term":
        return _piece(other) + -1.0 * self

    def __neg__(self) -> "Term":
        return -1.0 * self

    def __mul__(self, weight: float) -> "Term":
        factor = check.number("weight", weight)
        return Sum(tuple((factor * w, piece) for w, piece in _terms(self)))

    __rmul__ = __mul__


Weighted = tuple[float, Term]


@dataclass(frozen=True)
class Sum(Term):
    """Pieces with weights."""

    terms: tuple[Weighted, ...]

    def __call__(self, view: "View") -> Floats:
        """(n,) their sum."""
        (weight, piece), *rest = self.terms
        total = weight * piece(view)
        for weight, piece in rest:
            total += weight * piece(view)
        return total


@dataclass(frozen=True)
class Constant(Term):
    """The same in every step; what a number in a sum becomes."""

    value: float = 1.0

    def __call__(self, view: "View") -> Floats:
        """(n,) the value."""
        return np.full(view.count, self.value)


@dataclass(frozen=True)
class FunctionTerm(Term):
    """What a function of a view returns; what a function in a sum becomes."""

    function: "Callable[[View], Floats]"

    def __call__(self, view: "View") -> Floats:
        """(n,) what it returns."""
        return self.function(view)


def _piece(value: Any) -> Term:
    if isinstance(value, Term):
        return value
    return FunctionTerm(value) if callable(value) else Constant(check.number("piece", value))


def _terms(value: Any) -> tuple[Weighted, ...]:
    piece = _piece(value)
    return piece.terms if isinstance(piece, Sum) else ((1.0, piece),)


@dataclass(frozen=True)
class Tracking(Term):
    """exp(-rate e): 1 on the reference, falling with the true distance e from it."""

    rate: float = 2.0
    """[1/m]"""

    def __call__(self, view: "View") -> Floats:
        """(n,) in [0, 1]."""
        return np.exp(-self.rate * view.position_error)


@dataclass(frozen=True)
class Heading(Term):
    """x_B . x*: 1 where body x points in the wanted direction, -1 where it points away."""

    def __call__(self, view: "View") -> Floats:
        """(n,) in [-1, 1]."""
        return _dot(view.truth.forward, view.reference_heading)


@dataclass(frozen=True)
class ActionRate(Term):
    """`|a - a_last|^2`: how much the action has changed."""

    def __call__(self, view: "View") -> Floats:
        """(n,) at least 0."""
        change = view.action - view.last_action
        return _dot(change, change)


@dataclass(frozen=True)
class BodyRates(Term):
    """`|w|^2` of the true body rates [rad^2/s^2]."""

    def __call__(self, view: "View") -> Floats:
        """(n,) at least 0."""
        return _dot(view.body_rates, view.body_rates)


@dataclass(frozen=True)
class Progress(Term):
    """Speed toward the reference; on a course, toward the gate that was next [m/s]."""

    def __call__(self, view: "View") -> Floats:
        """(n,)."""
        return view.truth.progress * 1.0


@dataclass(frozen=True)
class GatePassed(Term):
    """One over the control period where a gate was passed, as one per gate and second [1/s]."""

    def __call__(self, view: "View") -> Floats:
        """(n,)."""
        return view.gate_passed / view.period


@dataclass(frozen=True)
class Crash(Term):
    """1 where the id's task finds that the vehicle has crashed, else 0."""

    def __call__(self, view: "View") -> Floats:
        """(n,) 0 or 1."""
        return _CRASHED[view.builtin.ending]


@dataclass(frozen=True)
class Uncertainty(Term):
    """How unsure the filter is of a block of its state."""

    of: str = "position"
    """one of BLOCKS"""
    measure: str = "trace"
    """"trace" of its covariance, the sum of variances; or "log_det", the logarithm of its
    determinant: of the squared volume of its ellipsoid"""

    def __post_init__(self) -> None:
        check.choice("of", self.of, BLOCKS)
        check.choice("measure", self.measure, ("trace", "log_det"))

    def __call__(self, view: "View") -> Floats:
        """(n,) in squared units of the block, or the logarithm of their cube."""
        if self.measure == "trace":
            sigma = getattr(view.estimate, f"{self.of}_sigma")
            return _dot(sigma, sigma)
        return np.asarray(np.linalg.slogdet(getattr(view.estimate, f"{self.of}_covariance"))[1])


@dataclass(frozen=True)
class Visibility(Term):
    """How many features the camera faces."""

    def __call__(self, view: "View") -> Floats:
        """(n,) whole numbers."""
        return view.truth.features_in_view.sum(axis=1).astype(np.float64)


def _dot(a: Floats, b: Floats) -> Floats:
    """(n,) products of rows, which have at least three columns."""
    # whole columns, whose sums have the same bits however the arrays lie in memory; the first
    # column comes last, as it always has: another order would change the last bits of rewards
    first, second, third, *others = (a * b).T
    total = second + third
    for column in (*others, first):
        total += column
    return total


_COSTS = shipped.ACTION_COST * ActionRate() + shipped.RATE_COST * BodyRates()
_HEADING = shipped.HEADING_WEIGHT * Heading()

TRACKING: Term = (
    shipped.NEAR_WEIGHT * Tracking(2.0) + shipped.FINE_WEIGHT * Tracking(20.0) + _HEADING - _COSTS
)
"""The reward that ships for all tasks but courses of gates."""

RACING: Term = (
    shipped.PROGRESS_WEIGHT * Progress() + shipped.GATE_BONUS * GatePassed() + _HEADING - _COSTS
)
"""The reward that ships for courses of gates."""
