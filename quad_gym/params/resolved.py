"""Arguments as dataclasses: fields given in several forms, and methods that take the fields."""

import inspect
from collections.abc import Callable
from functools import wraps
from typing import (
    Any,
    Concatenate,
    Generic,
    ParamSpec,
    TypeVar,
    cast,
    get_args,
    get_origin,
    overload,
)

from quad_gym.params import checks as check

Given = TypeVar("Given")
Value = TypeVar("Value")
Arguments = ParamSpec("Arguments")
Owner = TypeVar("Owner")


class Resolved(Generic[Given, Value]):
    """Field of a dataclass that is given in one of several forms; `resolve` takes its name, too."""

    def __init__(self, resolve: Callable[[str, Given], Value], default: Given) -> None:
        self._resolve, self._default = resolve, default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type) -> Given: ...

    @overload
    def __get__(self, instance: object, owner: type) -> Value: ...

    def __get__(self, instance: Any, owner: type) -> Any:
        return self._default if instance is None else vars(instance)[self._name]

    def __set__(self, instance: Any, given: Given) -> None:
        vars(instance)[self._name] = self._resolve(self._name, given)


def resolving(
    kind: type[Value], named: Callable[[str], Value] | None = None
) -> Callable[[str, Any], Value]:
    """Return a function that resolves None to defaults, and names of presets if there are any."""

    def resolve(name: str, given: Any) -> Value:
        value = named(given) if named is not None and isinstance(given, str) else given
        return check.instance(name, kind() if given is None and named is None else value, kind)

    return resolve


def taking(
    kind: Callable[Arguments, Value], name: str
) -> Callable[[Callable[[Owner, Value], None]], Callable[Concatenate[Owner, Arguments], None]]:
    """Return a decorator for a method of a dataclass, which then takes the fields as arguments.

    It takes the dataclass itself, too, in place of all of them.
    """
    make: Callable[..., Value] = kind
    fields = {
        name: parameter.replace(annotation=get_args(hint)[0])
        if get_origin(hint := parameter.annotation) is Resolved  # the type in which it is given
        else parameter
        for name, parameter in inspect.signature(kind).parameters.items()
    }

    def decorate(method: Callable[[Owner, Value], None]) -> Any:
        @wraps(method)
        def take(self: Owner, *values: Any, **given: Any) -> None:
            check.keywords(given, tuple(fields), name)
            ready = len(values) == 1 and isinstance(values[0], cast(type, kind))
            method(self, values[0] if ready and not given else make(*values, **given))

        itself, *_ = inspect.signature(method).parameters.values()
        shown = inspect.Signature([itself, *fields.values()])
        take.__signature__ = shown  # type: ignore[attr-defined]
        return take

    return decorate
