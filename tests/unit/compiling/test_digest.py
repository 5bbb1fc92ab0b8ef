"""Compiled code depends on every source that it reaches, and on no other."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.compiling.cache import _code, digest_of_function
from tests.builders import run_python

ROOT = Path(__file__).parents[3]
SCRIPT = """
import importlib, json, sys
from pathlib import Path
from quad_gym.kernels.compiling import cache
from quad_gym.kernels.compiling.cache import digest_of

root = Path.cwd()
modules = [name.removesuffix(".py").replace("/", ".") for name in json.loads(sys.argv[1])]
for name in modules:
    importlib.import_module(name)
found = [[digest_of(name) for name in modules]]
for name, old, new in json.loads(sys.argv[2]):
    file = root / name
    text = file.read_text()
    assert old in text, (name, old)
    file.write_text(text.replace(old, new, 1) if old else text + new)
    cache._read.cache_clear()
    found.append([digest_of(name) for name in modules])
    file.write_text(text)
print(json.dumps(found))
"""
MOVE, UPDATE, HELPER = (
    "quad_gym/kernels/vehicle/dynamics.py",
    "quad_gym/kernels/filter/update.py",
    "tests/case.py",
)
STATEMENT, COMMENT = "\n_MORE = 1\n", "\n# a comment\n"
DOCSTRING = '"""Another docstring."""'
EDITS = {
    # edit: (file, old, new, 1 or 0 if the code of MOVE, UPDATE and HELPER depends on it or not)
    "a leaf kernel": ("quad_gym/kernels/numbers/linalg.py", "", STATEMENT, (1, 1, 1)),
    "a constant": (MOVE, "h / 6.0", "h / 7.0", (1, 0, 0)),
    "a record's field": (
        "quad_gym/records/flight.py",
        'Field("r_hat", (3,)',
        'Field("r_hat", (4,)',
        (1, 1, 1),
    ),
    "an enumeration": ("quad_gym/records/enums.py", "", STATEMENT, (1, 1, 1)),
    "decorators": ("quad_gym/kernels/compiling/decorators.py", "", STATEMENT, (1, 1, 1)),
    "its own file": (MOVE, "", STATEMENT, (1, 0, 0)),
    "another room's": ("quad_gym/kernels/filter/recovery.py", "", STATEMENT, (0, 1, 0)),
    "a test's own file": (HELPER, "", STATEMENT, (0, 0, 1)),
    "a test's helper": ("tests/help.py", "", STATEMENT, (0, 0, 1)),
    "a helper by a relative name": ("tests/near.py", "", STATEMENT, (0, 0, 1)),
    "a comment": ("quad_gym/kernels/numbers/linalg.py", "", COMMENT, (0, 0, 0)),
    "a docstring": (HELPER, "What it does.", "What it did.", (0, 0, 0)),
    "environments": ("quad_gym/envs/single.py", "", STATEMENT, (0, 0, 0)),
    "parameters": ("quad_gym/params/task.py", "", STATEMENT, (0, 0, 0)),
    "the cache": ("quad_gym/kernels/compiling/cache.py", "", STATEMENT, (0, 0, 0)),
}
TESTS = {
    "__init__.py": "",
    "case.py": '"""What it does."""\n'
    "from quad_gym.kernels.numbers.linalg import cross\n"
    "from tests.help import helped\nfrom .near import nearby\n",
    "help.py": "helped = 1\n",
    "near.py": "nearby = 1\n",
    "other.py": "other = 1\n",
}


@pytest.fixture(scope="module")
def digests(tmp_path_factory):
    """Digests of the three files in a copy of the package, first unchanged, then for each edit."""
    folder = tmp_path_factory.mktemp("copy")
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "quad_gym", folder / "quad_gym", ignore=ignored)
    (folder / "tests").mkdir()
    for name, text in TESTS.items():
        (folder / "tests" / name).write_text(text)
    edits = [(file, old, new) for file, old, new, _ in EDITS.values()]
    arguments = [json.dumps([MOVE, UPDATE, HELPER]), json.dumps(edits)]
    process = run_python("-c", SCRIPT, *arguments, where=folder, PYTHONPATH=str(folder))
    assert process.returncode == 0, process.stderr
    first, *edited = json.loads(process.stdout)
    return first, dict(zip(EDITS, edited, strict=True))


@pytest.mark.parametrize("what", EDITS)
def test_edit_changes_the_digests_of_dependent_code_only(digests, what):
    first, edited = digests
    stale = tuple(int(old != new) for old, new in zip(first, edited[what], strict=True))
    assert stale == EDITS[what][-1]


def holding(held, default=1.0):
    def function(x, more=default):
        return x + held

    return function


def calling(inner):
    @kernel
    def function(x):
        return inner(x)

    return function.py_func


@kernel
def plus(x):
    return x + 1.0


@kernel
def minus(x):
    return x - 1.0


@pytest.mark.parametrize(
    "values",
    [
        (1.0, 2.0, 1, True, "1.0", None),
        (0.0, -0.0, float("nan"), np.float64(0.0), np.float32(0.0)),
        ((1, 2), (1, (2,)), (2, 1), ()),
        (plus, minus, calling(plus), calling(minus)),
    ],
    ids=["kinds", "floats", "tuples", "functions"],
)
def test_digests_of_functions_differ_with_their_closures(values):
    digests = [digest_of_function(holding(value)) for value in values]
    assert len(set(digests)) == len(values)
    assert digests == [digest_of_function(holding(value)) for value in values]


def test_functions_differ_in_their_defaults_and_in_their_code():
    functions = [holding(1.0), holding(1.0, 2.0), lambda x: x + 1.0, lambda x: x - 1.0]
    assert len({digest_of_function(function) for function in functions}) == 4


def test_code_is_the_same_without_docstrings():
    """Python leaves them out with -OO."""
    body = ('"""Text."""', "while x > 1.0:", "    x *= 0.5", "return x")
    source = "\n    ".join(("def f(x):", *body))
    found = []
    for optimize in (0, 2):
        names = {}
        exec(compile(source, "f", "exec", optimize=optimize), names)
        found.append(list(_code(names["f"].__code__)))
    assert found[0] == found[1]
    assert any("JUMP" in line for line in found[0])


def test_a_function_that_calls_itself_has_a_digest():
    def again(x):
        return again(x - 1.0) if x > 0.0 else 0.0

    assert digest_of_function(again) == digest_of_function(again)


@pytest.mark.parametrize("value", [object(), np.zeros(3), np])
def test_only_functions_numbers_and_strings_can_be_closed_over(value):
    with pytest.raises(TypeError, match="cannot be cached that closes over"):
        digest_of_function(holding(value))
