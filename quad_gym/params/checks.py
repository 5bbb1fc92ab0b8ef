"""Checks of user input: each raises a ValueError that names the argument."""

import dataclasses
import difflib
import importlib
import inspect
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial, wraps
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Concatenate,
    Literal,
    NoReturn,
    ParamSpec,
    Self,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
)

import numpy as np
from numpy.typing import ArrayLike, NDArray

T = TypeVar("T")
_NO_NUMBERS = (str, bytes, bytearray, bool, np.bool_)
Vector = tuple[float, ...]
Matrix = tuple[tuple[float, ...], ...]

MAX_TICKS = 10**5  #: largest number of ticks between two events of a clock; 500 s at 200 Hz
LARGEST = 1e15  #: largest magnitude of any quantity in SI units; its square is far from overflow

SMALLEST = 1e-15
"""Smallest value of a quantity that has to be positive; its square is far from underflow."""


FARTHEST_ON_VEHICLE = 100.0  #: no part of a vehicle is farther from its center of mass [m]


def package(module: str, what: str, extra: str) -> Any:
    """Import an optional package, or raise an ImportError that explains how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        name = module.partition(".")[0]
        raise ImportError(f'{what} needs {name}: pip install "quad-gym[{extra}]"') from None


class UnknownKeywordError(TypeError, ValueError):
    """An unknown keyword: a TypeError, as in Python, and a ValueError, as in all checks."""


class NotResetError(RuntimeError, ValueError):
    """Error of a step before the first reset."""


def keywords(given: Iterable[str], known: Sequence[str], of: str) -> None:
    """Refuse the first of `given` that is not `known`, and name the one that may be meant."""
    for name in sorted(set(given) - set(known)):
        close = closest(name, known)
        meant = f"did you mean {close}?" if close else f"it takes {', '.join(known)}"
        words = f"unexpected keyword argument '{name}'"  # Python's, for which libraries look
        raise UnknownKeywordError(f"{name} is not a keyword of {of} ({words}); {meant}")


def effect(given: Mapping[str, Any], without: Mapping[str, str]) -> None:
    """Refuse the first argument that has no effect.

    Args:
        given: Arguments that were given, or that differ from their defaults.
        without: Arguments that have no effect with the others, each with the reason.
    """
    for name, reason in without.items():
        if name in given:
            raise ValueError(
                f"{name} has no effect {reason}, and must not be given, got {given[name]!r}"
            )


def closest(name: Any, known: Iterable[str]) -> str | None:
    """Return the one of `known` that a misspelt name may stand for, ignoring case; None: none.

    Words that `name` resembles as a whole come before words of which it resembles a part, as `rate`
    does of `control_rate`.
    """
    if not isinstance(name, str):
        return None

    def likeness(word: str) -> float:
        return difflib.SequenceMatcher(None, name.lower(), word.lower()).ratio()

    best, found = _RESEMBLES, None
    for word in known:
        whole = likeness(word)
        parts = [part for part in word.split("_") if len(part) > 2]
        part = max(map(likeness, parts), default=0.0)
        best_of_word = max(whole, _PART * part if part >= _PART else 0.0)
        if best_of_word > best:
            best, found = best_of_word, word
    return found


_RESEMBLES, _PART = 0.6, 0.8
"""Likeness above which a word may be meant, and at which a part of it may; a part counts less."""


def did_you_mean(name: Any, known: Iterable[str]) -> str:
    """Return the end of a message that refuses a name: the one that may be meant, if any."""
    close = closest(name, known)
    return f"; did you mean {close}?" if close else ""


def number(
    name: str,
    value: Any,
    *,
    least: float = -math.inf,
    open_end: bool = False,
    most: float = LARGEST,
) -> float:
    """`value` as a finite float in [least, most] (above `least`, with `open_end`)."""
    try:
        if isinstance(value, _NO_NUMBERS) or np.ndim(value) > 0:  # which float would convert
            raise TypeError
        result = float(value)
    except OverflowError:
        result = math.inf
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number, got {value!r}") from None
    if not math.isfinite(result):
        raise ValueError(f"{name} must be finite, got {value!r}")
    if result < least or (open_end and result == least):
        relation = "greater than" if open_end else "at least"
        raise ValueError(f"{name} must be {relation} {least:g}, got {value!r}")
    if result > most:
        raise ValueError(f"{name} must be at most {most:g}, got {value!r}")
    if result < -LARGEST:
        raise ValueError(f"{name} must be at least {-LARGEST:g}, got {value!r}")
    return result


def positive(name: str, value: Any, *, least: float = SMALLEST, most: float = LARGEST) -> float:
    """`value` as a finite float above zero, in [least, most]."""
    result = number(name, value, least=0.0, open_end=True, most=most)
    if result < least:
        raise ValueError(f"{name} must be at least {least:g}, got {value!r}")
    return result


def positive_or_infinite(name: str, value: Any) -> float:
    """`value` as a float above zero, which may be infinite."""
    return value if isinstance(value, float) and value == math.inf else positive(name, value)


def whole(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """`value` as an int that is at least `least` and at most `most`."""
    if isinstance(value, (bool, np.bool_)) or int(number(name, value)) != value:
        raise ValueError(f"{name} must be a whole number, got {value!r}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value!r}")
    if most is not None and value > most:
        raise ValueError(f"{name} must be at most {most}, got {value!r}")
    return int(value)


def seed(name: str, value: Any) -> int | None:
    """`value` as a seed: a whole number of at least 0, or None for fresh entropy."""
    if value is None:
        return None
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{name} must be a whole number of at least 0, or None, got {value!r}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """`value`, if it is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


