"""Command lines: frozen dataclasses of options, parsed by tyro.

A command declares each option once, with its type, its default and, in the docstring below it, its
help text. Types that several commands share are at the end of this file.
"""

import ast
import dataclasses
import io
import itertools
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast, get_args

import docstring_parser
import tyro
from tyro.conf import Positional, arg
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from quad_gym.envs import IDS
from quad_gym.envs.config import DEFAULTS, TASK_DEFAULTS, TASK_KEYWORDS, EnvConfig, env_option
from quad_gym.params import checks as check
from quad_gym.params.checks import did_you_mean
from quad_gym.params.suites import ALL_SUITES, SUITES

if TYPE_CHECKING:
    from baselines.recipes import Recipe

_Args = TypeVar("_Args")

OBSERVATION, SENSORS, WORLD = (DEFAULTS[name] for name in ("observation", "sensors", "world"))
"""Defaults of options that are keywords of environments."""

USAGE_ERROR = 2  #: exit code of a program that was called with invalid options
CLOSED_PIPE = 141  #: exit code of a program whose output has lost its reader

_REGISTRY = ConstructorRegistry()


def parse(kind: Any, argv: Sequence[str] | None = None, **options: Any) -> Any:
    """Parse the command line; invalid options end the program with exit code 2.

    Args:
        kind: Dataclass whose fields are the options, or a union of subcommands.
        argv: Arguments without the program's name; None: the arguments of the process.
        **options: Further options of `tyro.cli`.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    kind = with_plain_help(kind)
    refusals = usage_errors((ValueError, _RefusedError))
    with refusals, _wrapped_help(words), _without_name_of_class(kind):
        args = tyro.cli(kind, args=words, registry=_REGISTRY, **options)
        for field in dataclasses.fields(args):
            name = option_name(field.name)
            if name in words and getattr(args, field.name) in ((), {}):
                raise ValueError(f"{name} must have at least one value, got none")
    return args


class _RefusedError(Exception):
    """A ValueError of a dataclass's own checks, which tyro does not catch."""


@contextmanager
def _without_name_of_class(kind: Any) -> Iterator[None]:
    """Report errors of the checks in `__post_init__` without the name of the dataclass."""
    check_fields = getattr(kind, "__post_init__", None)
    if check_fields is None:
        yield
        return

    def checked(self: Any) -> None:
        try:
            check_fields(self)
        except ValueError as error:
            raise _RefusedError(str(error)) from None

    own = "__post_init__" in vars(kind)
    kind.__post_init__ = checked
    try:
        yield
    finally:
        if own:
            kind.__post_init__ = check_fields
        else:
            del kind.__post_init__


def with_plain_help(kind: Any) -> Any:
    """Set the help of a dataclass of options, which is returned.

    A description is one paragraph, without the line breaks of the source. "(default: None)" is left
    out.
    """
    if not dataclasses.is_dataclass(kind):
        return kind
    described = {
        param.arg_name: " ".join((param.description or "").split())
        for base in reversed(cast(type, kind).__mro__[:-1])
        for param in docstring_parser.parse_from_object(base).params
    }
    for each in dataclasses.fields(kind):
        made = each.default_factory
        default = each.default if made is dataclasses.MISSING else made()
        empty = default is None or default in ((), {})
        about = arg(help=described.get(each.name), help_behavior_hint="" if empty else None)
        kind.__annotations__[each.name] = Annotated[each.type, about]
    return kind


@contextmanager
def _wrapped_help(words: Sequence[str]) -> Iterator[None]:
    """Wrap the description of a command, of which tyro makes one line per paragraph.

    The list of subcommands, which has a box, is left out of the usage, which would break in words.
    """
    if not {"-h", "--help"} & set(words):
        yield
        return
    shown, stdout = io.TextIOWrapper(io.BytesIO(), encoding=sys.stdout.encoding), sys.stdout
    shown.isatty = stdout.isatty  # type: ignore[method-assign]  # for colors
    try:
        with redirect_stdout(shown):
            yield
    finally:
        shown.seek(0)
        width = shutil.get_terminal_size().columns
        text = re.sub(r"(usage: [^{\n]*)\{[^}]*\}", r"\1COMMAND ...", shown.read(), count=1)
        for line in text.splitlines():
            indented = line[:1] in "\x1b ╭│╰"  # examples and boxes
            print(line if indented else textwrap.fill(line, width, break_on_hyphens=False))


