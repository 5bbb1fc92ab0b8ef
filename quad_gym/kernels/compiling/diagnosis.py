"""Compilation of one stage, and its first error in a few lines.

Numba nests errors: the text begins with the cause, and each kernel on the way to the stage adds
where it calls the one before.
"""

import ast
import importlib
import inspect
import itertools
import re
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

from numba.core.errors import NumbaError
from numba.core.ir import Loc

from quad_gym.kernels.compiling import decorators
from quad_gym.params import checks as check

_PLACE = re.compile(r"^During: (?:typing of .*|lowering .*) at (.*) \((\d+)\)$", re.MULTILINE)
_CALLEE = re.compile(r"KernelDispatcher\(<function ([\w.<>]+) at")
_WORDS = (
    (r"UniTuple\(UniTuple\(Lanes(?: x|,) 3\)(?: x|,) 3\)", "matrix"),
    (r"UniTuple\(Lanes(?: x|,) 3\)", "vector"),
    (r"UniTuple\(Lanes(?: x|,) (\d)\)", r"vector of \1"),
    (r"LaneRecord\(\w+\)", "record"),
    (r"\bLanes\b", "number"),
    (r"\('wrong tuple length for [^']*', '(.*)'\)", r"wrong number of values: \1"),
    (r"Function\(<(?:built-in function|intrinsic|function) ([\w.]+)[^>]*>\)", r"\1"),
)
"""Types and functions in Numba's words, and in plain ones."""
_CALLERS = 4  #: largest number of callers that are listed


class StageError(Exception):
    """A stage does not compile; its text says which kernel and line is wrong, and why."""


def compile_one(name: str) -> str:
    """Compile a stage, and return its full name.

    Args:
        name: "module:kernel" of the stage, such as "sensors.barometer:barometer", in
            `quad_gym.kernels` or by its full name.

    Raises:
        ValueError: If there is no such stage.
        StageError: If it does not compile, or its module cannot be imported.
    """
    module_name, _, kernel = name.partition(":")
    kernel = kernel.removesuffix("_stage") + "_stage"
    module = _module_of(f"quad_gym.kernels.{module_name}") or _module_of(module_name)
    if module is None:
        raise ValueError(f"--stage must be MODULE:KERNEL of quad_gym.kernels, got {name!r}")
    stage: Any = getattr(module, kernel, None)
    if not hasattr(stage, "signature"):
        known = [other for other, value in vars(module).items() if hasattr(value, "signature")]
        raise ValueError(
            f"--stage must be a stage of {module.__name__}, got {kernel}"
            f"{check.did_you_mean(kernel, known)}"
        )
    try:
        stage.compile(stage.signature)
    except Exception as error:
        text = f"{module.__name__}:{kernel} does not compile\n{_explained(error)}"
        raise StageError(text) from None
    return f"{module.__name__}:{kernel}"


def _module_of(name: str) -> ModuleType | None:
    """Import a module; None: there is none of this name."""
    if not all(map(str.isidentifier, name.split("."))):
        return None
    try:
        return importlib.import_module(name)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and name.startswith(error.name or " "):
            return None
        lines = [f"{name} cannot be imported"]
        frames = traceback.extract_tb(error.__traceback__)
        ran = [frame for frame in frames if frame.name == "<module>" and frame.line]
        if ran:
            lines.append(f"  line: {_short(ran[-1].filename)}:{ran[-1].lineno}: {ran[-1].line}")
        lines.append(f"  reason: {type(error).__name__}: {error}")
        raise StageError("\n".join(lines)) from None


def _explained(error: Exception) -> str:
    """Return the place of an error, its reason, and the kernels that lead to it."""
    text = re.sub(r"\x1b\[\d*m", "", str(error))
    wrapper = inspect.getfile(decorators)
    places = dict[str, tuple[str, int, str]]()  # the first of each kernel
    for file, line in _PLACE.findall(text) or _places_of(error):
        kernel, source = _at(Path(file), int(line))
        if file != wrapper and kernel not in places:
            places[kernel] = (file, int(line), source)
    lines = [] if places else [f"  kernel: {_without_place(text)}"]
    for kernel, (file, line, source) in itertools.islice(places.items(), 1 + _CALLERS):
        word = "called by" if lines else "kernel"
        lines.append(f"  {word}: {kernel}, {_short(file)}:{line}: {source}")
    own = isinstance(error, NumbaError)
    lines.insert(1, f"  reason: {_reason(text if own else f'{type(error).__name__}: {error}')}")
    return "\n".join(lines)


def _places_of(error: Exception) -> list[tuple[str, int]]:
    """Return the places at which Numba was, the innermost first: some errors name none."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    found = [getattr(frame.f_locals.get("self"), "loc", None) for frame in reversed(frames)]
    return [(loc.filename, loc.line) for loc in found if isinstance(loc, Loc)]


def _reason(text: str) -> str:
    """Return the cause in a line."""
    cause = re.split(r"^(?:During:|File \")", text, maxsplit=1, flags=re.MULTILINE)[0]
    lines = [line.strip() for line in cause.splitlines()]
    lines = [line for line in lines if line and not line.startswith("Failed in nopython")]
    found = lines[0] if lines else "unknown"
    if found.startswith("No implementation") and len(lines) > 1:
        found = f"{found.removesuffix(':')} {lines[1].lstrip('> ')}"
    for pattern, word in _WORDS:
        found = re.sub(pattern, word, found)
    return found if len(found) <= 300 else f"{found[:300]} ..."


def _without_place(text: str) -> str:
    """Return the kernel of an error that names no line, and the line with an unknown name."""
    callee, unknown = _CALLEE.search(text), re.search(r"name '(\w+)' is not defined", text)
    name = callee.group(1) if callee else "the stage"
    for module in list(sys.modules.values()):
        if unknown is None or name not in getattr(module, "__dict__", {}):
            continue
        file = inspect.getfile(module)
        for number, line in enumerate(Path(file).read_text(encoding="utf-8").splitlines(), 1):
            used = re.search(rf"\b{unknown.group(1)}\b", line)
            if used and _at(Path(file), number)[0] == name:
                return f"{name}, {_short(file)}:{number}: {line.strip()}"
    return name


def _at(file: Path, line: int) -> tuple[str, str]:
    """Return the innermost function at a line of a file, and the text of the line."""
    source = file.read_text(encoding="utf-8")
    around = [
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef) and node.lineno <= line <= (node.end_lineno or 0)
    ]
    name = max(around, key=lambda node: node.lineno).name if around else "module"
    return name, source.splitlines()[line - 1].strip()


def _short(file: str) -> str:
    path = Path(file)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else file
