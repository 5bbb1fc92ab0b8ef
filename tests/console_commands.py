"""Commands run in the test's own process, which has imported already what each would import anew.
What needs a process of its own, such as a signal, starts one by `line`."""

import contextlib
import io
import re
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from quad_gym.commands.main import main

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


class Ended(NamedTuple):
    """How a command has ended."""

    returncode: int
    stdout: str
    stderr: str


def line(script, *options):
    """The line that runs a script in a process of its own."""
    return [sys.executable, str(SCRIPTS / script), *map(str, options)]


def run(command, *options, where=None):
    """Run `quad-gym COMMAND` with its options, in a folder of its own if one is given."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
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
    """The words of `text` on one line, without the frames that messages of the parser have."""
    return " ".join(re.sub("[╭╮╰╯│─]", " ", text).split())
