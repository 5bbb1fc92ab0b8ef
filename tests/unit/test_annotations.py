"""Annotations have the same meaning when Python evaluates them late, as Python 3.14 does (PEP 649).

They are then evaluated among the names of the finished class, where a method or a default value may
have the name of a module or a type that an annotation refers to.
"""

import ast
import builtins
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = [file for folder in ("quad_gym", "baselines") for file in (ROOT / folder).rglob("*.py")]


def bound_in(body):
    """Return the names that statements bind; a field without a default binds none."""
    names = set()
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            names |= {(name.asname or name.name).partition(".")[0] for name in node.names}
        elif isinstance(node, ast.Assign) or (isinstance(node, ast.AnnAssign) and node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}
    return names


def annotations_in(body):
    """Yield the annotations of fields, parameters and results in the body of a class."""
    for node in body:
        if isinstance(node, ast.AnnAssign):
            yield node.annotation
        elif isinstance(node, ast.FunctionDef):
            arguments = [n for n in ast.walk(node.args) if isinstance(n, ast.arg)]
            yield from filter(None, [node.returns, *(a.annotation for a in arguments)])


def shadowed(source):
    """Return annotations with names that the finished class binds to something else."""
    body = ast.parse(source).body
    outside = bound_in(body) | set(dir(builtins))
    found = []
    for kind in [node for node in body if isinstance(node, ast.ClassDef)]:
        inside = bound_in(kind.body) & outside
        for annotation in annotations_in(kind.body):
            if inside & {n.id for n in ast.walk(annotation) if isinstance(n, ast.Name)}:
                found.append(f"{kind.name}: {ast.unparse(annotation)}")
    return found


def test_annotation_is_found_where_late_evaluation_gives_another_type():
    source = "class A:\n    x: list[int]\n    y: dict[str, int] = {}\n    def list(self): ...\n"
    names = {}
    exec(source, names)
    with pytest.raises(TypeError, match="not subscriptable"):  # as Python 3.14 evaluates it
        eval("list[int]", names, vars(names["A"]))
    assert shadowed(source) == ["A: list[int]"]


def test_late_evaluation_of_annotations_finds_no_other_names():
    assert len(FILES) > 200
    found = {str(f.relative_to(ROOT)): shadowed(f.read_text(encoding="utf-8")) for f in FILES}
    assert not {file: names for file, names in found.items() if names}
