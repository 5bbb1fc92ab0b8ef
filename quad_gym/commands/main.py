"""`quad-gym COMMAND`: finds the command's module and runs it; each imports only what it needs."""

import importlib
import sys
from collections.abc import Sequence
from typing import Any

from quad_gym.commands.options import parse
from quad_gym.commands.refusals import INTERRUPTED, USAGE_ERROR
from quad_gym.params.checks import did_you_mean

COMMANDS = {
    "circle": "fly the laboratory's experiment over many seeds: tables and figures",
    "train": "train a controller on the estimate, the truth, or anything else it may see",
    "evaluate": "fly policies over many episodes: errors, crashes, films",
    "compare": "train on truth, noise and the estimate with several seeds, and compare",
    "study": "where the estimate decides: train arms with several seeds, and compare",
    "sweep": "any set of trainings: on this machine, a cluster with Slurm, or Ray",
    "tune": "tune the gains of the PD controller",
    "fly": "watch one flight in a window, or film it",
    "replay": "filter the log of a real flight: a table, or a log of PX4",
    "consistency": "is the filter's covariance right? NEES and NIS over many flights",
    "ablation": "what each correction of the filter is worth, and what wrong models cost",
    "benchmark": "measure the speed of everything",
    "export policy": "take a trained policy to an autopilot: C or ONNX",
    "export filter": "take the parameters of a filter to an autopilot: C or JSON",
    "compile": "compile the kernels ahead of their first use, into the cache",
    "completion": "print a script that completes commands and options with the Tab key",
    "version": "print the version",
}
"""Names of commands, of one word or two, and their descriptions."""

PROGRAM = "quad-gym"


def usage(group: str = "") -> str:
    """The help of `quad-gym` itself, or of the commands that begin with a word."""
    width = max(map(len, COMMANDS))
    shown = {name: text for name, text in COMMANDS.items() if name.startswith(group)}
    lines = "\n".join(f"  {name:{width}}   {text}" for name, text in shown.items())
    return (
        f"usage: {PROGRAM} COMMAND [options]\n\ncommands:\n{lines}\n\n"
        f"{PROGRAM} COMMAND --help explains a command.\n"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: The command and its options; None: those of the process.

    Returns:
        The exit code.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    groups = {name.split()[0] for name in COMMANDS if " " in name}
    group = [words.pop(0)] if words[:1] and words[0] in groups else []
    if words[:1] in (["-h"], ["--help"]):
        print(usage(*group), end="")
        return 0
    command = " ".join(group + words[:1])
    if command not in COMMANDS:
        got = f"got {command!r}" if command else "none given"
        meant = did_you_mean(command, COMMANDS)
        print(
            f"{PROGRAM}: error: the command must be one of {', '.join(COMMANDS)}, {got}{meant} "
            "(--help explains them)",
            file=sys.stderr,
        )
        return USAGE_ERROR
    return run(command, words[1:], program=f"{PROGRAM} {command}")


def run(command: str, argv: Sequence[str] | None = None, *, program: str | None = None) -> int:
    """Parse the options of one command and run it; Ctrl-C ends it with a word, and code 130.

    Args:
        command: One of COMMANDS.
        argv: Its options; None: those of the process.
        program: Its name in messages; None: that of the process.

    Returns:
        The exit code.
    """
    try:
        module = module_of(command)
        args = parse(module.Args, argv, description=module.__doc__, program=program)
        return module.main(args) or 0
    except (KeyboardInterrupt, Exception) as error:
        if not _interrupted(error):
            raise
        print("\nStopped by Ctrl-C.", file=sys.stderr)
        return INTERRUPTED
    finally:
        if reports := sys.modules.get("quad_gym.analysis.reports"):  # else it has made none
            reports.remove_unused_folders()


def module_of(command: str) -> Any:
    """The module of one of COMMANDS, with its `Args` and its `main`."""
    name = "benchmark.main" if command == "benchmark" else command.replace(" ", "_")
    return importlib.import_module(f"quad_gym.commands.{name}")


def _interrupted(error: BaseException | None) -> bool:
    """Whether an error comes of Ctrl-C: one in a compilation becomes another error."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
