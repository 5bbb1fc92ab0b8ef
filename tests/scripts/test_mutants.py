"""Broken lines: valid Python, one changed line each, the same for a seed, and tests near them."""

import ast
import csv
from pathlib import Path

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
    mutant = mutants.Mutant("quad_gym/params/gnss.py", 3, "", "", ("gnss", "baseline_noise"))
    texts = {f"tests/test_{k}.py": "import quad_gym" for k in range(9)}
    texts["tests/test_near.py"] = """assert record["baseline_noise"]"""
    texts["tests/test_direct.py"] = "from quad_gym.params.gnss import GnssParams"
    assert mutants.nearest_tests(mutant, 2, texts) == ["tests/test_direct.py", "tests/test_near.py"]


def test_campaign_continues_its_table(tmp_path, monkeypatch):
    ran, table = [], tmp_path / "mutants.csv"

    def run(mutant, tests, copy, limit):
        ran.append(mutant.name)
        assert len(tests) == 2
        return "caught", 1.0

    monkeypatch.setattr(mutants, "run", run)
    monkeypatch.setattr(mutants.shutil, "copytree", lambda source, to: to.mkdir())
    for count in (2, 3):
        mutants.main(mutants.MutantsArgs(count=count, nearest=2, output=table))
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["mutant"] for row in rows] == ran == [m.name for m in mutants.chosen(3, 0)]
    assert {row["result"] for row in rows} == {"caught"}
