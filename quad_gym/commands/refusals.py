"""Error messages for invalid options: one line on stderr, and exit code 2.

tyro frames its messages and appends the help of the option. They are converted here to the form of
the commands' own checks: the expected value and the one given.
"""

import io
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout

from quad_gym.params.checks import did_you_mean

USAGE_ERROR = 2
"""Exit code of a program that was called with invalid options."""

INTERRUPTED = 130
"""Exit code of a program that Ctrl-C has stopped."""

_WIDE = "10000"
"""Terminal width for tyro at which no message is wrapped."""


def refuse(told: str, program: str | None = None) -> SystemExit:
    """Print why options are invalid; return the exception that ends the program.

    Args:
        told: Reason.
        program: Program whose `--help` explains the options; None: no hint.
    """
    more = "" if program is None else f" ({program} --help explains the options)"
    print(f"error: {told}{more}", file=sys.stderr)
    return SystemExit(USAGE_ERROR)


@contextmanager
def told_in_one_line(program: str) -> Iterator[None]:
    """Context that prints tyro's error messages in one line.

    Args:
        program: Program whose `--help` explains the options.
    """
    # UTF-8, on which the frame depends, and no terminal, on which colors depend
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    columns = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _WIDE
    try:
        with redirect_stdout(out), redirect_stderr(err):
            yield
    except SystemExit as end:
        if end.code != USAGE_ERROR:
            raise
        err.seek(0)
        raise refuse(sentence(err.read()), program) from None
    except ValueError as error:  # of the dataclass, in older versions of tyro
        raise refuse(str(error), program) from None
    finally:
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns


def sentence(framed: str) -> str:
    """Convert a message of tyro to one sentence.

    Args:
        framed: Frame with parts separated by lines: message, suggestion, help of the option, and
            hint on more help.
    """
    parts: list[list[str]] = [[]]
    for line in framed.splitlines():
        words = line.strip("│ ")
        if line[:1] in ("╭", "╰"):
            continue
        if words and not words.strip("─"):
            parts.append([])
        else:
            parts[-1].append(words)
    told = " ".join(filter(None, parts[0]))
    if match := re.fullmatch(r"Error parsing (\S+): (.*)", told, re.DOTALL):
        option, why = match.groups()
        if not option.startswith("-") and not option.isupper():  # name of the dataclass
            return why
        return f"{option} {why}"
    if match := re.fullmatch(r"invalid choice '(.*)' for argument '(.*)'. .* \((.*)\)\.", told):
        got, option, listed = match.groups()
        choices = re.findall("'(.*?)'", listed)
        known = ", ".join(choices)
        return f"{option} must be one of {known}, got {got!r}{did_you_mean(got, choices)}"
    if match := re.fullmatch(r"Missing value for argument '(.*)'. Expected (\d+) values.", told):
        option, count = match.groups()
        option = option.strip("()',")  # of former versions of tyro
        if not option.startswith("-"):
            return f"{option.upper()} must be given"
        return f"{option} must have {count} value{'s' if count != '1' else ''}, got fewer"
    if match := re.fullmatch(r"Missing from .*?: (\S+) (.*?)(?: \(required\))?", told):
        return f"{match[1]} must be given: {match[2]}"
    if match := re.fullmatch(r"Unrecognized options: (.*)", told):
        meant = re.findall(r"--[\w-]+", " ".join(_names(parts)))
        close = f"; did you mean {' or '.join(dict.fromkeys(meant))}?" if meant else ""
        return f"unrecognized options: {match[1].replace(', ', ' ')}{close}"
    return told or framed.strip()


def _names(parts: list[list[str]]) -> Iterator[str]:
    """Lines with options similar to an unknown one."""
    for part in parts[1:]:
        if part[0].startswith(("Perhaps you meant", "Arguments similar to")):
            yield from (line for line in part[1:] if line.startswith("--"))
