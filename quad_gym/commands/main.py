"""`quad-gym COMMAND`: imports and runs the module of the command."""

import importlib
import sys
from collections.abc import Sequence
from typing import Any

from quad_gym.commands.options import parse
from quad_gym.commands.refusals import INTERRUPTED, USAGE_ERROR
from quad_gym.params.checks import did_you_mean

COMMANDS = {
    "circle": "reproduce the report's experiment over many seeds: tables and figures",
    "train": "train a controller on the estimate, the truth, or another observation",
    "evaluate": "evaluate policies over many episodes: errors, crashes, videos",
    "compare": "train on the truth, on noise and on the estimate, and compare",
    "study": "train variants of policies on a benchmark task with several seeds, and compare",
    "sweep": "run sets of trainings on this machine, on a Slurm cluster, or with Ray",
    "tune": "tune the gains of the PD controller",
    "fly": "show a flight in a window, or render a video",
    "replay": "run the filter on the log of a real flight (CSV or PX4)",
    "consistency": "test the filter's consistency: NEES and NIS over many flights",
    "ablation": "measure the effects of filter corrections and of model mismatch",
    "benchmark": "measure the speed of all parts",
    "export policy": "export a trained policy to an autopilot: C or ONNX",
    "export filter": "export the parameters of a filter to an autopilot: C or JSON",
    "compile": "compile the kernels into the cache before their first use",
    "completion": "print a script for the completion of commands and options in a shell",
    "version": "print the version",
}
"""Commands, of one or two words, and their descriptions."""

PROGRAM = "quad-gym"


def usage(group: str = "") -> str:
    """Help text of `quad-gym` itself, or of the commands that begin with a word."""
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
        argv: Command and its options; None: the arguments of the process.

    Returns:
        Exit code.
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
    """Parse the options of a command and run it; Ctrl-C ends it with a message and exit code 130.

    Args:
        command: One of `COMMANDS`.
        argv: Options of the command; None: the arguments of the process.
        program: Name of the program in messages; None: the name of the process.

    Returns:
        Exit code.
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
        if reports := sys.modules.get("quad_gym.analysis.reports"):
            reports.remove_unused_folders()


def module_of(command: str) -> Any:
    """Import the module of one of `COMMANDS`, with its `Args` and its `main`."""
    name = "benchmark.main" if command == "benchmark" else command.replace(" ", "_")
    return importlib.import_module(f"quad_gym.commands.{name}")


def _interrupted(error: BaseException | None) -> bool:
    """True if an error was caused by Ctrl-C, which compilations turn into other errors."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
