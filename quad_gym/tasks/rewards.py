"""Terms of rewards, to weight and add up: `Tracking() + 0.1 * Heading() - 0.02 * ActionRate()`.

A term is a function of a `View` that returns one number per flight, (n,). Sums, differences and
multiples of terms are terms. The built-in rewards are such sums: `TRACKING`, and `RACING` for
courses of gates.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.params.portable import exp_of
from quad_gym.params.task import RewardParams
from quad_gym.records import Ending

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

Floats = NDArray[np.float64]

BLOCKS = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
"""Blocks of the filter's covariance."""

_CRASHES = (
    Ending.OUT_OF_BOUNDS,
    Ending.TIPPED_OVER,
    Ending.BELOW_MIN_HEIGHT,
    Ending.COLLISION,
    Ending.LEFT_GEOFENCE,
)
_CRASHED = np.array([float(ending in _CRASHES) for ending in range(max(Ending) + 1)])


class Term:
    """Term of a reward; called with a view, it returns its values (n,)."""

    def __call__(self, view: "View") -> Floats:
        """Return the value of the term in this step, (n,)."""
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
    """Weighted sum of terms."""

    terms: tuple[Weighted, ...]
    """Pairs of a weight and a term"""

    def __call__(self, view: "View") -> Floats:
        (weight, piece), *rest = self.terms
        total = weight * piece(view)
        for weight, piece in rest:
            total += weight * piece(view)
        return total


@dataclass(frozen=True)
class Constant(Term):
    """Constant term; numbers in sums are converted to it."""

    value: float = 1.0
    """Value in every step"""

    def __call__(self, view: "View") -> Floats:
        return np.full(view.count, self.value)


@dataclass(frozen=True)
class FunctionTerm(Term):
    """Term computed by a function of a view; functions in sums are converted to it."""

    function: "Callable[[View], Floats]"
    """Function that takes a `View` and returns (n,)"""

    def __call__(self, view: "View") -> Floats:
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
    """exp(-rate e) of the true position error e: 1 on the reference, decreasing with distance."""

    rate: float = 2.0
    """Rate of decay with distance [1/m]"""

    def __call__(self, view: "View") -> Floats:
        return exp_of(-self.rate * view.position_error)


@dataclass(frozen=True)
class Heading(Term):
    """Alignment of body x with the desired heading, x_B . x*: 1 if aligned, -1 if opposite."""

    def __call__(self, view: "View") -> Floats:
        return _dot(view.truth.forward, view.reference_heading)


@dataclass(frozen=True)
class ActionRate(Term):
    """Squared change of the action, `|a - a_last|^2`."""

    def __call__(self, view: "View") -> Floats:
        change = view.action - view.last_action
        return _dot(change, change)


@dataclass(frozen=True)
class BodyRates(Term):
    """Squared norm of the true body rates, `|w|^2` [rad^2/s^2]."""

    def __call__(self, view: "View") -> Floats:
        return _dot(view.body_rates, view.body_rates)


@dataclass(frozen=True)
class Progress(Term):
    """True speed toward the reference; on a course, toward the gate that was next [m/s]."""

    def __call__(self, view: "View") -> Floats:
        return view.truth.progress * 1.0


@dataclass(frozen=True)
class GatePassed(Term):
    """1 / control period in a step that passes a gate, else 0 [1/s].

    Multiplied by the control period, it adds up to one per gate.
    """

    def __call__(self, view: "View") -> Floats:
        return view.gate_passed / view.period


@dataclass(frozen=True)
class Crash(Term):
    """1 in a step in which the built-in task ends the episode with a crash, else 0."""

    def __call__(self, view: "View") -> Floats:
        return _CRASHED[view.builtin.ending]


@dataclass(frozen=True)
class Uncertainty(Term):
    """Uncertainty of a block of the filter's state, computed from its covariance."""

    of: str = "position"
    """Block of the state, one of `BLOCKS`"""
    measure: str = "trace"
    """Measure of uncertainty. "trace": trace of the covariance, the sum of variances; "log_det":
    logarithm of its determinant, which is proportional to the squared volume of the covariance
    ellipsoid"""

    def __post_init__(self) -> None:
        check.choice("of", self.of, BLOCKS)
        check.choice("measure", self.measure, ("trace", "log_det"))

    def __call__(self, view: "View") -> Floats:
        """Return the measure, (n,).

        Its unit is the squared unit of the block for "trace"; for "log_det" it is the logarithm of
        a number in the sixth power of that unit.
        """
        if self.measure == "trace":
            sigma = getattr(view.estimate, f"{self.of}_sigma")
            return _dot(sigma, sigma)
        return np.asarray(np.linalg.slogdet(getattr(view.estimate, f"{self.of}_covariance"))[1])


@dataclass(frozen=True)
class Visibility(Term):
    """Number of features in the camera's field of view that no obstacle hides."""

    def __call__(self, view: "View") -> Floats:
        return view.truth.features_in_view.sum(axis=1).astype(np.float64)


def _dot(a: Floats, b: Floats) -> Floats:
    """Dot products of the rows of two arrays with at least three columns, (n,)."""
    # column by column: the bits of these sums do not depend on the memory layout; the first column
    # is added last because another order would change the last bits of rewards
    first, second, third, *others = (a * b).T
    total = second + third
    for column in (*others, first):
        total += column
    return total


_W = RewardParams()
_COMMON = _W.heading * Heading() - (_W.action_rate * ActionRate() + _W.body_rates * BodyRates())

TRACKING: Term = _W.near * Tracking(_W.near_decay) + _W.fine * Tracking(_W.fine_decay) + _COMMON
"""Built-in reward of all tasks except courses of gates, per step, with its default weights."""

RACING: Term = _W.progress * Progress() + _W.gate_passed * GatePassed() + _COMMON
"""Built-in reward for courses of gates, per step, with its default weights."""
