"""Break lines on purpose, one at a time, and see whether the tests nearest to them notice.

    python -m scripts.mutants --count 150 --seed 0 --output results/mutants.csv

A seed chooses the lines, in kernels, packing, parameters, estimation and tasks, and how each is
broken: an operator, a comparison, a number, a branch. A copy of the checkout has one broken line,
and runs the test files that are nearest to it: those that import its module, or share rare words
with its line, its function and their docstrings. Of the tests in these files, the nearest ones run,
and the first failure ends the run. Golden flights, which notice any change of a flight, are left
out, as are a few files of which a test takes minutes.

A line of a kernel is broken in a process whose other kernels are compiled already
(`mutants_of_kernels.py`), without tests that start processes of their own. If the nearest tests
pass, those run that are nearest to the kernels that call it. Lines of which the rest of the kernels
depends in another way, such as constants of a module, run last: each compiles most kernels again.

The table has one row for each mutant:

- `caught`: a test failed, which the table names, or the process crashed. At the end, all these
  tests run once with unbroken lines, where they must pass.
- `survived`: these tests passed. The line is equivalent, another test notices it, or a test is
  missing.
- `stopped`: the tests took longer than the limit, so the result is open. Remove the row, and
  continue with a larger limit.

Its seconds are of processor time.

A run that is interrupted continues where it stopped: mutants in the table are not run again.
"""

import ast
import contextlib
import csv
import functools
import inspect
import json
import math
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from quad_gym.commands.options import parse, quiet_end, require_at_least, usage_errors
from quad_gym.params import checks as check

ROOT = Path(__file__).parents[1]
FOLDERS = ("kernels", "packing", "params", "estimation", "tasks")
"""Folders of the package in which lines are broken."""
COLUMNS = ("mutant", "file", "line", "before", "after", "result", "seconds", "noticed", "tests")
_COPIED = (
    "quad_gym",
    "baselines",
    "scripts",
    "docs",
    "tests",
    "pyproject.toml",
    "constraints.txt",
    "Makefile",
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "CITATION.cff",
    "LICENSE",
    "SECURITY.md",
)
_LEFT_OUT = {"tests/contract/test_golden.py", "tests/scripts/test_mutants.py"}
_COSTLY = {
    "tests/contract/test_browser_page.py",
    "tests/unit/test_calibration.py",
    "tests/unit/test_device.py",
    "tests/unit/test_filter_library.py",
}
"""Files of which a test takes minutes, or compiles for another processor: left out, too."""
_PROCESSES = re.compile(
    r"subprocess|run_python|AsyncVectorEnv|multiprocessing|kernels\.compiling(\.| import )cache"
)
"""Text in files of tests of which processes, or the cache, would compile all kernels again."""
_FAST = {
    "QUAD_GYM_KERNELS": "numba",
    "QUAD_GYM_LANES": "2",
    "NUMBA_OPT": "1",
    "OMP_NUM_THREADS": "1",
}
"""Settings with which kernels compile fast; the bits of flights do not depend on them."""
_WORD = re.compile(r"[A-Za-z][a-z]{3,}|[A-Z]{4,}")
_FIRST, _MOST = 10, 120
"""Number of tests that run first, and of all that run."""
_WORDS_OF = "QUAD_GYM_MUTANT"  #: variable with the words of the mutant, for pytest's process
_OPERATORS: dict[type[ast.AST], str] = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.And: "or",
    ast.Or: "and",
    ast.Lt: ">=",
    ast.LtE: ">",
    ast.Gt: "<=",
    ast.GtE: "<",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.BitAnd: "|",
    ast.BitOr: "&",
    ast.Is: "is not",
    ast.IsNot: "is",
}
"""Replacements of operators in broken lines."""
_TEXT: dict[type[ast.AST], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.And: "and",
    ast.Or: "or",
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.BitAnd: "&",
    ast.BitOr: "|",
    ast.Is: "is",
    ast.IsNot: "is not",
}


