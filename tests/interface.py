"""The list of the public interface in `tests/data/interface.txt`, from the code.

    python -m tests.interface            # add new names
    python -m tests.interface --remove   # and remove missing ones, for a version 2.0

One line for each public name, each parameter with its default, each environment and each option of
a command. Public are the names on the pages in `docs/api`, the ids and the commands.
"""

import argparse
import contextlib
import importlib
import inspect
import io
import re
import sys
from enum import Enum
from pathlib import Path
from unittest import mock

import quad_gym
from quad_gym import IDS
from quad_gym.commands.main import COMMANDS
from quad_gym.commands.main import main as run_command

ROOT = Path(__file__).parents[1]
FILE = ROOT / "tests" / "data" / "interface.txt"
NUMBERS = (bool, int, float, str, type(None))


def is_ours(thing):
    return str(getattr(thing, "__module__", "")).startswith(("quad_gym", "baselines"))


def shown(default):
    """A default, if it is a number, a text or a tuple of them; otherwise its type."""
    if isinstance(default, tuple):
        return f"({', '.join(map(shown, default))})"
    if isinstance(default, Enum):
        return str(default)
    return repr(default) if isinstance(default, NUMBERS) else f"<{type(default).__name__}>"


def lines_of_parameters(name, function):
    """A line for each parameter of a function or class."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # built in C, such as the constructor of an exception
        return
    for place, p in enumerate(parameters):
        if p.name == "self" or p.name.startswith("_"):
            continue
        kind = f"{place}" if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) else "by name"
        if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD):
            kind = "any number"
        default = "" if p.default is p.empty else f" = {shown(p.default)}"
        yield f"{name}({p.name}{default}), {kind}"


def lines_of(name, thing):
    """Lines of a public function, class or constant."""
    if inspect.isclass(thing):
        yield f"{name}: class"
        if issubclass(thing, Enum):
            for member in thing:
                yield f"{name}.{member.name} = {shown(member.value)}"
            return
        yield from lines_of_parameters(name, thing)
        ours = [base for base in thing.__mro__ if is_ours(base)]
        members = {n for base in ours for n in vars(base)}
        members |= {n for base in ours for n in inspect.get_annotations(base)}
        for member in sorted(n for n in members if not n.startswith("_")):
            value = inspect.getattr_static(thing, member, None)
            value = getattr(value, "__func__", value)
            if inspect.isfunction(value):
                yield f"{name}.{member}: method"
                yield from lines_of_parameters(f"{name}.{member}", value)
            else:
                yield f"{name}.{member}: attribute"
    elif inspect.isroutine(thing):
        yield f"{name}: function"
        yield from lines_of_parameters(name, thing)
    else:
        yield f"{name}: {'module' if inspect.ismodule(thing) else 'constant'}"


def public_things():
    """The names on the pages of the API, with the things that they name."""
    text = "\n".join(p.read_text(encoding="utf-8") for p in (ROOT / "docs" / "api").glob("*.md"))
    for path in re.findall(r"auto(?:class|function|data):: ([\w.]+)", text):
        module, _, name = path.rpartition(".")
        yield path, getattr(importlib.import_module(module), name)
    for path in re.findall(r"automodule:: ([\w.]+)", text):
        module = importlib.import_module(path)
        yield path, module
        for name, value in vars(module).items():
            here = getattr(value, "__module__", None) == path
            if not name.startswith("_") and (here or name in getattr(module, "__all__", ())):
                yield f"{path}.{name}", value
    for name in quad_gym.__all__:
        yield f"quad_gym.{name}", getattr(quad_gym, name)


def lines_of_commands():
    """Commands with their options, from their help."""
    for command in COMMANDS:
        yield f"quad-gym {command}"
        text = io.StringIO()
        wide = mock.patch.dict("os.environ", {"COLUMNS": "200"})
        with wide, contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            run_command([*command.split(), "--help"])
        starts = re.findall(r"^\W*?((?:-\w, )?--[a-z][\w-]*(?:, --[\w-]+)*)", text.getvalue(), re.M)
        for option in re.findall(r"--[\w-]+", " ".join(starts)):
            yield f"quad-gym {command} {option}"


def interface():
    """All lines, sorted."""
    lines, shortest = set(), {}
    for name, thing in sorted(public_things(), key=lambda pair: (len(pair[0]), pair[0])):
        known = isinstance(thing, type) or inspect.isfunction(thing)
        first = shortest.setdefault(id(thing), name) if known else name
        lines |= set(lines_of(name, thing)) if first == name else {f"{name}: same as {first}"}
    lines |= {f"id {name}" for name in IDS}
    return sorted(lines.union(lines_of_commands()))


def main(argv=None):
    """Renew the list; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--remove", action="store_true", help="remove what is gone, too")
    remove = parser.parse_args(argv).remove
    found = interface()
    kept = FILE.read_text(encoding="utf-8").splitlines() if FILE.exists() else []
    gone = [line for line in kept if line not in found]
    print("\n".join(f"{'removed' if remove else 'gone'}: {line}" for line in gone))
    FILE.write_text("\n".join(sorted({*found, *(() if remove else gone)})) + "\n", encoding="utf-8")
    print(f"{len(found)} lines, {len(set(found) - set(kept))} of them new: {FILE}")
    return 1 if gone and not remove else 0


if __name__ == "__main__":
    sys.exit(main())