_TURNS = {2.0 * math.pi: "2 pi", math.pi: "pi", 0.5 * math.pi: "pi/2"}
"""Limits of angles [rad] as messages write them."""


def angle(name: str, value: Any, *, most: float = 2.0 * math.pi) -> float:
    """`value` as an angle within ± `most`, a turn by default [rad]; larger ones are in degrees."""
    result = number(name, value)
    if abs(result) > most:
        meant = f"; did you mean {math.radians(result):.4g}?" if abs(result) <= 360.0 else ""
        raise ValueError(f"{name} must be in rad, within ±{_TURNS[most]}, got {result:g}{meant}")
    return result


def angles(name: str, value: Any) -> Vector:
    """`value` as three angles (3,) within ± one turn [rad]; larger ones are in degrees."""
    return tuple(angle(name, component) for component in vector(name, value, 3))


def angle_size(name: str, value: Any) -> float:
    """`value` as the size of an angle, or its standard deviation, in (0, pi] [rad]."""
    return positive(name, angle(name, value, most=math.pi))


def phase(name: str, value: Any) -> float | None:
    """`value` as a share of a period in [0, 1), or None."""
    if value is None:
        return None
    share = number(name, value, least=0.0)
    if share >= 1.0:
        raise ValueError(f"{name} must be less than 1, got {value!r}")
    return share


def instance(name: str, value: T, kind: type) -> T:
    """`value`, if it is a `kind`."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be a {kind.__name__}, got {value!r}")
    return value


_Kind = TypeVar("_Kind")


def own(name: str, given: Any, kind: type[_Kind], needs: Sequence[str] = ()) -> _Kind:
    """Return an object of a class that users extend.

    `given` is an instance; a subclass, which is instantiated without arguments; or "module:name" of
    either. Modules in the working directory are found, too. `needs` are methods of the class that
    the object must override.
    """
    found = _named(name, given, kind.__name__) if isinstance(given, str) else given
    if isinstance(found, type) and issubclass(found, kind):
        found = found()
    if not isinstance(found, kind):
        raise ValueError(
            f'{name} must be a quad_gym.{kind.__name__} or its "module:name", got {given!r}'
        )
    for method in needs:
        if getattr(type(found), method) is getattr(kind, method) and method not in vars(found):
            raise ValueError(f"{name} must define {method}, got {given!r} without it")
    return found


def _named(argument: str, name: str, kind: str) -> Any:
    """Return the object specified by "module:name"."""
    module, _, attribute = name.partition(":")
    if not (module and attribute):
        raise ValueError(f'{argument} must be "module:name" of a quad_gym.{kind}, got {name!r}')
    here = os.getcwd()
    added = here not in sys.path and "" not in sys.path
    if added:  # console commands do not have the working directory on the path
        sys.path.insert(0, here)
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{argument} must name a quad_gym.{kind}, got {name!r}: {error}") from None
    finally:
        if added:
            sys.path.remove(here)


def choice(name: str, value: Any, choices: Sequence[str]) -> str:
    """`value`, if it is one of `choices`."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(
            f"{name} must be one of {', '.join(choices)}, got {value!r}"
            + did_you_mean(value, choices)
        )
    return str(value)


