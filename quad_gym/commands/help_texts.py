"""Readable help texts: rules for types, defaults and explanations of options.

For an optional number, tyro would print `{None}|INT` and `(default: None)`. With the rules below,
which apply to all commands, only the explanation describes the default.
"""

import shutil
import textwrap
from contextlib import suppress
from dataclasses import is_dataclass, replace
from types import NoneType
from typing import Annotated, Any, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

_Spec = PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None


def registry() -> ConstructorRegistry:
    """Registry of the rules, for `tyro.cli`."""
    rules = ConstructorRegistry()
    rules.primitive_rule(_name)
    rules.primitive_rule(_number)
    rules.primitive_rule(_optional)
    asking = False

    @rules.struct_rule
    def options(info: StructTypeInfo) -> StructConstructorSpec | None:
        """Options of a command as found by tyro, with other help texts."""
        nonlocal asking
        if asking or not is_dataclass(info.type):
            return None
        asking = True  # delegate to tyro's own rule
        spec = ConstructorRegistry.get_struct_spec(info)
        asking = False
        if not isinstance(spec, StructConstructorSpec):
            return None
        return replace(spec, fields=tuple(_explained(field) for field in spec.fields))

    return rules


def wrapped(text: str) -> str:
    """Wrap paragraphs to the width of the terminal, at most 100 columns, except indented lines."""
    width = min(shutil.get_terminal_size().columns, 100)
    found = []
    for paragraph in text.strip().split("\n\n"):
        filled = textwrap.fill(" ".join(paragraph.split()), width, break_on_hyphens=False)
        found.append(paragraph if paragraph[0] == " " else filled)
    return "\n\n".join(found) + "\n"


def _name(info: PrimitiveTypeInfo) -> _Spec:
    """Rule for texts, which are all names."""
    if info.type is not str:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    )


def _number(info: PrimitiveTypeInfo) -> _Spec:
    """Rule for numbers, with a readable error message."""
    if info.type not in (int, float):
        return None
    kind, wanted = info.type, "a whole number" if info.type is int else "a number"

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            pass
        with suppress(ValueError, OverflowError):
            if float(words[0]) == int(float(words[0])):  # such as 1e6
                return int(float(words[0]))
        raise ValueError(f"must be {wanted}, got {words[0]!r}")

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, (int, kind)) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


def _optional(info: PrimitiveTypeInfo) -> _Spec:
    """Rule for options whose default is None, which are displayed as their other type."""
    kinds = get_args(info.type)
    others = [kind for kind in kinds if kind is not NoneType]
    if get_origin(info.type) is tuple or len(kinds) != 2 or len(others) != 1:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(others[0], info.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return spec
    return replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: [] if value is None else spec.str_from_instance(value),
    )


def _explained(field: StructFieldSpec) -> StructFieldSpec:
    """Rule for an option's default and explanation."""
    kind, *about = get_args(field.type) if get_origin(field.type) is Annotated else (field.type,)
    several = get_origin(kind) is tuple and get_args(kind)[-1:] == (...,)
    hint = tyro.conf.arg(
        help_behavior_hint=_default, metavar=_metavar(get_args(kind)[0]) if several else None
    )
    explained: Any = Annotated[(kind, hint, *about)]
    text = field.helptext() if callable(field.helptext) else field.helptext
    return replace(
        field,
        type=explained,
        helptext=None if text is None else " ".join(text.split()),
    )


def _metavar(kind: Any) -> str | None:
    """Placeholder for several values of a type."""
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, set()))
    return None if isinstance(spec, UnsupportedTypeAnnotationError) else f"{spec.metavar} ..."


def _default(label: str) -> str:
    """Description of a default; empty for None and empty values, which the help text explains."""
    if label in ("", "None"):
        return ""
    return f"(default: {({'True': 'yes', 'False': 'no'}).get(label, label)})"
