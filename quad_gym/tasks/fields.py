"""Fields of a view: descriptors that compute an array when it is first read."""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.quantities import QUANTITIES
from quad_gym.tasks.memory import ReadableBatch

Floats = NDArray[np.float64]
T = TypeVar("T")


class GroupField(Generic[T]):
    """Read-only value of a `Group`, computed from it by `read` and stored until the next step.

    Shapes: n: flights, m: features of the camera, o: obstacles, k: values of an observation.
    Frames: I: inertial (east, north, up), B: body, C: image; "-": none.
    """

    def __init__(
        self, read: Callable[[Any], T], shape: str, unit: str, frame: str, meaning: str
    ) -> None:
        self._read, self.__doc__ = read, meaning
        self.shape, self.unit, self.frame, self.meaning = shape, unit, frame, meaning

    def __set_name__(self, owner: type, name: str) -> None:
        """Store the name of the attribute."""
        self._name = name

    @overload
    def __get__(self, group: None, owner: type) -> "GroupField[T]": ...

    @overload
    def __get__(self, group: "Group", owner: type) -> T: ...

    def __get__(self, group: "Group | None", owner: type) -> Any:
        """Compute the value and store it as an ordinary attribute of the group."""
        if group is None:
            return self
        group._require()
        return vars(group).setdefault(self._name, frozen(self._read(group)))


def field(
    shape: str, unit: str, frame: str, meaning: str
) -> Callable[[Callable[[Any], T]], GroupField[T]]:
    """Make a field of the method that computes it."""
    return lambda read: GroupField(read, shape, unit, frame, meaning)


_LETTERS = {"features": "m", "obstacles": "o"}


def quantity(name: str, shown: str | None = None) -> GroupField[NDArray[Any]]:
    """Make a field of one of QUANTITIES, from the field `shown` of SHOWN or from the records."""
    q = QUANTITIES[name]
    kind: type[np.generic] = {bool: np.bool_, int: np.int64}.get(q.kind, np.float64)

    def read(group: Group) -> NDArray[Any]:
        if shown is not None:
            return group._flights.shown(shown)
        of = q.of
        return group._flights.rows(of, kind) if isinstance(of, str) else group._flights.read(name)

    sizes = "".join(f" {_LETTERS.get(str(size), size)}," for size in q.shape)
    shape = f"(n,{sizes})".replace(",)", ")") if sizes else "(n,)"
    kinds = "" if q.kind is float else f" {q.kind.__name__}"
    return GroupField(read, shape + kinds, q.unit, q.frame, q.meaning)


def record(name: str, shape: str, unit: str, frame: str, meaning: str) -> GroupField[NDArray[Any]]:
    """Make a field of the flights' records that is not among QUANTITIES."""
    return GroupField(lambda group: group._flights.rows(name), shape, unit, frame, meaning)


def shown(name: str, shape: str, unit: str, frame: str, meaning: str) -> GroupField[Floats]:
    """Make a field of `quad_gym.records.SHOWN` that is not among QUANTITIES."""
    return GroupField(lambda group: group._flights.shown(name), shape, unit, frame, meaning)


def frozen(value: Any) -> Any:
    """Make an array, or the arrays of a dictionary, read-only."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif isinstance(value, dict):
        return MappingProxyType({name: frozen(part) for name, part in value.items()})
    return value


class Group:
    """Group of fields of a view."""

    __slots__ = ("__dict__", "_flights")

    def __init__(self, flights: ReadableBatch) -> None:
        self._flights = flights

    def _require(self) -> None:
        """Raise a ValueError if the configuration lacks the fields of this group."""

    def forget(self) -> None:
        """Drop the stored values."""
        vars(self).clear()

    def __setattr__(self, name: str, value: Any) -> None:
        if name[0] != "_":
            raise AttributeError(f"view.{name} is read-only; store your own data in view.state")
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"view.{name} cannot be deleted")
