"""Arrays that are computed when they are first read, and dropped at the next step."""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from quad_gym.records import SHOWN, SHOWN_KINDS, SHOWN_SHAPES

T = TypeVar("T")

Place = tuple[dict[str, Any], str]
"""Where an array is kept: attributes of a group, and its name in them."""


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
        return group._keep(self._name, self._make(group))


class Shown:
    """An array of a `Group` that the kernels show, see `quad_gym.records.SHOWN`.

    It looks into the memory of what is shown, and stays as long as that; a matrix is copied.

    Args:
        name: Which.
        meaning: Shape, meaning, unit and frame.
        part: Which of its numbers, as a vector; None: all of them.
    """

    def __init__(self, name: str, meaning: str, part: slice | None = None) -> None:
        rows, self._shape, self.__doc__ = SHOWN[name], SHOWN_SHAPES[name], meaning
        if part is not None:
            chosen = range(rows.start, rows.stop)[part]
            rows = slice(chosen.start, chosen.stop, chosen.step)
        self._rows = rows if self._shape else rows.start
        self._kind = SHOWN_KINDS[name]
        self._is_matrix = len(self._shape) > 1 and part is None

    def into(self, shown: NDArray[np.float64]) -> NDArray[Any]:
        """(n, ...) looking into what is shown."""
        found = shown[self._rows].T
        if self._is_matrix:
            found = found.reshape(-1, *self._shape)
        return found if self._kind == found.dtype else found.view(self._kind)

    def __set_name__(self, owner: type, name: str) -> None:
        """Learn what it is called."""
        self._name, self._source = name, f"_shown_{name}"

    @overload
    def __get__(self, group: None, owner: type) -> "Shown": ...

    @overload
    def __get__(self, group: object, owner: type) -> NDArray[Any]: ...

    def __get__(self, group: Any, owner: type) -> Any:
        """Take it; from then on it is an ordinary attribute of the group."""
        if group is None:
            return self
        if not self._is_matrix:
            return group._flights.look(self, group.__dict__, self._name)
        shown = group.__dict__.get(self._source)
        if shown is None:
            shown = group._flights.look(self, group.__dict__, self._source)
        # in memory as for a single flight, so that products with it have the same bits
        return group._keep(self._name, shown.copy())


def frozen(value: Any) -> Any:
    """An array that cannot be written to, or a mapping of them."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
        return value
    if isinstance(value, dict):
        return MappingProxyType({name: frozen(part) for name, part in value.items()})
    return value


class Group:
    """Some arrays of a view. What it knows of the flights is in slots; what it has made, is not.

    Args:
        flights: What it shows.
        kept: Where to note the arrays that are dropped at the next step: their places by name.
    """

    __slots__ = ("__dict__", "_flights", "_kept")

    def __init__(self, flights: Any, kept: "list[Place]") -> None:
        self._flights, self._kept = flights, kept

    def _keep(self, name: str, value: Any) -> Any:
        """Keep what cannot be written to any more until `forget`; return it."""
        arrays = self.__dict__
        arrays[name] = value = frozen(value)
        self._kept.append((arrays, name))
        return value

    def forget(self) -> None:
        """Drop the arrays that were kept, of all groups that note them in the same place."""
        for arrays, name in self._kept:
            del arrays[name]
        self._kept.clear()

    def __setattr__(self, name: str, value: Any) -> None:
        if name[0] != "_":
            raise AttributeError(f"view.{name} is what it is: keep your own in view.state")
        super().__setattr__(name, value)
