"""Commands in the process of the test, which saves imports; `line` is for separate processes."""

import contextlib
import io
import re
import sys
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import pytest

from quad_gym.commands.main import main


class Ended(NamedTuple):
    """Exit code and output of a command."""

    returncode: int
    stdout: str
    stderr: str


def line(command, *options):
    """The command line that runs `quad-gym COMMAND` in a separate process."""
    return [sys.executable, "-m", "quad_gym", command, *map(str, options)]


def without_figures():
    """Figures are empty files: drawing takes most of the time of a short run."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return contextlib.nullcontext()
    return mock.patch.object(Figure, "savefig", lambda self, file, **_: Path(file).touch())


def run(command, *options, where=None, figures=False):
    """Run `quad-gym COMMAND` with its options, in the folder `where`; `figures`: draw them."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        stack.enter_context(contextlib.nullcontext() if figures else without_figures())
        if where is not None:
            stack.enter_context(contextlib.chdir(where))
        try:
            code = main([command, *map(str, options)])
        except SystemExit as end:
            if isinstance(end.code, str):
                print(end.code, file=err)
            code = 0 if end.code is None else end.code if isinstance(end.code, int) else 1
    return Ended(code, out.getvalue(), err.getvalue())


def refused(words, capsys):
    """The message of a command line that ends with a usage error."""
    with pytest.raises(SystemExit) as end:
        main(words.split() if isinstance(words, str) else words)
    assert end.value.code == 2
    return plain(capsys.readouterr().err)


def plain(text: str) -> str:
    """The words of `text` on one line, without the frames around the parser's messages."""
    return " ".join(re.sub("[╭╮╰╯│─]", " ", text).split())
