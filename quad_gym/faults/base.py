"""What all faults share: when they come and go, their sizes and directions."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked, Vector
from quad_gym.params.portable import norm
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FaultKind

__all__ = ["Fault", "Span", "ends"]

_SENSORS = {"gnss": "GNSS"}
"""Parts of a suite that take no article."""

Span = float | tuple[float, float]
"""A number, or the ends of a range from which it is drawn uniformly each time a fault comes."""


def ends(value: Span) -> tuple[float, float]:
    """Both ends of a range; of a number, twice the number."""
    return value if isinstance(value, tuple) else (value, value)


def span(name: str, value: Any, *, least: float = 0.0, open_end: bool = False) -> Span:
    """`value` as a finite number of at least `least`, or as a range (low, high) of such."""
    if isinstance(value, (tuple, list, np.ndarray)):
        if len(value) != 2:
            raise ValueError(f"{name} must be a number or (low, high), got {value!r}")
        low, high = (check.number(name, end, least=least, open_end=open_end) for end in value)
        if low > high:
            raise ValueError(f"{name} must be (low, high) in this order, got {value!r}")
        return low, high
    return check.number(name, value, least=least, open_end=open_end)


def share_of_one(name: str, value: Any) -> float:
    """`value` as a number above 0 and up to 1."""
    share = check.positive(name, value)
    if share > 1.0:
        raise ValueError(f"{name} must be at most 1, got {value!r}")
    return share


@dataclass(frozen=True, kw_only=True)
class Fault(Checked):
    """When a fault comes and goes; what it is, the kinds of faults below say.

    By default it lasts from the start of an episode to its end. All that is random is drawn inside
    the kernels, from each flight's own stream. A flight has one fault of each kind, which may come
    again and again (`rate`).
    """

    start: Span = 0.0
    """when it comes, since the start of the episode [s]"""
    duration: Span = math.inf
    """how long it stays [s]"""
    rate: float = 0.0
    """how often it comes while it is not there, in place of `start`: at random, as a Poisson
    process [1/s]; 0: once, at `start`"""
    probability: float = 1.0
    """share of episodes in which it can come at all"""

    kind: ClassVar[FaultKind]
    needs: ClassVar[str] = ""
    """the part of a sensor suite that it concerns"""

    def __post_init__(self) -> None:
        if type(self) is Fault:
            raise ValueError("faults must be of a kind, such as GnssOutage, got a bare Fault")
        self._check(span, "start")
        if not (isinstance(self.duration, float) and self.duration == math.inf):
            self._check(span, "duration", open_end=True)
        self._check(check.number, "rate", least=0.0)
        self._check(share_of_one, "probability")
        if self.rate > 0.0 and self.start != 0.0:
            raise ValueError(
                f"{type(self).__name__} takes start or rate, not both, got start={self.start} and "
                f"rate={self.rate}"
            )

    @property
    def name(self) -> str:
        """As `info["faults"]` calls it."""
        return self.kind.name.lower()

    @property
    def numbers(self) -> dict[str, Any]:
        """What kernels read of a fault beside its times.

        Under "share", "size" (a Span) and "direction" what each kind has of its own; under any
        other name a field of the settings record.
        """
        return {}

    def check_suite(self, sensors: SensorSuite) -> None:
        """Refuse a sensor suite that lacks what the fault concerns.

        Raises:
            ValueError: If it does.
        """
        if self.needs and getattr(sensors, self.needs) is None:
            what = _SENSORS.get(self.needs, f"a {self.needs}")
            raise ValueError(
                f"faults must concern sensors that there are: {type(self).__name__} needs {what}, "
                f"which this sensor suite does not have"
            )


@dataclass(frozen=True, kw_only=True)
class DirectedFault(Fault):
    """A fault with a size and a direction, drawn uniformly from all directions unless given."""

    direction: Vector | None = None
    """(3,) along which it lies, of any length; None: drawn each time it comes"""

    size_field: ClassVar[str] = "size"
    """which field is its size"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.direction is not None:
            self._check(check.vector, "direction", length=3)
            if not any(self.direction):
                raise ValueError(f"{type(self).__name__}.direction must not be zero")
        self._check(span, self.size_field, open_end=True)

    @property
    def numbers(self) -> dict[str, Any]:
        """What kernels read of it."""
        return {"size": getattr(self, self.size_field), "direction": self.unit}

    @property
    def unit(self) -> np.ndarray:
        """(3,) the given direction as a unit vector; zeros: drawn."""
        given = np.zeros(3) if self.direction is None else np.array(self.direction)
        return given / (norm(given) or 1.0)