def array(
    name: str, value: ArrayLike, shape: tuple[int | None, ...], *, allow_nan: bool = False
) -> NDArray[np.float64]:
    """`value` as a new float64 array in C order, of `shape` (None: any length), finite or NaN."""
    result = shaped(name, value, shape)
    bad = np.isinf(result) if allow_nan else ~np.isfinite(result)
    if bad.any():
        raise ValueError(f"{name} must be finite, got {result[bad].flat[0]} among its values")
    return result


def shaped(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """`value` as a new float64 array in C order, of `shape` (None: any length)."""
    try:
        if holds_no_numbers(value):
            raise TypeError
        result = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError):
        numbers = "an array of numbers" if shape else "a number"
        raise ValueError(f"{name} must be {numbers}, got {value!r}") from None
    fits = result.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(result.shape, shape, strict=False)
    )
    if not fits:
        sizes = ["n" if n is None else str(n) for n in shape]
        wanted = f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"  # as Python writes them
        what = f"have shape {wanted}" if shape else "be a number"
        raise ValueError(f"{name} must {what}, got {result.shape}")
    return result


def holds_no_numbers(value: Any) -> bool:
    """Return True if NumPy would convert text, booleans or nothing at all to numbers."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind not in "iuf"
    if isinstance(value, (list, tuple)):
        return any(holds_no_numbers(part) for part in value)
    return value is None or isinstance(value, _NO_NUMBERS)


def vector(
    name: str, value: Any, length: int, *, least: float = -math.inf, open_end: bool = False
) -> tuple[float, ...]:
    """`value` as a tuple of `length` finite floats, at least (above, with `open_end`) `least`."""
    found = tuple(_sized(name, array(name, value, (length,))).tolist())
    if min(found) < least or (open_end and min(found) == least):
        relation = "greater than" if open_end else "at least"
        raise ValueError(f"{name} must be {relation} {least:g}, got {found}")
    return found


def _sized(name: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return numbers that are all at most LARGEST in magnitude."""
    if values.size and np.abs(values).max() > LARGEST:
        raise ValueError(f"{name} must be within ±{LARGEST:g}, got {values}")
    return values


def place(name: str, value: Any) -> tuple[float, ...]:
    """`value` as a place on the vehicle, (3,) in B."""
    found = vector(name, value, 3)
    if max(map(abs, found)) > FARTHEST_ON_VEHICLE:
        raise ValueError(
            f"{name} must be on the vehicle, within {FARTHEST_ON_VEHICLE:g} m, got {found}"
        )
    return found


def matrix(name: str, value: Any, rows: int | None, columns: int) -> tuple[tuple[float, ...], ...]:
    """`value` as a tuple of rows of finite floats."""
    numbers = _sized(name, array(name, value, (rows, columns)))
    return tuple(tuple(row) for row in numbers.tolist())


def places(name: str, value: Any, *, most: int) -> Matrix:
    """`value` as one to `most` positions (n, 3)."""
    found = matrix(name, value, None, 3)
    if not 1 <= len(found) <= most:
        raise ValueError(f"{name} must have 1 to {most} positions, got {len(found)}")
    return found


def ticks(name: str, rate: float, tick_rate: float) -> int:
    """Return the number of ticks between two events at `rate` [Hz], which must be whole."""
    ratio = tick_rate / positive(name, rate)
    if ratio > MAX_TICKS:
        raise ValueError(
            f"{name} must be at least {tick_rate / MAX_TICKS:g} Hz at an IMU rate of "
            f"{tick_rate:g} Hz, got {rate:g} Hz"
        )
    if ratio < 1.0 - 1e-9 or abs(ratio - round(ratio)) > 1e-9 * ratio:
        raise ValueError(
            f"{name} must divide the IMU rate of {tick_rate:g} Hz into whole ticks, got {rate:g} Hz"
        )
    return round(ratio)


Positive = Annotated[float, positive]
NonNegative = Annotated[float, partial(number, least=0.0)]
UpToOne = Annotated[float, partial(positive, most=1.0)]
Angle = Annotated[float, angle]
Angles3 = Annotated[Vector, angles]
AngleSize = Annotated[float, angle_size]
Phase = Annotated[float | None, phase]
Place = Annotated[Vector, place]
Vector3 = Annotated[Vector, partial(vector, length=3)]
NonNegative3 = Annotated[Vector, partial(vector, length=3, least=0.0)]
Positive3 = Annotated[Vector, partial(vector, length=3, least=0.0, open_end=True)]
Matrix33 = Annotated[Matrix, partial(matrix, rows=3, columns=3)]
Matrix43 = Annotated[Matrix, partial(matrix, rows=4, columns=3)]

