"""Break lines on purpose, one at a time, and see whether the tests nearest to them notice.

    python -m scripts.mutants --count 150 --seed 0 --output results/mutants.csv

A seed chooses the lines, in kernels, packing, parameters, estimation and tasks, and how each is
broken: an operator, a comparison, a number, a branch. A copy of the checkout has one broken line,
and runs the test files that are nearest to it: those that import its module, or have the rarest
words of its module, function and line. Golden flights, which notice any change of a flight, are
left out. The table has one row for each mutant. A run that is interrupted continues where it
stopped: mutants in the table are not run again.
"""

import ast
import csv
import math
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from quad_gym.commands.options import parse, require_at_least, usage_errors

ROOT = Path(__file__).parents[1]
FOLDERS = ("kernels", "packing", "params", "estimation", "tasks")
"""Folders of the package in which lines are broken."""
COLUMNS = ("mutant", "file", "line", "before", "after", "result", "seconds", "tests")
_COPIED = ("quad_gym", "baselines", "scripts", "docs", "tests", "pyproject.toml", "README.md")
_LEFT_OUT = {"tests/contract/test_golden.py"}
_WORD = re.compile(r"[A-Za-z_]{3,}")
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
    words: tuple[str, ...]  #: of the module, the function and the line

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
    nearest: int = 6
    """number of test files that run for each"""
    limit: float = 900.0
    """time after which the tests of a mutant are stopped [s]; it then counts as noticed"""
    output: Path = Path("results/mutants.csv")
    """table, which is continued"""


def mutants_of(path: Path) -> list[Mutant]:
    """Return all ways of breaking lines of a file of the checkout."""
    text = (ROOT / path).read_text(encoding="utf-8")
    lines, found = text.splitlines(), list[Mutant]()
    for function, node in _nodes(ast.parse(text), ""):
        for line, begin, end, new in _edits(node, lines):
            before = lines[line - 1]
            after = before[:begin] + new + before[end:]
            words = _WORD.findall(f"{path.stem} {function} {before}")
            found.append(Mutant(str(path), line, before, after, tuple(dict.fromkeys(words))))
    return found


def _nodes(tree: ast.AST, function: str) -> Iterator[tuple[str, ast.AST]]:
    """Yield the nodes of a tree with the names of their functions; no annotations and texts."""
    for name, value in ast.iter_fields(tree):
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or name in ("annotation", "returns"):
                continue
            inner = child.name if isinstance(child, ast.FunctionDef) else function
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
        for path in (ROOT / "quad_gym" / folder).rglob("*.py")
    )
    every = [mutant for path in paths for mutant in mutants_of(path)]
    random.Random(seed).shuffle(every)
    by_line: dict[tuple[str, int], Mutant] = {}
    for mutant in every:
        by_line.setdefault((mutant.file, mutant.line), mutant)
    return list(by_line.values())[:count]


def nearest_tests(mutant: Mutant, count: int, texts: dict[str, str]) -> list[str]:
    """Return the test files nearest to a mutant, the nearest first.

    Importing its module counts as four words of which only one test file has each.
    """
    module = mutant.file.removesuffix(".py").replace("/", ".")
    words = {name: set(_WORD.findall(text)) for name, text in texts.items()}
    files = Counter(word for found in words.values() for word in found)
    rare = {word: math.log(len(texts) / files[word]) for word in mutant.words if files[word]}

    def nearness(name: str) -> float:
        direct = re.search(rf"\b{re.escape(module)}\b", texts[name]) is not None
        shared = sum(weight for word, weight in rare.items() if word in words[name])
        return shared + 4.0 * math.log(len(texts)) * direct

    return sorted(texts, key=lambda name: (-nearness(name), name))[:count]


def run(mutant: Mutant, tests: Sequence[str], copy: Path, limit: float) -> tuple[str, float]:
    """Run tests on a copy with one broken line; return the result and the time [s]."""
    file, began = copy / mutant.file, time.monotonic()
    kept = file.read_text(encoding="utf-8")
    lines = kept.splitlines(keepends=True)
    lines[mutant.line - 1] = mutant.after + "\n"
    file.write_text("".join(lines), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", *tests]
    try:
        done = subprocess.run(
            command,
            cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            timeout=limit,
            check=False,
        )
        result = {0: "survived", 1: "caught"}.get(done.returncode, "not run")
        if done.returncode in (2, 4):  # a file cannot be imported
            result = "caught"
    except subprocess.TimeoutExpired:
        result = "too slow"
    finally:
        file.write_text(kept, encoding="utf-8")
    return result, time.monotonic() - began


def main(args: MutantsArgs) -> None:
    """Run the campaign."""
    with usage_errors():
        require_at_least(args, count=1, seed=0, nearest=1)
        args.output.parent.mkdir(parents=True, exist_ok=True)
        known = set()
        if args.output.exists():
            with args.output.open(encoding="utf-8", newline="") as stream:
                known = {row["mutant"] for row in csv.DictReader(stream)}
    texts = {
        str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        if "clients" not in path.parts and str(path.relative_to(ROOT)) not in _LEFT_OUT
    }
    with tempfile.TemporaryDirectory() as folder, args.output.open("a", newline="") as stream:
        copy, writer = Path(folder), csv.writer(stream, lineterminator="\n")
        for name in _COPIED:
            source = ROOT / name
            (shutil.copytree if source.is_dir() else shutil.copy)(source, copy / name)
        if not known and stream.tell() == 0:
            writer.writerow(COLUMNS)
        for mutant in chosen(args.count, args.seed):
            if mutant.name in known:
                continue
            tests = nearest_tests(mutant, args.nearest, texts)
            result, seconds = run(mutant, tests, copy, args.limit)
            words = (mutant.before.strip(), mutant.after.strip(), result, f"{seconds:.0f}")
            writer.writerow((mutant.name, mutant.file, mutant.line, *words, " ".join(tests)))
            stream.flush()
            print(f"{result:9} {seconds:4.0f} s  {mutant.name}", flush=True)


if __name__ == "__main__":
    main(parse(MutantsArgs))
