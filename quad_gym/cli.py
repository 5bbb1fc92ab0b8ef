"""Command lines of scripts: a frozen dataclass of options becomes an argument parser.

A script declares its options once, with their types, defaults and help texts::

    @dataclass(frozen=True)
    class Args:
        seeds: int = option(1000, "number of flights")
        camera: bool = option(True, "measure with the camera")

    args = parse(Args, description=__doc__)

Wrong options end the program with one line on stderr and exit code 2, as is the custom on Unix.
"""

import argparse
import ast
import dataclasses
import shlex
import sys
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn, TypeVar

USAGE_ERROR = 2
"""Exit code of a program that was called with invalid arguments."""

_Args = TypeVar("_Args")


def option(default: Any, text: str, *, group: str | None = None, positional: bool = False) -> Any:
    """A field of a dataclass that is an option of the command line.

    Args:
        default: Value where the option is not given; None: the help text says what happens then.
        text: What the option does, with its unit.
        group: Heading in the help above this option and those after it.
        positional: Whether it is given by its place, without its name; it may still be left out.
    """
    metadata = {"text": text, "group": group, "positional": positional}
    if isinstance(default, dict):
        return dataclasses.field(default_factory=lambda: dict(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE_ERROR, f"{self.prog}: error: {message} (--help lists the options)\n")


def parser_of(
    kind: type[Any], *, description: str | None = None, program: str | None = None
) -> argparse.ArgumentParser:
    """An argument parser with one option for every field of a dataclass.

    Types may be int, float, str, bool (an option and its `--no-` twin), a path, a Literal (a
    choice), a tuple of fixed or, with an ellipsis, any length, a dict (`key=value` pairs), or one
    of these or None.
    """
    parser = _Parser(
        prog=program,
        description=description,
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(
            prog, max_help_position=30, width=100
        ),
        allow_abbrev=False,
    )
    hints = typing.get_type_hints(kind)
    group: Any = parser
    for field in dataclasses.fields(kind):
        if field.metadata.get("group"):
            group = parser.add_argument_group(field.metadata["group"])
        how = _how_to_parse(hints[field.name])
        name = "--" + field.name.replace("_", "-")
        if field.metadata.get("positional"):
            name, how = field.name, {**how, "nargs": "?", "metavar": field.name.upper()}
        empty = field.default_factory is not dataclasses.MISSING
        group.add_argument(
            name, default={} if empty else field.default, help=_help_of(field), **how
        )
    return parser


def parse(
    kind: type[_Args],
    argv: Sequence[str] | None = None,
    *,
    description: str | None = None,
    program: str | None = None,
) -> _Args:
    """Options from the command line as an instance of a dataclass.

    A ValueError of the dataclass's own checks ends the program as a wrong option does.

    Args:
        kind: Dataclass whose fields were made by `option`.
        argv: Arguments without the program's name; None: those of the process.
        description: Text above the options in the help.
        program: Name of the program in its messages; None: that of the process.
    """
    parser = parser_of(kind, description=description, program=program)
    values = vars(parser.parse_args(argv))
    try:
        return kind(**values)
    except ValueError as error:
        parser.error(str(error))


@contextmanager
def usage_errors(
    kinds: tuple[type[Exception], ...] = (ValueError, OSError, ImportError),
) -> Iterator[None]:
    """Turn what is raised while options are checked into one line on stderr and exit code 2.

    Args:
        kinds: Errors that the user can correct.
    """
    try:
        yield
    except kinds as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(USAGE_ERROR) from None


def leave(keywords: Mapping[str, Any], options: Mapping[str, str]) -> Mapping[str, Any]:
    """Keywords of an environment given by `--env`, none of which has an option of its own.

    Args:
        keywords: What was given.
        options: Names of keywords, with the options that are there for them.

    Raises:
        ValueError: If one of them was given.
    """
    for name, instead in options.items():
        if name in keywords:
            raise ValueError(f"--env must leave {name} to {instead}")
    return keywords


def flying_options(keywords: Mapping[str, Any]) -> str:
    """Options of `scripts/evaluate.py` for keywords of an environment, each after a space."""
    rest = dict(keywords)
    words = [f"--{k} {rest.pop(k)}" for k in ("observation", "sensors") if k in rest]
    if rest:
        words.append("--env " + " ".join(shlex.quote(f"{k}={v}") for k, v in rest.items()))
    return "".join(" " + word for word in words)


def _help_of(field: "dataclasses.Field[Any]") -> str:
    text = str(field.metadata.get("text", "")).replace("%", "%%")
    if field.default is None or field.default is dataclasses.MISSING:
        return text
    default = field.default
    if isinstance(default, bool):
        default = "--" + ("" if default else "no-") + field.name.replace("_", "-")
    elif isinstance(default, tuple):
        default = " ".join(str(value) for value in default) or "none"
    return f"{text} (default: {default})"


_PLACEHOLDERS = {int: "N", float: "X", str: "NAME"}


def _how_to_parse(hint: Any) -> dict[str, Any]:
    """Keywords of `add_argument` for a type."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (hint,) = (part for part in typing.get_args(hint) if part is not type(None))
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if hint is bool:
        return {"action": argparse.BooleanOptionalAction}
    if origin is dict:
        return {"nargs": "+", "type": _pair, "metavar": "KEY=VALUE", "action": _Pairs}
    if origin is typing.Literal:
        return {"choices": parts, "type": type(parts[0])}
    if origin is tuple:
        placeholder = _PLACEHOLDERS.get(parts[0], "PATH")
        return {
            "nargs": "+" if parts[-1] is Ellipsis else len(parts),
            "type": parts[0],
            "metavar": placeholder,
            "action": _Tuple,
        }
    return {"type": hint, "metavar": _PLACEHOLDERS.get(hint, "PATH")}


class _Tuple(argparse.Action):
    """Keeps several values as a tuple, as frozen dataclasses like them."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, tuple(values))


def _pair(text: str) -> tuple[str, Any]:
    """`key=value`, with the value as Python writes numbers, tuples, True and None; else a text."""
    key, equals, value = text.partition("=")
    if not (equals and key.isidentifier()):
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE, got {text!r}")
    try:
        return key, ast.literal_eval(_WORDS.get(value, value))
    except (ValueError, SyntaxError):
        return key, value


_WORDS = {"true": "True", "false": "False", "none": "None"}


class _Pairs(argparse.Action):
    """Keeps pairs as a dict; the option may be given more than once."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        before = getattr(namespace, self.dest) or {}
        setattr(namespace, self.dest, {**before, **dict(values)})
