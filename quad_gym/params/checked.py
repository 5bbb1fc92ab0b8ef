"""Frozen dataclasses of parameters, whose types hold the rules of their values."""

import dataclasses
import inspect
from collections.abc import Mapping
from functools import partial, wraps
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NoReturn,
    Self,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
)

from quad_gym.params.checks import Rule, choice, flag, instance, keywords, number


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