@_REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Rule of tyro for options without a default, whose help does not mention None."""
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if NoneType not in get_args(info.type) or len(kinds) != 1:
        return None
    given = _REGISTRY.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], set(info.markers)))
    if not isinstance(given, PrimitiveConstructorSpec):
        return None
    return replace(
        given,
        is_instance=lambda value: value is None or given.is_instance(value),
        str_from_instance=lambda value: [] if value is None else given.str_from_instance(value),
    )


@_REGISTRY.primitive_rule
def _whole_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    """Rule of tyro for whole numbers, which may be written as 1e6."""

    def read(words: list[str]) -> int:
        if not float(words[0]).is_integer():
            raise ValueError(f"must be a whole number, got {words[0]!r}")
        return int(words[0]) if words[0].lstrip("+-").isdecimal() else int(float(words[0]))

    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, int) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


def option_name(field: str) -> str:
    """Option declared by a field of a dataclass, as written on the command line."""
    return f"--{field.replace('_', '-')}"


def require_at_least(args: Any, **least: int) -> None:
    """Reject numbers that are too small; options that were not given (None) are accepted."""
    for name, limit in least.items():
        value = getattr(args, name)
        if value is not None and value < limit:
            raise ValueError(f"{option_name(name)} must be at least {limit}, got {value}")


def recipe_of(args: Any) -> "Recipe":
    """Recipe of a training: the default one, overridden by the options steps, n_envs and set."""
    from baselines.recipes import recipe

    chosen = recipe(args.env_id, args.algorithm)
    return chosen.replace(
        steps=args.steps or chosen.steps,
        n_envs=args.n_envs or chosen.n_envs,
        parameters={**chosen.parameters, **args.set},
    )


@contextmanager
def usage_errors(
    kinds: tuple[type[Exception], ...] = (ValueError, OSError, ImportError),
) -> Iterator[None]:
    """Context that turns errors of checks into one line on stderr and exit code 2."""
    try:
        yield
    except kinds as error:
        message = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            missing = isinstance(error, FileNotFoundError)
            message = f"{error.filename}{' does not exist' if missing else f': {error.strerror}'}"
        print(f"error: {message}", file=sys.stderr)
        raise SystemExit(USAGE_ERROR) from None


@contextmanager
def quiet_end() -> Iterator[None]:
    """Context that ends a program without a traceback if the reader of its output, as head, ends.

    The exit code is `CLOSED_PIPE`.
    """
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        raise SystemExit(CLOSED_PIPE) from None


@contextmanager
def filter_hints() -> Iterator[None]:
    """Context that turns the error of a task that lacks the filter into a usage error."""
    from quad_gym.tasks import TaskError
    from quad_gym.tasks.view import MissingFilterError

    try:
        yield
    except TaskError as error:
        if not isinstance(error.__cause__, MissingFilterError):
            raise  # the traceback shows the line of the user's task
        method = str(error).partition(" failed")[0]
        with usage_errors():
            raise ValueError(
                f"{method} needs the filter, which does not run for this observation: use "
                "--observation estimate, or --env run_filter=true, with which it runs next to the "
                "true state"
            ) from None


_OF_COMMANDS = ("num_envs", "autoreset_mode", "render_mode")
"""Arguments of vector environments that are no keywords of `--env`."""


def leave(keywords: Mapping[str, Any], *names: str, **others: str) -> Mapping[str, Any]:
    """Check that `--env` contains no keyword for which there is an option, of this name or another.

    Arguments that commands choose are refused, too. `others` has options with other names than
    their keywords.
    """
    for name in _OF_COMMANDS:
        if name in keywords:
            raise ValueError(f"--env must not contain {name}, which the command chooses")
    for name, instead in {**{name: option_name(name) for name in names}, **others}.items():
        if name in keywords:
            raise ValueError(f"--env must not contain {name}: use {instead} instead")
    return keywords


def environment_of(args: Any, **given: Any) -> dict[str, Any]:
    """Keywords of the environment that the options of a command define.

    These are `--env`, and each option with the name of a keyword that differs from its default.
    `given` has the values of keywords that a command makes of its options.
    """
    every = {field.name: field.default for field in dataclasses.fields(args)}
    own = [name for name in (*DEFAULTS, *TASK_KEYWORDS) if name in every]
    leave(args.env, *own, *(name for name in ("threads",) if name in every))
    changed = {name: getattr(args, name) for name in own if getattr(args, name) != every[name]}
    return {**args.env, **changed, **given}


def heading_in_degrees(option: str, value: float) -> float:
    """Return the heading of an option, if it is at most a turn [deg]."""
    return check.number(option, value, least=-360.0, most=360.0)


def refuse_overwriting(file: Path, overwrite: bool) -> None:
    """Reject replacing the results of an earlier run without `--overwrite`."""
    if file.exists() and not overwrite:
        raise ValueError(f"{file} exists: use --overwrite to replace it, or another --output")


def sensors_of(env_id: str, given: str | None) -> str:
    """Name of the sensor suite: the one given, or else the task's default."""
    sensors: str = given or EnvConfig.of({}, IDS[env_id]).sensors.sensors
    return sensors


def free_folder(folder: Path, result: str) -> Path:
    """Folder without results: this one, or else FOLDER_2, FOLDER_3, ..."""
    names = itertools.chain([folder.name], (f"{folder.name}_{k}" for k in itertools.count(2)))
    found = (folder.with_name(name) for name in names)
    return next(path for path in found if not (path / result).exists())


