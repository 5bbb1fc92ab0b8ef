"""Arrays that are computed when they are first read, and dropped at the next step."""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from quad_gym.records import SHOWN, SHOWN_SHAPES

T = TypeVar("T")


class Lazy(Generic[T]):
    """A read-only array of a `Group`, made by a method when it is first read."""

    def __init__(self, make: Callable[[Any], T]) -> None:
        self._make, self.__doc__ = make, make.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        """Learn what it is called."""
        self._name = name

    @overload
    def __get__(self, group: None, owner: type) -> "Lazy[T]": ...

    @overload
    def __get__(self, group: object, owner: type) -> T: ...

    def __get__(self, group: Any, owner: type) -> Any:
        """Make it; from then on it is an ordinary attribute of the group."""
        if group is None:
            return self
        value = frozen(self._make(group))
        group.__dict__[self._name] = value
        return value


class Shown:
    """An array of a `Group` that the kernels show, see `quad_gym.records.SHOWN`.

    Args:
        name: Which.
        meaning: Shape, meaning, unit and frame.
        first: How many of its numbers, the first ones, as (n, first); None: all of them.
    """

    def __init__(self, name: str, meaning: str, first: int | None = None) -> None:
        rows, self._shape, self.__doc__ = SHOWN[name], SHOWN_SHAPES[name], meaning
        chosen = rows if first is None else slice(rows.start, rows.start + first)
        self._key = (slice(None), chosen if self._shape else rows.start)
        self._is_matrix = len(self._shape) > 1 and first is None

    def __set_name__(self, owner: type, name: str) -> None:
        """Learn what it is called."""
        self._name = name

    @overload
    def __get__(self, group: None, owner: type) -> "Shown": ...

    @overload
    def __get__(self, group: object, owner: type) -> NDArray[np.float64]: ...

    def __get__(self, group: Any, owner: type) -> Any:
        """Take it; from then on it is an ordinary attribute of the group."""
        if group is None:
            return self
        if self._is_matrix:
            # in memory as for a single flight, so that products with it have the same bits
            rows = group._flights.shown[self._key[1]]
            value = np.ascontiguousarray(rows.T).reshape(-1, *self._shape)
            value.setflags(write=False)
        else:
            value = group._flights.shown_of_flights[self._key]
        group.__dict__[self._name] = value
        return value


def frozen(value: Any) -> Any:
    """An array that cannot be written to, or a mapping of them."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
        return value
    if isinstance(value, dict):
        return MappingProxyType({name: frozen(part) for name, part in value.items()})
    return value


class Group:
    """Some arrays of a view. What it knows of the flights is in slots; what it has made, is not."""

    __slots__ = ("__dict__", "_flights")

    def __init__(self, flights: Any) -> None:
        self._flights = flights

    def __setattr__(self, name: str, value: Any) -> None:
        if name[0] != "_":
            raise AttributeError(f"view.{name} is what it is: keep your own in view.state")
        super().__setattr__(name, value)
