"""Arrays that are computed when they are first read, and dropped at the next step."""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, Generic, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from quad_gym.records import SHOWN, SHOWN_KINDS, SHOWN_SHAPES

T = TypeVar("T")

Attribute = tuple[dict[str, Any], str]
"""Attribute that holds an array: the attributes of a group, and the name of this one."""


class Lazy(Generic[T]):
    """Read-only array of a `Group`, computed by a method when it is first read."""

    def __init__(self, make: Callable[[Any], T]) -> None:
        self._make, self.__doc__ = make, make.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        """Store the name of the attribute."""
        self._name = name

    @overload
    def __get__(self, group: None, owner: type) -> "Lazy[T]": ...

    @overload
    def __get__(self, group: object, owner: type) -> T: ...

    def __get__(self, group: Any, owner: type) -> Any:
        """Compute the array and store it as an ordinary attribute of the group."""
        if group is None:
            return self
        return group._keep(self._name, self._make(group))


class Shown:
    """Array of a `Group` that the kernels write, see `quad_gym.records.SHOWN`.

    It is a NumPy view of the memory to which the kernels write, and stays the same object until
    that memory is exchanged; a matrix is copied.

    Args:
        name: Name in `SHOWN`.
        meaning: Docstring: meaning, shape, frame and unit.
        part: Slice of the elements to take, as a vector; None: all elements.
    """

    def __init__(self, name: str, meaning: str, part: slice | None = None) -> None:
        rows, self._shape, self.__doc__ = SHOWN[name], SHOWN_SHAPES[name], meaning
        if part is not None:
            chosen = range(rows.start, rows.stop)[part]
            rows = slice(chosen.start, chosen.stop, chosen.step)
        self._rows = rows if self._shape else rows.start
        self._kind = SHOWN_KINDS[name]
        self._is_matrix = len(self._shape) > 1 and part is None

    def part_of(self, shown: NDArray[np.float64]) -> NDArray[Any]:
        """NumPy view of this quantity in the kernels' memory, (n, ...)."""
        found = shown[self._rows].T
        if self._is_matrix:
            found = found.reshape(-1, *self._shape)
        return found if self._kind == found.dtype else found.view(self._kind)

    def __set_name__(self, owner: type, name: str) -> None:
        """Store the name of the attribute."""
        self._name, self._uncopied = name, f"_{name}_uncopied"

    @overload
    def __get__(self, group: None, owner: type) -> "Shown": ...

    @overload
    def __get__(self, group: object, owner: type) -> NDArray[Any]: ...

    def __get__(self, group: Any, owner: type) -> Any:
        """Take the array and store it as an ordinary attribute of the group."""
        if group is None:
            return self
        if not self._is_matrix:
            return group._flights.hand_out(self, group.__dict__, self._name)
        uncopied = group.__dict__.get(self._uncopied)
        if uncopied is None:
            uncopied = group._flights.hand_out(self, group.__dict__, self._uncopied)
        # memory layout of a single flight, so that products have the same bits in any batch
        return group._keep(self._name, uncopied.copy())


def frozen(value: Any) -> Any:
    """Make an array, or the arrays of a dictionary, read-only."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
        return value
    if isinstance(value, dict):
        return MappingProxyType({name: frozen(part) for name, part in value.items()})
    return value


class Group:
    """Group of arrays of a view.

    Its references to the flights are in slots; the arrays that it has computed are ordinary
    attributes.

    Args:
        flights: Batch whose flights it describes.
        kept: List to which it adds the arrays that are dropped at the next step.
    """

    __slots__ = ("__dict__", "_flights", "_kept")

    def __init__(self, flights: Any, kept: "list[Attribute]") -> None:
        self._flights, self._kept = flights, kept

    def _keep(self, name: str, value: Any) -> Any:
        """Make a value read-only, store it until `forget`, and return it."""
        arrays, value = self.__dict__, frozen(value)
        self._kept.append((arrays, name))  # first: an interrupt must not leave it undropped
        arrays[name] = value
        return value

    def forget(self) -> None:
        """Drop the stored arrays of all groups that share this list."""
        kept = self._kept.copy()  # another thread may still append to it
        for arrays, name in kept:
            arrays.pop(name, None)  # two threads may have added the same one
        del self._kept[: len(kept)]

    def __setattr__(self, name: str, value: Any) -> None:
        if name[0] != "_":
            raise AttributeError(f"view.{name} is read-only; store your own data in view.state")
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"view.{name} cannot be deleted")