def flying_options(keywords: Mapping[str, Any]) -> str:
    """Format keywords of an environment as options of `quad-gym evaluate`, each after a space."""
    rest = dict(keywords)
    words = [f"--{k} {rest.pop(k)}" for k in ("observation", "sensors", "estimator") if k in rest]
    return "".join(" " + word for word in words) + env_option(rest)


_WORDS = {"true": "True", "false": "False", "none": "None"}


def value_of(word: str) -> Any:
    """Convert a word to a Python literal such as a number, tuple, True or None, if it is one."""
    try:
        return ast.literal_eval(_WORDS.get(word, word))
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return word


def _pairs(words: Sequence[str]) -> dict[str, Any]:
    """Parse `key=value` pairs, with values as in `value_of`."""
    found = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not (equals and key.isidentifier()):
            raise ValueError(f"must be KEY=VALUE, got {word!r}")
        found[key] = value_of(value)
    return found


Keywords = Annotated[
    dict[str, Any],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="KEY=VALUE ...",
        instance_from_str=_pairs,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda value: [f"{k}={v}" for k, v in value.items()],
    ),
]
"""Keywords given as `key=value` pairs, such as `--env observation=truth camera=false`."""

Parameters = Annotated[
    Keywords, arg(help="parameters of the algorithm that override the recipe's, such as gamma=0.98")
]

Engine = Annotated[
    Literal["sb3", "compiled"],
    arg(
        help="training engine: Stable-Baselines3, or the compiled PPO, which is several times "
        "faster and needs no torch"
    ),
]

Threads = Annotated[
    int | None,
    arg(help="number of threads; defaults to one per core; it does not affect results"),
]

TRACKING = tuple(
    env_id for env_id, task in IDS.items() if task in TASK_DEFAULTS and task != "waypoints"
)
"""Ids of the general tasks with a reference to track."""

_ID_OF_TASK = {task: env_id for env_id, task in IDS.items()}


def full_id(name: str) -> str:
    """Convert the short name of a task, such as "circle", to its id; other names are unchanged."""
    return _ID_OF_TASK.get(name, name)


def one_of(ids: Sequence[str]) -> str:
    """Help text of an option with a choice of ids."""
    return f"task: {', '.join(IDS[env_id] for env_id in ids)}, or an id such as {ids[0]}"


def known_id(name: str, given: str, ids: Iterable[str] = IDS) -> str:
    """Convert an id or a short name to an id."""
    found, ids = full_id(given), tuple(ids)
    if found not in ids:
        # a task for other commands is not misspelled
        near = () if found in IDS else (*ids, *(IDS[env_id] for env_id in ids))
        raise ValueError(
            f"{name} must be one of {', '.join(ids)}, got {given!r}{did_you_mean(given, near)}"
        )
    return found


def with_full_id(args: _Args, ids: Iterable[str] = IDS) -> _Args:
    """Replace a short name in the field `env_id` of options by its id."""
    found = known_id("ENV_ID", args.env_id, ids)  # type: ignore[attr-defined]
    return replace(args, env_id=found)  # type: ignore[type-var]


EnvId = Positional[
    Annotated[
        str,
        PrimitiveConstructorSpec(
            nargs=1,
            metavar="ENV_ID",
            instance_from_str=lambda words: full_id(words[0]),
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [IDS.get(value, value)],
        ),
        arg(help=one_of(tuple(IDS))),
    ]
]
"""Positional argument: id of an environment, or short name of its task."""

TrackingId = Annotated[EnvId, arg(help=one_of(TRACKING))]
"""Positional argument: id or short name of a task with a reference to track."""

_OR_FILE = f"{', '.join(ALL_SUITES)}, or a file of SensorSuite.save (.toml)"

SuiteName = Annotated[str, arg(help=f"sensor suite: {_OR_FILE}")]

LogSuite = Annotated[
    str | None,
    arg(help=f"sensor suite: {_OR_FILE}; defaults to one with the sensors that the log has"),
]

OwnSuite = Annotated[
    str | None,
    arg(help=f"sensor suite: {_OR_FILE}; defaults to the task's default, standard for most"),
]

EstimatorName = Annotated[
    str | None,
    arg(
        help="estimator: ukf, ekf, or module:Class of a quad_gym.Estimator; defaults to the suite's"
    ),
]

Normalized = Annotated[
    str | None,
    arg(
        metavar="FILE",
        help="statistics with which a policy's observations were normalized in training: .pkl of "
        "VecNormalize, or .npz of baselines.normalization; none: it was trained without",
    ),
]

SuiteNames = Annotated[
    tuple[str, ...], arg(help=f"sensor suites: {', '.join(SUITES)}, or files of suites (.toml)")
]
