"""Arrays that are made when they are first read, and forgotten when the flights go on."""

from collections.abc import Callable
from types import MappingProxyType
from typing import Any, Generic, TypeVar, overload

import numpy as np

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


def frozen(value: Any) -> Any:
    """An array that cannot be written to, or a mapping of them."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
        return value
    if isinstance(value, dict):
        return MappingProxyType({name: frozen(part) for name, part in value.items()})
    return value


class Group:
    """Some arrays of a view. What it knows of the flights is in slots; what it has made, is not."""

    __slots__ = ("__dict__", "_flights")

    def __init__(self, flights: Any) -> None:
        self._flights = flights

    def forget(self) -> None:
        """Forget the arrays, as the flights have gone on."""
        self.__dict__.clear()

    def __setattr__(self, name: str, value: Any) -> None:
        if name[0] != "_":
            raise AttributeError(f"view.{name} is what it is: keep your own in view.state")
        super().__setattr__(name, value)
