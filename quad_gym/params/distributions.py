"""Distributions of randomized parameters, and the form in which the kernel reads them."""

import math
from dataclasses import field
from typing import Annotated, Any, NamedTuple

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.checked import Checked
from quad_gym.records import LOG_UNIFORM, NORMAL, UNIFORM

FARTHEST = 8.3
"""Standard deviations beyond which no draw lies: its probability is a multiple of 2^-53."""


class Affine(NamedTuple):
    """A distribution in the form that the kernel reads; u is uniform on (0, 1)."""

    kind: int  #: UNIFORM: a + b u; LOG_UNIFORM: a e^(b u); NORMAL: a + b Phi^-1(c + d u)
    a: float
    b: float
    c: float = 0.0
    d: float = 1.0


class Distribution(Checked, kw_only=False):
    """Distribution of a parameter, absolute or relative to its nominal value."""

    relative: bool = field(default=False, kw_only=True)
    """True: the draw is multiplied by the nominal value"""
    offset: bool = field(default=False, kw_only=True)
    """True: the draw is added to the nominal value"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.relative and self.offset:
            raise ValueError(f"{type(self).__name__} must be relative or an offset, not both")

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest possible draw."""
        raise NotImplementedError

    def placed(self, factor: float, shift: float) -> Affine:
        """Return the distribution of `factor` times the draw plus `shift`."""
        raise NotImplementedError

    @property
    def center_and_spread(self) -> tuple[float, float]:
        """Center of the distribution, and half of its range."""
        low, high = self.support
        return 0.5 * (low + high), 0.5 * (high - low)


class _Between(Distribution, kw_only=False):
    """Distribution on [low, high]."""

    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low > self.high:
            self._refuse("low", "be at most its high", f"{self.low:g} and {self.high:g}")

    @property
    def support(self) -> tuple[float, float]:
        """Bounds of the distribution."""
        return self.low, self.high


class Uniform(_Between, kw_only=False):
    """Uniform distribution on [low, high]."""

    def placed(self, factor: float, shift: float) -> Affine:
        """Return the uniform distribution between the transformed bounds."""
        return Affine(UNIFORM, factor * self.low + shift, factor * (self.high - self.low))


class LogUniform(_Between, kw_only=False):
    """Log-uniform distribution on [low, high], above 0: for scales that are known to a factor."""

    low: check.Positive
    high: check.Positive

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.offset:
            raise ValueError("LogUniform.offset must be False: log-uniform draws are factors")

    def placed(self, factor: float, shift: float) -> Affine:
        """Return the log-uniform distribution between the multiplied bounds."""
        return Affine(LOG_UNIFORM, factor * self.low, portable.log(self.high / self.low))


def _bound(name: str, value: Any) -> float:
    """`value` as a float, which may be infinite."""
    if not (isinstance(value, (int, float, np.number)) and not math.isnan(value)):
        raise ValueError(f"{name} must be a number, got {value!r}")
    return float(value)


class Normal(Distribution, kw_only=False):
    """Normal distribution with mean and standard deviation `sigma`, truncated to [low, high]."""

    mean: float
    sigma: check.Positive
    low: Annotated[float, _bound] = -math.inf
    high: Annotated[float, _bound] = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._probabilities[1] < 1e-6:
            raise ValueError(
                "Normal.low and Normal.high must enclose a probability of at least 1e-6, got "
                f"[{self.low:g}, {self.high:g}] for mean {self.mean:g} and sigma {self.sigma:g}"
            )

    @property
    def _probabilities(self) -> tuple[float, float]:
        """Probability of a draw below `low`, and of one between the bounds."""
        below, under = (
            0.5 * portable.erfc((self.mean - bound) / (self.sigma * math.sqrt(2.0)))
            for bound in (self.low, self.high)
        )
        return below, under - below

    @property
    def support(self) -> tuple[float, float]:
        """Bounds of the truncated distribution, or the least and the largest draw without any."""
        reach = FARTHEST * self.sigma
        return max(self.low, self.mean - reach), min(self.high, self.mean + reach)

    @property
    def center_and_spread(self) -> tuple[float, float]:
        """Mean and standard deviation before truncation."""
        return self.mean, self.sigma

    def placed(self, factor: float, shift: float) -> Affine:
        """Return the transformed normal distribution with the same truncated tails."""
        below, between = self._probabilities
        return Affine(NORMAL, factor * self.mean + shift, factor * self.sigma, below, between)
