"""Command lines: a frozen dataclass of options becomes a parser, through tyro.

A command declares its options once, with their types, defaults and, in the docstring below each,
its help text. Wrong options end the program with a message on stderr and exit code 2, as is the
custom on Unix.
"""

import ast
import dataclasses
import os
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from quad_gym.commands.help_texts import registry, wrapped
from quad_gym.commands.refusals import refuse, told_in_one_line
from quad_gym.envs import IDS
from quad_gym.envs.benchmarks import BENCHMARKS
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.envs.effects import runs_no_sensor
from quad_gym.envs.keywords import FILTER_KEYWORDS
from quad_gym.params.checks import did_you_mean
from quad_gym.params.suites import ALL_SUITES, SUITES

_Args = TypeVar("_Args")


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
        kind: Dataclass whose fields are the options.
        argv: Arguments without the program's name; None: those of the process.
        description: Text above the options in the help.
        program: Name of the program in its messages; None: that of the process.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    program = program or Path(sys.argv[0]).name
    asked = bool({"-h", "--help"} & set(words))
    try:
        if asked:
            words = ["--help"]  # with others, tyro leaves out what they give
            if description:  # of which it would join the lines, and wrap none
                print(wrapped(description))
                description = ""
        if any(word.startswith("--tyro-") for word in words):
            raise refuse("completions of all commands are printed by quad-gym completion", program)
        with nullcontext() if asked else told_in_one_line(program):
            args = tyro.cli(
                kind, args=words, description=description, prog=program, registry=registry()
            )
    except BrokenPipeError:  # nobody reads the help to its end, as of `--help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    _require_sound(args, words, program)
    return args


def _require_sound(args: Any, words: Sequence[str], program: str) -> None:
    """End the program if an option has what no command takes: nothing, or a negative seed."""
    for option in dataclasses.fields(args):
        name, value = option_name(option.name), getattr(args, option.name)
        if name in words and value in ((), {}):
            raise refuse(f"{name} must name at least one, got none", program)
        if name == "--seed" and value < 0:
            raise refuse(f"{name} must be at least 0, got {value}", program)


def option_name(field: str) -> str:
    """The option that a field of a dataclass declares, as it is written."""
    return f"--{field.replace('_', '-')}"


def require_at_least(args: Any, **least: int) -> None:
    """Refuse numbers that are too small; options that were not given, None, pass.

    Args:
        args: The dataclass of options.
        least: The smallest number that each of these fields may have.

    Raises:
        ValueError: If one is smaller.
    """
    for field, limit in least.items():
        value = getattr(args, field)
        if value is not None and value < limit:
            raise ValueError(f"{option_name(field)} must be at least {limit}, got {value}")


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
        told = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            told = f"{error.filename}: {error.strerror}"
            if isinstance(error, FileNotFoundError):
                told = f"there is no {error.filename}"
        raise refuse(told) from None


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


def refuse_overwriting(file: Path, overwrite: bool) -> None:
    """Refuse to replace the results of an earlier run unless it is told.

    Args:
        file: One of the results.
        overwrite: Whether it is told, by `--overwrite`.

    Raises:
        ValueError: If the file is there.
    """
    if file.exists() and not overwrite:
        raise ValueError(f"{file} exists: give --overwrite to replace it, or another --output")


def writable_file(output: Path | None, name: str, suffix: str, overwrite: bool) -> Path:
    """The file that an export writes, in a folder that can be written to.

    Args:
        output: The file that is given by `--output`; None: one in results/export.
        name: Its name then.
        suffix: The end of its name.
        overwrite: Whether it may be replaced.

    Raises:
        ValueError: If it ends otherwise, or is there already.
        OSError: If nothing can be written to the folder.
    """
    from quad_gym.analysis.reports import require_writable

    file = output or Path("results/export") / (name + suffix)
    if file.suffix != suffix:
        raise ValueError(f"--output must end in {suffix}, got {file}")
    refuse_overwriting(file, overwrite)
    require_writable("--output", file.parent)
    return file


def sensors_of(env_id: str, given: str | None) -> str:
    """The name of the sensor suite: what was given, or else the task's own."""
    own = BENCHMARKS.get(IDS[env_id])
    return given or ("standard" if own is None else own.keywords["sensors"])


