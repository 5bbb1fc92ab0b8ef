"""Tests of the documentation: programs run, commands parse, and named files and functions exist.

The Python blocks of a page run in order, in one namespace. A hidden comment on the line above a
block changes how the block runs:

    <!-- test: skip, REASON -->           it does not run
    <!-- test: replace OLD by NEW -->     it runs with another text, such as fewer training steps
    <!-- test: slow, REASON -->           its whole page runs only with the slow tests
    <!-- test: needs MODULE -->           it runs only if the module can be imported
"""

import importlib
import re
import shlex
from pathlib import Path

import gymnasium
import pytest

import quad_gym
from quad_gym.commands.main import COMMANDS, module_of, options_of
from quad_gym.commands.options import parse

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
COMMAND_MODULES = sorted((ROOT / "quad_gym" / "commands").rglob("*.py"))

BLOCK = re.compile(
    r"(?P<notes>(?:^[ ]*<!-- test: [^\n]* -->\n)*)^(?P<indent>[ ]*)```(?P<language>\w+)\n"
    r"(?P<text>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
NOTE = re.compile(r"<!-- test: (skip|slow|replace|needs)(?:, | )(.+?) -->")
REPLACEMENT = re.compile(r"(.+) by (.+)")


def blocks(page, *languages):
    """Yield (line, text, notes) of the blocks of a page in some languages."""
    text = page.read_text(encoding="utf-8")
    for found in BLOCK.finditer(text):
        if found["language"] in languages:
            line = text.count("\n", 0, found.start("text")) + 1
            yield line, found["text"], NOTE.findall(found["notes"])


def programs():
    """Yield the pages with Python blocks."""
    for page in PAGES:
        notes = [kind for _, _, found in blocks(page, "python") for kind, _ in found]
        marks = [pytest.mark.slow] if "slow" in notes else []
        if any(True for _ in blocks(page, "python")):
            yield pytest.param(page, marks=marks, id=page.name)


def importable(module):
    try:
        importlib.import_module(module)
    except ImportError:
        return False
    return True


def as_run(line, text, notes):
    """Return a block's text after its notes, at its line of the page, or None to skip it."""
    for kind, what in notes:
        if kind == "skip" or (kind == "needs" and not importable(what)):
            return None
        if kind == "replace":
            old, new = REPLACEMENT.fullmatch(what).groups()
            assert old in text, f"line {line} has no {old} to replace"
            text = text.replace(old, new)
    return "\n" * (line - 1) + text


@pytest.mark.parametrize("page", list(programs()))
def test_programs_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # windows without a screen
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    namespace = {"__name__": "__documentation__"}
    for line, text, notes in blocks(page, "python"):
        program = as_run(line, text, notes)
        if program is not None:
            exec(compile(program, str(page), "exec"), namespace)


def test_every_test_comment_is_valid():
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        used = [note for *_, notes in blocks(page, "python") for note in notes]
        assert text.count("<!-- test:") == len(used), page
        for kind, what in used:
            assert kind != "replace" or REPLACEMENT.fullmatch(what), what


def commands_of(text):
    """Yield command lines `quad-gym ...`, without explanations after three spaces in docstrings."""
    text = text.replace("\\\n", " ")
    for found in re.finditer(r"^\s*(?:[$@] ?)?(?:\$\(BIN\)/)?quad-gym +(.*)$", text, re.MULTILINE):
        yield re.split(r" {3,}", found[1])[0]


def command_lines():
    """Yield (file, command line) of pages, commands, gallery and Makefile."""
    for page in PAGES:
        for _, text, _ in blocks(page, "sh", "console"):
            yield from ((page, words) for words in commands_of(text))
        prose = BLOCK.sub("", page.read_text(encoding="utf-8"))
        yield from ((page, " ".join(w.split())) for w in re.findall(r"`quad-gym ([^`]+)`", prose))
    for file in (*COMMAND_MODULES, *sorted((ROOT / "docs" / "gallery").glob("*.py"))):
        text = file.read_text(encoding="utf-8").replace("\n#", "\n ")
        yield from ((file, words) for words in commands_of(text))
    makefile = ROOT / "Makefile"
    yield from ((makefile, w) for w in commands_of(makefile.read_text(encoding="utf-8")))


LINES = sorted({(file.relative_to(ROOT).as_posix(), words) for file, words in command_lines()})


def test_command_lines_are_found():
    found = {file for file, _ in LINES}
    assert {"docs/start.md", "Makefile", "docs/training.md", "quad_gym/commands/fly.py"} <= found


def exit_code(module, options):
    """Return the exit code after parsing the options of a command; --help gives 0."""
    try:
        parse(options_of(module_of(module)), options)
    except SystemExit as end:
        return end.code
    return 0


@pytest.mark.parametrize(("file", "words"), LINES)
def test_command_lines_parse(file, words, monkeypatch):
    monkeypatch.chdir(ROOT)  # paths of arms files are relative to it
    command, *options = shlex.split(words, comments=True)
    if command not in COMMANDS:  # its name has two words
        command = f"{command} {options.pop(0)}"
    assert command in COMMANDS
    assert exit_code(command, options) == 0, f"{file}: quad-gym {words}"


def test_files_named_on_pages_exist():
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            continue
        for path in re.findall(
            r"`((?:quad_gym|baselines|tests|scripts)/[\w/.]*)`", page.read_text()
        ):
            assert (ROOT / path).exists(), f"{page.name} names {path}"


LINK = re.compile(r"(?<!\\)\]\(([^)\s]+)\)")
REFERENCE = sorted((ROOT / "docs" / "reference").rglob("*.md"))


def anchors(page):
    """Return anchors of a page's headings, as repositories' web pages and MyST generate them."""
    text = re.sub(
        r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    )
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CHANGELOG.md", *REFERENCE], ids=lambda page: page.stem
)
def test_links_lead_to_files_and_headings_of_the_repository(page):
    for target in LINK.findall(BLOCK.sub("", page.read_text(encoding="utf-8"))):
        if target.startswith(("http", "tutorials/", "../../actions/", "../../issues")):
            continue  # only the site has tutorials; others are pages of the repository's host
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(file), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_no_line_begins_with_a_mark_and_goes_on(page):
    """Such a line is a block of HTML, in which Markdown is shown as it is written."""
    assert not re.findall(
        r"^ {0,3}<!--.*-->.*\S.*$", page.read_text(encoding="utf-8"), re.MULTILINE
    )


