"""Broken lines: valid Python, one changed line each, the same for a seed, and tests near them."""

import ast
import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from scripts import mutants


def test_seed_chooses_lines_that_can_be_compiled_and_are_broken():
    found = mutants.chosen(60, 3)
    assert found == mutants.chosen(60, 3)
    assert found != mutants.chosen(60, 4)
    assert len({(mutant.file, mutant.line) for mutant in found}) == 60
    for mutant in found:
        lines = (mutants.ROOT / mutant.file).read_text(encoding="utf-8").splitlines()
        assert lines[mutant.line - 1] == mutant.before != mutant.after
        before = ast.dump(ast.parse("\n".join(lines)))
        lines[mutant.line - 1] = mutant.after
        assert ast.dump(ast.parse("\n".join(lines))) != before


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("def f(a):\n    return a + 2", {"    return a - 2", "    return a + 3"}),
        ("def f(a):\n    return not a <= b", {"    return not a > b"}),
        ("x = select(a, b.c, 1.0)", {"x = select(a, 1.0, b.c)", "x = select(a, b.c, 1.75)"}),
        ("x: Annotated[int, 3] = True", {"x: Annotated[int, 3] = False"}),
        ("raise ValueError(f'{a + b}')", set()),
    ],
)
def test_lines_are_broken_in_all_ways(text, expected, tmp_path, monkeypatch):
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    (tmp_path / "part.py").write_text(text)
    assert {mutant.after for mutant in mutants.mutants_of(Path("part.py"))} == expected


def test_nearest_tests_import_the_module_or_share_its_rare_words():
    weights = (("gnss", 3.0), ("baseline", 1.0), ("noise", 1.0))
    mutant = mutants.Mutant("quad_gym/params/gnss.py", 3, "", "", weights)
    texts = {f"tests/test_{k}.py": "import quad_gym" for k in range(9)}
    texts["tests/test_near.py"] = """assert record["baseline_noise"]"""
    texts["tests/test_direct.py"] = "from quad_gym.params.gnss import GnssParams"
    assert mutants.nearest_tests(mutant, 2, texts) == ["tests/test_direct.py", "tests/test_near.py"]


def test_tests_that_name_the_function_are_nearer():
    mutant = mutants.Mutant("quad_gym/kernels/image.py", 3, "", "", (("image", 3.0),), "reset_fix")
    texts = {f"tests/test_{k}.py": "import quad_gym" for k in range(9)}
    texts["tests/test_near.py"] = "image"
    texts["tests/test_direct.py"] = "reset_fix(flight)"
    assert mutants.nearest_tests(mutant, 2, texts) == ["tests/test_direct.py", "tests/test_near.py"]


def test_many_parameters_of_one_test_leave_room_for_those_of_other_files(monkeypatch):
    def first():
        return "gnss baseline"

    def second():
        return "gnss"

    def third():
        return "image"

    def fourth():
        return "other"

    items = [SimpleNamespace(function=first, path="a", number=k) for k in range(50)]
    items += [SimpleNamespace(function=second, path="a", number=k) for k in range(50)]
    items += [SimpleNamespace(function=f, path="b", number=0) for f in (third, fourth)]
    weights = [("gnss", 1.0), ("baseline", 2.0), ("image", 0.01)]
    monkeypatch.setenv(mutants._WORDS_OF, json.dumps(weights))
    monkeypatch.setattr(mutants, "_FIRST", 2)
    monkeypatch.setattr(mutants, "_MOST", 7)
    mutants.pytest_collection_modifyitems(items)
    chosen = [(item.function.__name__, item.number) for item in items]
    assert chosen == [
        ("first", 0), ("first", 1),  # the nearest, then others by file
        ("first", 2), ("second", 0), ("second", 1), ("third", 0), ("fourth", 0),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("code", "printed", "expected"),
    [
        (0, "3 passed", ("survived", "")),
        (1, "FAILED test_a.py::test_it[x y] - assert", ("caught", "test_a.py::test_it[x y]")),
        (2, "no module", ("caught", "import")),
        (5, "no tests ran", ("not run", "")),
        (-11, "Fatal Python error", ("caught", "crash: SIGSEGV")),
    ],
)
def test_codes_and_reports_of_pytest_give_results(code, printed, expected):
    assert mutants.outcome(code, printed) == expected


BREAKING = """
import numpy as np
from scripts import mutants, mutants_of_kernels as broken
from quad_gym.estimation import solve_wahba
from quad_gym.kernels.filter.starts import wahba

wahba_of_vectors, integrate_flight = entries = [
    broken.dispatcher_of(f"quad_gym.kernels.single:{name}")
    for name in ("wahba_of_vectors", "integrate_flight")
]
broken.keep_in_memory()
kernels = broken.Kernels([f"quad_gym.kernels.single:{e.__name__}" for e in entries])
turn = np.linalg.qr(np.arange(9.0).reshape(3, 3) ** 2 + np.eye(3))[0]
turn *= np.linalg.det(turn)
vectors = np.random.default_rng(1).normal(size=(5, 3))
solve = lambda: solve_wahba(np.ones(5), vectors, vectors @ turn.T)
np.testing.assert_allclose(solve(), turn, atol=1e-13)
known = list(wahba.overloads.values())
file = mutants.ROOT / "quad_gym/kernels/filter/starts.py"
text = file.read_text()
change = lambda before, after: kernels.change(file, text, text.replace(before, after))
change("select(zeta < 0.0, -1.0, 1.0) /", "select(zeta < 0.0, -1.0, 1.0) *")
assert not wahba_of_vectors.overloads and integrate_flight.overloads
assert known == list(wahba.overloads.values())  # its caller is not translated again
assert not np.allclose(solve(), turn, atol=1e-3)
try:
    change("_SWEEPS = 10", "_SWEEPS = 11")
except broken.Unsuitable as reason:
    print(reason)
"""


