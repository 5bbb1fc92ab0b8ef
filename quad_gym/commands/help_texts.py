"""How the parser writes types, defaults and explanations of options: as people would.

tyro's own help has `{None}|INT` for a number that may be left out, and `(default: None)` behind it.
The rules below, for all commands, leave that to the explanation, which says what happens then.
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
    """The rules, for `tyro.cli`."""
    rules = ConstructorRegistry()
    rules.primitive_rule(_name)
    rules.primitive_rule(_number)
    rules.primitive_rule(_optional)
    asking = False

    @rules.struct_rule
    def options(info: StructTypeInfo) -> StructConstructorSpec | None:
        """The options of a command as tyro finds them, with what their help says changed."""
        nonlocal asking
        if asking or not is_dataclass(info.type):
            return None
        asking = True  # so that tyro's own rule answers
        spec = ConstructorRegistry.get_struct_spec(info)
        asking = False
        if not isinstance(spec, StructConstructorSpec):
            return None
        return replace(spec, fields=tuple(_explained(field) for field in spec.fields))

    return rules


def wrapped(text: str) -> str:
    """Paragraphs as wide as the terminal, at most 100 columns; indented lines as they are."""
    width = min(shutil.get_terminal_size().columns, 100)
    found = []
    for paragraph in text.strip().split("\n\n"):
        filled = textwrap.fill(" ".join(paragraph.split()), width, break_on_hyphens=False)
        found.append(paragraph if paragraph[0] == " " else filled)
    return "\n\n".join(found) + "\n"


def _name(info: PrimitiveTypeInfo) -> _Spec:
    """A text: all that commands take are names."""
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
    """A number, with an error that says what was expected."""
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
    """What may be left out, and is None then: it reads as what it is where it is given."""
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
    """An option with its default and its explanation in words."""
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
    """Several of a kind."""
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, set()))
    return None if isinstance(spec, UnsupportedTypeAnnotationError) else f"{spec.metavar} ..."


def _default(label: str) -> str:
    """What is said of a default; nothing of one that stands for nothing: the text explains it."""
    if label in ("", "None"):
        return ""
    return f"(default: {({'True': 'yes', 'False': 'no'}).get(label, label)})"