def test_functions_named_on_equation_pages_exist():
    pages = ("filter-equations", "filter-measurements", "filter-heading", "sensors-and-filter")
    text = " ".join((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8") for page in pages)
    text = " ".join(text.split())
    found = re.findall(r"((?:`\w+`(?:, | and )?)+) in `(quad_gym/[\w/]+\.py)`", text)
    assert len(found) > 15
    for names, path in found:
        source = (ROOT / path).read_text(encoding="utf-8")
        for name in re.findall(r"`(\w+)`", names):
            assert f"def {name}(" in source, f"{path} has no {name}"


def names_on_api_pages():
    """Return names on the API pages, with all members of documented modules, and the modules."""
    text = "\n".join(p.read_text(encoding="utf-8") for p in (ROOT / "docs" / "api").glob("*.md"))
    modules = set(re.findall(r"automodule:: ([\w.]+)", text))
    objects = set(re.findall(r"auto(?:class|function|data):: ([\w.]+)", text))
    return {name.rpartition(".")[2] for name in objects | modules} | {
        name
        for module in map(importlib.import_module, modules)
        for name, value in vars(module).items()
        if getattr(value, "__module__", None) == module.__name__
        or name in getattr(module, "__all__", ())
    }, modules


def test_class_names_are_used_once():
    found = {}
    for file in (*ROOT.glob("quad_gym/**/*.py"), *ROOT.glob("baselines/**/*.py")):
        for name in re.findall(r"^class (\w+)", file.read_text(encoding="utf-8"), re.MULTILINE):
            found.setdefault(name, []).append(file.relative_to(ROOT).as_posix())
    assert len(found) > 200
    assert [files for files in found.values() if len(files) > 1] == []


def test_every_public_name_is_on_api_pages():
    names, modules = names_on_api_pages()
    public = {*quad_gym.__all__, *quad_gym._LAZY} - {"__version__", "faults", "rewards"}
    assert public <= names, sorted(public - names)
    assert "PDPolicy" in names
    files = {m.stem for m in (ROOT / "quad_gym" / "analysis").glob("*.py")} - {"__init__"}
    wanted = {f"analysis.{name}" for name in files} | {"estimation", "evaluation", "faults"}
    wanted |= {"frames", "rendering", "rotations", "sensors", "tasks.rewards", "vehicle"}
    missing = {f"quad_gym.{name}" for name in wanted} - modules
    assert not missing, sorted(missing)


@pytest.mark.parametrize("env_id", sorted({*quad_gym.IDS} - {"QuadGym/Trajectory-v0"}))
def test_table_of_environments_has_the_time_limit_of_each(env_id):
    task = gymnasium.make(env_id).unwrapped.flights.task
    tables = (quad_gym.QuadEnv.__doc__, (ROOT / "docs/environments.md").read_text())
    for table in tables:
        row = re.search(rf"^ *\| `{env_id}` \|.*\|(.*)\|$", table, re.MULTILINE)
        assert float(re.findall(r"(\d+) s", row[1])[-1]) == task.duration


def test_files_to_read_first_have_about_1500_lines():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text.partition("## Ten files to read")[2].partition("## ")[0]
    files = re.findall(r"^\| `(quad_gym/[\w/]+\.py)` \|", table, re.MULTILINE)
    assert len(files) == 10
    assert sum(len((ROOT / file).read_text(encoding="utf-8").splitlines()) for file in files) < 1550
