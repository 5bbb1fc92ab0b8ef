"""Signatures of functions that hand their arguments on, as `help` and editors show them."""

import inspect
from collections.abc import Callable, Iterable
from typing import Any, Concatenate, ParamSpec, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])
Arguments = ParamSpec("Arguments")
Owner = TypeVar("Owner")
Result = TypeVar("Result")

_ANY = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def show(function: Function, parameters: Iterable[inspect.Parameter]) -> Function:
    """Show parameters in place of `*values` and `**keywords` of a function, and return it."""
    signature = inspect.signature(function, follow_wrapped=False)
    own = [p for p in signature.parameters.values() if p.kind not in _ANY]
    function.__signature__ = signature.replace(parameters=[*own, *parameters])  # type: ignore[attr-defined]
    return function


def takes(
    kind: Callable[Arguments, Any],
) -> Callable[
    [Callable[Concatenate[Owner, ...], Result]], Callable[Concatenate[Owner, Arguments], Result]
]:
    """Return a decorator for a method that hands its arguments on to `kind`."""
    return lambda method: show(method, inspect.signature(kind).parameters.values())