class Mutant(NamedTuple):
    """One way of breaking one line."""

    file: str  #: path in the checkout
    line: int  #: number of the line, from 1
    before: str
    after: str
    weights: tuple[
        tuple[str, float], ...
    ]  #: words of line, function and module, how much each counts
    function: str = ""  #: name of the function; "" outside of functions

    @property
    def name(self) -> str:
        """Name in the table, which is the same in another run."""
        return f"{self.file}:{self.line}: {self.after.strip()}"


@dataclass(frozen=True)
class MutantsArgs:
    """Options of the campaign."""

    count: int = 150
    """number of lines to break"""
    seed: int = 0
    """seed of their choice"""
    only: tuple[str, ...] = FOLDERS
    """folders whose mutants run, of the `count` chosen ones"""
    nearest: int = 6
    """number of test files that run for each"""
    limit: float = 900.0
    """time after which the tests of a mutant are stopped [s]: processor time for lines of kernels,
    otherwise elapsed time; the result is then open"""
    output: Path = Path("results/mutants.csv")
    """table, which is continued"""


def folder_of(mutant: Mutant) -> str:
    """Return the folder, or the file, of the package in which a line is broken."""
    return Path(mutant.file).parts[1].removesuffix(".py")


@functools.lru_cache(maxsize=4096)  # the texts of all tests are compared with each mutant
def words_of(text: str) -> tuple[str, ...]:
    """Split a text, and names in it, into words without their plural."""
    return tuple(word.lower().rstrip("s") for word in _WORD.findall(text))


def mutants_of(path: Path) -> list[Mutant]:
    """Return all ways of breaking lines of a file of the checkout."""
    text = (ROOT / path).read_text(encoding="utf-8")
    lines, found, tree = text.splitlines(), list[Mutant](), ast.parse(text)
    shared = Counter[str]()
    for weight, words in ((3.0, path.stem), (0.5, ast.get_docstring(tree) or "")):
        shared.update(dict.fromkeys(words_of(words), weight))  # type: ignore[arg-type]
    for function, node in _nodes(tree, None):
        for line, begin, end, new in _edits(node, lines):
            before = lines[line - 1]
            weights = shared.copy()
            parts = [(1.0, before)]
            if function is not None:
                parts += [(2.0, function.name), (1.0, ast.get_docstring(function) or "")]
            for weight, words in parts:
                weights.update(dict.fromkeys(words_of(words), weight))  # type: ignore[arg-type]
            after = before[:begin] + new + before[end:]
            name = "" if function is None else function.name
            found.append(Mutant(str(path), line, before, after, tuple(weights.items()), name))
    return found


def _nodes(
    tree: ast.AST, function: ast.FunctionDef | None
) -> Iterator[tuple[ast.FunctionDef | None, ast.AST]]:
    """Yield the nodes of a tree with their functions; no annotations and texts."""
    for name, value in ast.iter_fields(tree):
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or name in ("annotation", "returns"):
                continue
            inner = child if isinstance(child, ast.FunctionDef) else function
            if not isinstance(child, ast.JoinedStr | ast.Raise | ast.Import | ast.ImportFrom):
                yield inner, child
                yield from _nodes(child, inner)


def _edits(node: ast.AST, lines: Sequence[str]) -> Iterator[tuple[int, int, int, str]]:
    """Yield (line, first column, end column, new text) of edits of one node within a line."""
    if isinstance(node, ast.Constant):
        value, end = node.value, node.end_col_offset or 0
        if isinstance(value, bool):
            yield node.lineno, node.col_offset, end, str(not value)
        elif isinstance(value, int | float):
            more = value + 1 if isinstance(value, int) else 1.5 * value + 0.25
            yield node.lineno, node.col_offset, end, repr(more)
    elif isinstance(node, ast.BinOp):
        yield from _operator(node.left, node.op, node.right, lines)
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        yield from _operator(node.left, node.ops[0], node.comparators[0], lines)
    elif isinstance(node, ast.BoolOp):
        yield from _operator(node.values[0], node.op, node.values[1], lines)
    elif (
        isinstance(node, ast.Call)
        and getattr(node.func, "id", "") == "select"
        and len(node.args) == 3
    ):
        _, one, other = node.args
        if one.lineno == other.end_lineno and other.end_col_offset is not None:
            row = lines[one.lineno - 1]
            texts = ast.get_source_segment("\n".join(lines), one), row[other.col_offset :]
            second = texts[1][: other.end_col_offset - other.col_offset]
            yield one.lineno, one.col_offset, other.end_col_offset, f"{second}, {texts[0]}"


