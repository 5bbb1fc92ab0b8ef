"""`quad-gym COMMAND`: subcommands of tyro, of which only the one that runs is imported."""

import importlib
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Union, get_type_hints

from tyro.conf import subcommand

from quad_gym.commands.options import USAGE_ERROR, parse, quiet_end, with_plain_help

COMMANDS = {
    "circle": "reproduce the report's experiment over many seeds: tables and figures",
    "train": "train a controller on the estimate, the truth, or another observation",
    "evaluate": "evaluate policies over many episodes: errors, crashes, videos",
    "compare": "train on the truth, on noise and on the estimate, and compare",
    "sweep": "run sets of trainings, on one machine or on several that share a folder",
    "tune": "tune the gains of the PD controller",
    "fly": "show a flight in a window, or render a video",
    "replay": "run the filter on the log of a real flight (CSV, PX4, ArduPilot, ROS, EuRoC)",
    "calibrate": "find the noise and delays of a vehicle's sensors from the log of a flight",
    "consistency": "test the filter's consistency: NEES and NIS over many flights",
    "benchmark": "measure the speed of flights on this machine",
    "export policy": "export a trained policy to an autopilot: C or ONNX",
    "export filter": "export a filter to an autopilot: a C library with the same estimates",
    "compile": "compile the kernels before their first use, or build libraries of them",
    "version": "print the version, and a report on this machine for bug reports",
}
"""Commands, of one or two words, and their descriptions."""

INTERRUPTED = 130  #: exit code of a program that Ctrl-C has stopped


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and its options, of the process by default; returns the exit code.

    Ctrl-C ends it with a message.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        with quiet_end():
            args = parsed(words)
            return sys.modules[type(args).__module__].main(args) or 0
    except (KeyboardInterrupt, Exception) as error:
        from quad_gym.kernels.library import NoKernelsError

        if _cause(error, KeyboardInterrupt):
            print("\nStopped by Ctrl-C.", file=sys.stderr)
            return INTERRUPTED
        if missing := _cause(error, NoKernelsError):
            print(f"\nerror: {missing}", file=sys.stderr)
            return USAGE_ERROR
        raise
    finally:
        if reports := sys.modules.get("quad_gym.analysis.reports"):
            reports.remove_unused_folders()


def parsed(words: Sequence[str]) -> Any:
    """Parse the options of the command that `words` call, or print the help of all commands."""
    for command in COMMANDS:
        name = command.split()
        if list(words[: len(name)]) == name:
            module = module_of(command)
            about = {"prog": f"quad-gym {command}", "description": module.__doc__}
            return parse(options_of(module), words[len(name) :], **about)
    return parse(subcommands(words), words, prog="quad-gym", description="")


def subcommands(words: Sequence[str]) -> Any:
    """Union of all commands for tyro, with the options of the one that `words` call.

    Scripts for completion (`--tyro-print-completion`) need the options of every command.
    """
    everything = any(word.startswith("--tyro-") for word in words)
    unions: dict[str, list[Any]] = {}
    for command, text in COMMANDS.items():
        kind: Any = _not_called
        name = command.split()
        if everything or list(words[: len(name)]) == name:
            module = module_of(command)
            kind, text = options_of(module), module.__doc__
        chosen = subcommand(name[-1], constructor=kind, description=text)
        unions.setdefault(name[0], []).append(Annotated[Any, chosen])
    export = subcommand("export", description="export a policy or a filter to an autopilot")
    unions["export"] = [Annotated[Union[tuple(unions["export"])], export]]  # noqa: UP007
    return Union[tuple(kind for union in unions.values() for kind in union)]  # noqa: UP007


def _not_called() -> None:
    """Stand-in for the options of the other commands."""


def module_of(command: str) -> Any:
    """Import the module of one of `COMMANDS`, with its options and its `main`."""
    return importlib.import_module(f"quad_gym.commands.{command.replace(' ', '_')}")


def options_of(module: Any) -> Any:
    """Dataclass of a command's options, the argument of its `main`."""
    return with_plain_help(get_type_hints(module.main)["args"])


def _cause(error: BaseException | None, kind: type[BaseException]) -> BaseException | None:
    """Return the error of a kind that caused an error, as compilations turn Ctrl-C into others."""
    while error is not None and not isinstance(error, kind):
        error = error.__cause__ or error.__context__
    return error