@pytest.mark.slow  # compiles two entries in a process of its own
def test_a_broken_kernel_changes_the_entries_that_reach_it_and_compiles_no_others():
    run = [sys.executable, "-c", BREAKING]
    found = subprocess.run(run, cwd=mutants.ROOT, check=True, capture_output=True, text=True)
    assert found.stdout == "not in a function\n"


def test_weights_of_words_fall_from_module_to_line(tmp_path, monkeypatch):
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    (tmp_path / "clocks.py").write_text(
        '"""Rates."""\ndef seconds_of(ticks):\n    """Duration."""\n    return ticks + period\n'
    )
    (mutant,) = mutants.mutants_of(Path("clocks.py"))
    assert dict(mutant.weights) == {
        **{"clock": 3.0, "rate": 0.5, "second": 2.0, "duration": 1.0},
        **{"return": 1.0, "tick": 1.0, "period": 1.0},
    }


def test_words_of_callers_count_less_with_each_call(tmp_path, monkeypatch):
    folder = tmp_path / "quad_gym/kernels"
    folder.mkdir(parents=True)
    (folder / "sums.py").write_text(
        "def inner(a):\n    return a + 1\n\n"
        'def middle(b):\n    """Rate."""\n    return inner(b)\n\n'
        "def outer(c):\n    return middle(c)\n\ndef other(d):\n    return d\n"
    )
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    mutants._kernels.cache_clear()
    mutant = mutants.Mutant("quad_gym/kernels/sums.py", 2, "", "", (), "inner")
    weights = dict(mutants.with_callers(mutant).weights)
    uncalled = mutants.Mutant("quad_gym/kernels/sums.py", 8, "", "", (("other", 2.0),), "other")
    assert mutants.with_callers(uncalled) == uncalled
    mutants._kernels.cache_clear()
    assert weights == {"sum": 1.5, "middle": 1.0, "rate": 0.5, "outer": 0.5}


@pytest.mark.slow  # three runs of pytest
def test_tests_that_fail_catch_a_mutant_and_stopped_ones_leave_it_open(tmp_path):
    (tmp_path / "scripts").mkdir()
    shutil.copy(mutants.__file__, tmp_path / "scripts" / "mutants.py")
    (tmp_path / "part.py").write_text("a = 1 + 2\nb = 3\n")
    (tmp_path / "test_part.py").write_text(
        "import part\n\ndef test_b():\n    assert part.b\n\ndef test_a():\n    assert part.a == 3\n"
    )
    tests = ["test_part.py"]
    for line, before, after, limit, expected in (
        (1, "a = 1 + 2", "a = 1 - 2", 60.0, ("caught", "test_part.py::test_a")),
        (2, "b = 3", "b = 4", 60.0, ("survived", "")),
        (1, "a = 1 + 2", "a = 1 - 2", 0.01, ("stopped", "")),
    ):
        mutant = mutants.Mutant("part.py", line, before, after, (("part", 1.0),))
        result, seconds, failed = mutants.run(mutant, tests, tmp_path, limit)
        assert (result, failed) == expected
        assert 0.0 < seconds < 60.0
        assert (tmp_path / "part.py").read_text() == "a = 1 + 2\nb = 3\n"
    assert mutants.run(None, tests, tmp_path, None)[0] == "survived"


def test_campaign_continues_its_table(tmp_path, monkeypatch):
    ran, table = [], tmp_path / "mutants.csv"

    passed = "survived", 1.0, ""

    def run(mutant, tests, copy, limit):
        if mutant is None:  # at the end, without broken lines
            assert tests == ["tests/test_it.py::test_it"]
            return passed
        ran.append(mutant.name)
        assert len(tests) == 2
        return "caught", 1.0, "tests/test_it.py::test_it"

    class CompiledKernels:
        def __init__(self, copy):
            pass

        def run(self, mutant, tests, limit):
            return run(mutant, tests, "", limit) if mutant.line % 4 else None

        def close(self):
            pass

    monkeypatch.setattr(mutants, "run", run)
    monkeypatch.setattr(mutants, "CompiledKernels", CompiledKernels)
    monkeypatch.setattr(mutants.shutil, "copytree", lambda source, to: to.mkdir())
    for count in (2, 3):
        mutants.main(mutants.MutantsArgs(count=count, nearest=2, output=table))
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["mutant"] for row in rows] == ran
    assert sorted(ran) == sorted(mutant.name for mutant in mutants.chosen(3, 0))
    assert {row["result"] for row in rows} == {"caught"}
    passed = "caught", 1.0, "tests/test_it.py::test_it"
    with pytest.raises(SystemExit, match=r"fail without a broken line, too.*test_it"):
        mutants.main(mutants.MutantsArgs(count=3, nearest=2, output=table))