def _operator(
    left: ast.expr, op: ast.AST, right: ast.expr, lines: Sequence[str]
) -> Iterator[tuple[int, int, int, str]]:
    """Yield the edit that replaces an operator between two operands on one line."""
    if type(op) not in _OPERATORS or left.end_lineno != right.lineno:
        return
    begin, row = left.end_col_offset or 0, lines[right.lineno - 1]
    place = row.find(_TEXT[type(op)], begin, right.col_offset)
    if place >= 0:
        yield right.lineno, place, place + len(_TEXT[type(op)]), _OPERATORS[type(op)]


def chosen(count: int, seed: int) -> list[Mutant]:
    """Choose mutants on different lines, the same for the same sources and seed."""
    paths = sorted(
        path.relative_to(ROOT)
        for folder in FOLDERS
        for path in [*(ROOT / "quad_gym" / folder).rglob("*.py"), ROOT / f"quad_gym/{folder}.py"]
        if path.exists()
    )
    every = [mutant for path in paths for mutant in mutants_of(path)]
    random.Random(seed).shuffle(every)
    by_line: dict[tuple[str, int], Mutant] = {}
    for mutant in every:
        by_line.setdefault((mutant.file, mutant.line), mutant)
    return list(by_line.values())[:count]


def with_callers(mutant: Mutant) -> Mutant:
    """Return a mutant of a kernel with words of the kernels that call its function, and so on.

    Words of a caller count half as much as those of the function that it calls. A function that no
    kernel calls by its name, as a function of a sensor's stage, keeps its own words.
    """
    weights, names, weight = Counter[str](), {mutant.function} - {""}, 2.0
    seen = set(names)
    while names and weight > 0.2:
        weight *= 0.5
        found = [kernel for kernel in _kernels() if kernel[3] & names and kernel[1] not in seen]
        for file, name, text, _ in found:
            for share, words in ((1.5, Path(file).stem), (1.0, name), (0.5, text)):
                for word in words_of(words):
                    weights[word] = max(weights[word], share * weight)  # type: ignore[assignment]
        names = {kernel[1] for kernel in found}
        seen |= names
    return mutant._replace(weights=tuple(weights.items()), function="") if weights else mutant