def without_idle_filter(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Keywords of an environment, without those of a filter where none runs.

    A comparison flies several observations with the same keywords, and environments refuse
    keywords that have no effect.
    """
    idle = FILTER_KEYWORDS if runs_no_sensor(keywords) else ()
    return {name: value for name, value in keywords.items() if name not in idle}


def free_folder(folder: Path, result: str) -> Path:
    """A folder that holds no results yet: this one, or else FOLDER_2, FOLDER_3, ...

    Args:
        folder: The first to try.
        result: Name of a file that is there where there are results.
    """
    number, found = 1, folder
    while (found / result).exists():
        number += 1
        found = folder.with_name(f"{folder.name}_{number}")
    return found


def flying_options(keywords: Mapping[str, Any]) -> str:
    """Options of `quad-gym evaluate` for keywords of an environment, each after a space."""
    rest = dict(keywords)
    words = [f"--{k} {rest.pop(k)}" for k in ("observation", "sensors") if k in rest]
    if rest:
        words.append("--env " + " ".join(shlex.quote(f"{k}={v}") for k, v in rest.items()))
    return "".join(" " + word for word in words)


_WORDS = {"true": "True", "false": "False", "none": "None"}


def value_of(word: str) -> Any:
    """A value as Python writes numbers, tuples, True and None; else the word itself."""
    try:
        return ast.literal_eval(_WORDS.get(word, word))
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return word


def _pairs(words: Sequence[str]) -> dict[str, Any]:
    """`key=value` pairs, values as Python writes numbers, tuples, True and None; else texts.

    Raises:
        ValueError: If a word is no pair.
    """
    found = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not (equals and key.isidentifier()):
            raise ValueError(f"must be KEY=VALUE, got {word!r}")
        found[key] = value_of(value)
    return found


Keywords = Annotated[
    dict[str, Any],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="KEY=VALUE ...",
        instance_from_str=_pairs,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda value: [f"{k}={v}" for k, v in value.items()],
    ),
]
"""Keywords given as `key=value` pairs, such as `--env observation=truth camera=false`."""

TRACKING = tuple(
    env_id for env_id, task in IDS.items() if task in TASK_DEFAULTS and task != "waypoints"
)
"""The ids of the general tasks in which a reference is followed."""

_ID_OF_TASK = {task: env_id for env_id, task in IDS.items()}


def full_id(name: str) -> str:
    """The id of a task that is given by its short name, such as "circle"; else as it is."""
    return _ID_OF_TASK.get(name, name)


def one_of(ids: Iterable[str]) -> str:
    """The help of an option that chooses among ids."""
    ids = list(ids)
    return f"what to fly: {', '.join(IDS[env_id] for env_id in ids)}, or an id such as {ids[0]}"


def known_id(name: str, given: str, ids: Iterable[str] = IDS) -> str:
    """The id that is given, as it is or by its short name.

    Args:
        name: Of the argument.
        given: Its value.
        ids: Those that it may be.

    Raises:
        ValueError: If it is none of them.
    """
    found, ids = full_id(given), tuple(ids)
    if found not in ids:
        # a task that is another command's is not misspelt
        near = () if found in IDS else (*ids, *(IDS[env_id] for env_id in ids))
        raise ValueError(
            f"{name} must be one of {', '.join(ids)}, got {given!r}{did_you_mean(given, near)}"
        )
    return found


def with_full_id(args: _Args, ids: Iterable[str] = IDS) -> _Args:
    """Options whose `env_id` is the id, if it was given by its short name.

    Args:
        args: A dataclass with the field `env_id`.
        ids: Those that it may be.

    Raises:
        ValueError: If it is none of them.
    """
    found = known_id("ENV_ID", args.env_id, ids)  # type: ignore[attr-defined]
    return replace(args, env_id=found)  # type: ignore[type-var]


EnvId = tyro.conf.Positional[
    Annotated[
        str,
        tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="ENV_ID",
            instance_from_str=lambda words: full_id(words[0]),
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [IDS.get(value, value)],
        ),
        tyro.conf.arg(help=one_of(IDS)),
    ]
]
"""The id of an environment, or its task, given without the option's name."""

TrackingId = Annotated[EnvId, tyro.conf.arg(help=one_of(TRACKING))]
"""The same, of tasks in which a reference is followed."""

_OR_FILE = f"{', '.join(ALL_SUITES)}, or a file of SensorSuite.save (.toml)"

SuiteName = Annotated[str, tyro.conf.arg(help=f"sensor suite: {_OR_FILE}")]
"""The name of a sensor suite, or its file."""

OwnSuite = Annotated[
    str | None,
    tyro.conf.arg(
        help=f"sensor suite: {_OR_FILE}; if not given, the task's own, which for most is standard"
    ),
]
"""The name of a sensor suite, or None for the task's own."""

SuiteNames = Annotated[
    tuple[str, ...],
    tyro.conf.arg(help=f"sensor suites, of {', '.join(SUITES)}, or files of suites (.toml)"),
]
"""Names of sensor suites."""
