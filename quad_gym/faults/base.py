"""The base of all faults: start, duration and rate, sizes and directions."""

import math
import re
from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params.checked import Checked
from quad_gym.params.portable import norm
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FaultKind

__all__ = ["Fault", "Span", "ends"]

_SENSORS = {"gnss": "GNSS"}  #: parts of a suite that are named without an article

Span = float | tuple[float, float]
"""A number, or a range (low, high) from which it is drawn uniformly at each onset of a fault."""


def ends(value: Span) -> tuple[float, float]:
    """Return both ends of a range; for a number, the number twice."""
    return value if isinstance(value, tuple) else (value, value)


def span(name: str, value: Any, *, open_end: bool = False) -> Span:
    """Return `value` as a finite number of at least 0, or as a range (low, high)."""
    if not isinstance(value, (tuple, list, np.ndarray)):
        return check.number(name, value, least=0.0, open_end=open_end)
    if len(value) != 2:
        raise ValueError(f"{name} must be a number or (low, high), got {value!r}")
    low, high = (check.number(name, end, least=0.0, open_end=open_end) for end in value)
    if low > high:
        raise ValueError(f"{name} must be (low, high) in this order, got {value!r}")
    return low, high


def _duration(name: str, value: Any) -> Span:
    """Return `value` as a number above 0, which may be infinite, or as a range of such numbers."""
    endless = isinstance(value, float) and value == math.inf
    return value if endless else span(name, value, open_end=True)


Size = Annotated[Span, partial(span, open_end=True)]


class Fault(Checked):
    """Schedule of a fault; its subclasses are the kinds of faults.

    By default, a fault lasts from the start of an episode to its end. All random quantities are
    drawn inside the kernels, from each flight's own stream. A flight has at most one fault of each
    kind, which may recur (`rate`).
    """

    start: Annotated[Span, span] = 0.0
    """time of onset since the start of the episode [s]; a range: drawn uniformly"""
    duration: Annotated[Span, _duration] = math.inf
    """time from onset to end [s]; a range: drawn uniformly at each onset"""
    rate: check.NonNegative = 0.0
    """rate of onset while inactive, in place of `start`: a Poisson process [1/s]; 0: a single onset
    at `start`"""
    probability: check.UpToOne = 1.0
    """probability that the fault can occur in an episode"""

    kind: ClassVar[FaultKind]
    needs: ClassVar[str] = ""
    """field of the sensor suite that the fault concerns"""

    def __init_subclass__(cls) -> None:
        """Set the kind: the one with the name of the class."""
        super().__init_subclass__()
        name = re.sub("(?<=[a-z])(?=[A-Z])", "_", cls.__name__).upper()
        if name in FaultKind.__members__:
            cls.kind = FaultKind[name]

    def __post_init__(self) -> None:
        if type(self) is Fault:
            raise ValueError("faults must be of a kind, such as GnssOutage, got a bare Fault")
        super().__post_init__()
        if self.rate > 0.0 and self.start != 0.0:
            raise ValueError(
                f"{type(self).__name__} takes start or rate, not both, got start={self.start} and "
                f"rate={self.rate}"
            )

    @property
    def name(self) -> str:
        """Name of the fault in `info["faults"]`."""
        return self.kind.name.lower()

    @property
    def numbers(self) -> dict[str, Any]:
        """Numbers that the kernels read of a fault, in addition to its times.

        "share", "size" (a Span) and "direction" have their own places for each kind; any other name
        is a field of the settings record.
        """
        return {name: getattr(self, name) for name in ("share", "size") if hasattr(self, name)}

    def check_suite(self, sensors: SensorSuite) -> None:
        """Refuse a sensor suite that lacks the sensor of the fault."""
        if self.needs and getattr(sensors, self.needs) is None:
            what = _SENSORS.get(self.needs, f"a {self.needs}")
            raise ValueError(
                f"faults must concern sensors of the suite: {type(self).__name__} needs {what}, "
                f"which this sensor suite does not have"
            )


class DirectedFault(Fault):
    """A fault with a size and a direction, drawn uniformly from all directions by default."""

    direction: check.Vector3 | None = None
    """(3,) direction of the fault, of any length; None: drawn at each onset"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.direction is not None and not any(self.direction):
            raise ValueError(f"{type(self).__name__}.direction must not be zero")

    @property
    def numbers(self) -> dict[str, Any]:
        """Size, and direction (3,) as a unit vector; zeros: drawn."""
        given = np.zeros(3) if self.direction is None else np.array(self.direction)
        return super().numbers | {"direction": given / (norm(given) or 1.0)}