@functools.cache
def _kernels() -> list[tuple[str, str, str, set[str]]]:
    """Return files, names and docstrings of all kernels, and the names that each uses."""
    return [
        (str(path), node.name, ast.get_docstring(node) or "", names - {node.name})
        for path in sorted((ROOT / "quad_gym" / "kernels").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
        for names in [{part.id for part in ast.walk(node) if isinstance(part, ast.Name)}]
    ]


def nearness(weights: dict[str, float], words: Sequence[str]) -> float:
    """Return the nearness of a text to a mutant, by the words that they share.

    This is the usual rank of texts in a search (BM25): rare words count more, as `weights` say,
    and so do repeated words, and words in short texts.
    """
    counts = Counter(words)
    half = 0.6 + 0.9 * len(words) / 1500.0
    return sum(
        weight * counts[word] / (counts[word] + half)
        for word, weight in weights.items()
        if counts[word]
    )


def nearest_tests(mutant: Mutant, count: int, texts: dict[str, str]) -> list[str]:
    """Return the test files nearest to a mutant, the nearest first.

    Importing its module counts as a few rare words, and so does the name of its function.
    """
    module = mutant.file.removesuffix(".py").replace("/", ".")
    words = {name: words_of(text) for name, text in texts.items()}
    files = Counter(word for found in words.values() for word in set(found))
    weights = {
        word: weight * math.log(len(texts) / files[word])
        for word, weight in mutant.weights
        if files[word]
    }
    rank = {
        name: nearness(weights, words[name])
        + 8.0 * (re.search(rf"\b{re.escape(module)}\b", text) is not None)
        + 8.0
        * (
            re.search(rf"\b{re.escape(mutant.function)}\b", text) is not None
            and len(mutant.function) > 5
        )
        for name, text in texts.items()
    }
    return sorted(rank, key=lambda name: (-rank[name], name))[:count]


def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Run the tests first that are nearest to the mutant; a hook, as pytest loads this module.

    Others follow in the order of their files, of each file as many as of others: its nearest tests,
    each with its first parameters before any with further ones.
    """
    words = [words_of(inspect.getsource(item.function)) for item in items]
    tests = Counter(word for found in words for word in set(found))
    weights = {
        word: weight * math.log(len(items) / tests[word])
        for word, weight in json.loads(os.environ[_WORDS_OF])
        if tests[word]
    }
    known, places = Counter[Any](), list[tuple[int, float]]()
    for item, found in zip(items, words, strict=True):
        places.append((known[item.function], -nearness(weights, found)))
        known[item.function] += 1
    order = sorted(range(len(items)), key=lambda k: (places[k][1], places[k][0]))
    nearest, turns, rest = order[:_FIRST], Counter[Any](), list[tuple[int, int]]()
    for k in sorted(set(order[_FIRST:]), key=places.__getitem__):
        rest.append((turns[items[k].path], k))
        turns[items[k].path] += 1
    others = [k for _, k in sorted(rest)[: _MOST - _FIRST]]
    items[:] = [items[k] for k in [*nearest, *sorted(others)]]


def arguments_of(mutant: Mutant | None, tests: Sequence[str]) -> list[str]:
    """Return the arguments of pytest: all tests, or the nearest ones up to the first failure."""
    ordered = [] if mutant is None else ["-x", "-p", "scripts.mutants"]
    return ["-q", "-m", "not slow", "-k", "not golden", *ordered, *tests]


def outcome(code: int, printed: str) -> tuple[str, str]:
    """Return result and failed tests of a run of pytest that was not stopped."""
    failed = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", printed, re.MULTILINE)
    # 1: a test failed; 2, 3, 4: a file cannot be imported; 5: there are no tests; negative: a crash
    if code in (2, 3, 4):
        failed = failed or ["import"]
    if code < 0:
        failed = [f"crash: {signal.Signals(-code).name}"]
    return "survived" if code == 0 else "caught" if failed else "not run", " ".join(failed)


def run(
    mutant: Mutant | None, tests: Sequence[str], copy: Path, limit: float | None
) -> tuple[str, float, str]:
    """Run tests on a copy with one broken line; return result, time [s] and the test that failed.

    Without a mutant, all lines are as they were.
    """
    began = _used_by_children()
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    if mutant is not None:
        file = copy / mutant.file
        kept = file.read_text(encoding="utf-8")
        lines = kept.splitlines(keepends=True)
        lines[mutant.line - 1] = mutant.after + "\n"
        file.write_text("".join(lines), encoding="utf-8")
        environment[_WORDS_OF] = json.dumps(mutant.weights)
        if mutant.file.startswith("quad_gym/kernels/"):
            environment.update(_FAST)
    running = subprocess.Popen(
        [sys.executable, "-m", "pytest", *arguments_of(mutant, tests)],
        cwd=copy,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # with the processes that it starts, which end with it
    )
    try:
        printed, _ = running.communicate(timeout=limit)
        result, failed = outcome(running.returncode, printed)
        return result, _used_by_children() - began, failed
    except subprocess.TimeoutExpired:
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        return "stopped", _used_by_children() - began, ""
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        if mutant is not None:
            file.write_text(kept, encoding="utf-8")


def _used_by_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


class CompiledKernels:
    """A process that has compiled all kernels of a copy, and breaks lines of them."""

    def __init__(self, copy: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "scripts.mutants_of_kernels"],
            cwd=copy,
            env={**os.environ, **_FAST, "PYTHONPATH": str(copy)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        print(f"compiled all kernels in {self._answer()['cpu']:.0f} s", flush=True)

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer

    def run(
        self, mutant: Mutant | None, tests: Sequence[str], limit: float
    ) -> tuple[str, float, str] | None:
        """Run tests as the function `run` does; None: this line cannot be broken here."""
        order: dict[str, Any] = {"file": "", "line": 0, "after": None, "variables": {}}
        if mutant is not None:
            order |= {"file": mutant.file, "line": mutant.line, "after": mutant.after}
            order["variables"] = {_WORDS_OF: json.dumps(mutant.weights)}
        order |= {"arguments": arguments_of(mutant, tests), "limit": limit}
        assert self._process.stdin is not None
        print(json.dumps(order), file=self._process.stdin, flush=True)
        answer = self._answer()
        if answer["code"] is None:
            return None
        if answer["code"] == -signal.SIGXCPU:
            return "stopped", answer["cpu"], ""
        result, failed = outcome(answer["code"], answer["printed"])
        return result, answer["cpu"], failed

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def main(args: MutantsArgs) -> None:
    """Run the campaign."""
    with usage_errors():
        require_at_least(args, count=1, seed=0, nearest=1)
        for folder in args.only:
            check.choice("only", folder, FOLDERS)
        args.output.parent.mkdir(parents=True, exist_ok=True)
        known, noticed = set(), set[str]()
        if args.output.exists():
            with args.output.open(encoding="utf-8", newline="") as stream:
                for row in csv.DictReader(stream):
                    known.add(row["mutant"])
                    noticed.add(row["noticed"])
    texts = {
        str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if "clients" not in path.parts and str(path.relative_to(ROOT)) not in _LEFT_OUT | _COSTLY
    }
    todo = [
        mutant
        for mutant in chosen(args.count, args.seed)
        if mutant.name not in known and folder_of(mutant) in args.only
    ]
    with contextlib.ExitStack() as held:
        copy = Path(held.enter_context(tempfile.TemporaryDirectory()))
        stream = held.enter_context(args.output.open("a", encoding="utf-8", newline=""))
        writer = csv.writer(stream, lineterminator="\n")
        for name in _COPIED:
            source = ROOT / name
            (shutil.copytree if source.is_dir() else shutil.copy)(source, copy / name)
        if not known and stream.tell() == 0:
            writer.writerow(COLUMNS)

        def note(
            mutant: Mutant, tests: list[str], result: str, seconds: float, failed: str
        ) -> None:
            words = (mutant.before.strip(), mutant.after.strip(), result, f"{seconds:.0f}", failed)
            writer.writerow((mutant.name, mutant.file, mutant.line, *words, " ".join(tests)))
            stream.flush()
            noticed.add(failed)
            print(f"{result:9} {seconds:4.0f} s  {mutant.name}  {failed}", flush=True)

        kernels = None
        in_kernels = [mutant for mutant in todo if folder_of(mutant) == "kernels"]
        alone = {name: text for name, text in texts.items() if not _PROCESSES.search(text)}
        if in_kernels:
            kernels = CompiledKernels(copy)
            held.callback(kernels.close)
            for mutant in in_kernels:
                tests, seconds = list[str](), 0.0
                for near in (mutant, with_callers(mutant)):
                    rest = {name: text for name, text in alone.items() if name not in tests}
                    tests += (latest := nearest_tests(near, args.nearest, rest))
                    found = kernels.run(near, latest, args.limit)
                    seconds += found[1] if found else 0.0
                    if found is None or found[0] != "survived":
                        break
                if found is not None:
                    note(mutant, tests, found[0], seconds, found[2])
                    todo.remove(mutant)
        for mutant in todo:
            tests = nearest_tests(mutant, args.nearest, texts)
            note(mutant, tests, *run(mutant, tests, copy, args.limit))
        names = sorted(name for name in noticed if "::" in name)
        here = [name for name in names if kernels and name.partition("::")[0] in alone]
        failures = []
        if kernels and here:
            failures.append(kernels.run(None, here, 100.0 * args.limit))
        if others := [name for name in names if name not in here]:
            failures.append(run(None, others, copy, None))
        failed = " ".join(
            found[2] or found[0] for found in failures if found and found[0] != "survived"
        )
        if failed:
            sys.exit(f"these tests fail without a broken line, too, and notice nothing: {failed}")


if __name__ == "__main__":
    with quiet_end():
        main(parse(MutantsArgs))