Rule = Callable[[str, Any], Any]
"""From the name of a field in messages, and its value, to the checked value."""


def between(least: float, most: float) -> Rule:
    """Return the rule of a finite float in [least, most]."""
    return partial(number, least=least, most=most)


# --------------------------------------------------------------------------------------------------
# Frozen dataclasses of parameters, whose types hold the rules of their values.
# --------------------------------------------------------------------------------------------------


def _rule_of(hint: Any) -> tuple[Any, Rule | None]:
    """Split the type of a field into the plain type and the rule of its values, if it has one."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return inner[0], inner[1]
    if origin is Literal:
        return hint, partial(choice, choices=inner)
    if origin in (Union, UnionType) and len(inner) == 2 and inner[1] is NoneType:
        plain, rule = _rule_of(inner[0])
        return plain | None, rule and partial(_unless_none, rule)
    if dataclasses.is_dataclass(hint):
        return hint, partial(instance, kind=hint)  # type: ignore[arg-type]
    plain_rules: dict[Any, Rule] = {bool: flag, float: number}
    return hint, plain_rules.get(hint)


def _unless_none(rule: Rule, name: str, value: Any) -> Any:
    return None if value is None else rule(name, value)


@dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field,)
)
class Checked:
    """Base of frozen dataclasses whose fields are replaced by their checked form on creation.

    Subclasses are dataclasses without a decorator, with keyword-only fields by default. The rule of
    a field is part of its type, as in `Annotated[float, rule]`, or follows from it. Errors name a
    field with its class; `bare`: without it.
    """

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]
    _rules: ClassVar[dict[str, Rule]] = {}
    _prefix: ClassVar[str]

    def __init_subclass__(
        cls,
        *,
        kw_only: bool = True,
        eq: bool = True,
        bare: bool = False,
        more: Mapping[str, tuple[Any, Any]] | None = None,
    ) -> None:
        """Move the rules out of the types of fields, which then are plain, and make a dataclass.

        `more`: types and defaults of further fields, whose names follow from a table.
        """
        super().__init_subclass__()
        cls._prefix = "" if bare else f"{cls.__name__}."
        hints = dict(inspect.get_annotations(cls))
        for name, (hint, default) in (more or {}).items():
            hints[name] = hint
            setattr(cls, name, default)
        split = {name: _rule_of(hint) for name, hint in hints.items()}
        cls.__annotations__ = {name: plain for name, (plain, _) in split.items()}
        bases = reversed(cls.__mro__[1:])
        inherited = {n: rule for base in bases for n, rule in vars(base).get("_rules", {}).items()}
        cls._rules = inherited | {name: rule for name, (_, rule) in split.items() if rule}
        dataclasses.dataclass(frozen=True, kw_only=kw_only, eq=eq)(cls)
        create = cls.__init__
        known = [field.name for field in dataclasses.fields(cls) if field.init]

        @wraps(create)
        def init(self: Self, *values: Any, **given: Any) -> None:
            keywords(given, known, cls.__name__)
            create(self, *values, **given)

        cls.__init__ = init  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Apply the rules of all fields."""
        for name, rule in self._rules.items():
            self._set(name, rule(self._prefix + name, getattr(self, name)))

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _refuse(self, name: str, must: str, got: Any = ...) -> NoReturn:
        """Raise a ValueError for a field that must be otherwise."""
        value = getattr(self, name) if got is ... else got
        raise ValueError(f"{self._prefix}{name} must {must}, got {value}")

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed; all values are checked again."""
        return dataclasses.replace(self, **changes)


def changed(parameters: Checked) -> dict[str, Any]:
    """Return the fields that differ from their defaults."""
    given = {field: getattr(parameters, field.name) for field in dataclasses.fields(parameters)}
    return {field.name: value for field, value in given.items() if value != field.default}


# --------------------------------------------------------------------------------------------------
# Signatures of functions that hand their arguments on, as `help` and editors show them.
# --------------------------------------------------------------------------------------------------

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
