"""Committed pages match the code, the ledger of results and the table of words."""

import json
import re
from pathlib import Path

import pytest

from docs.extensions import environment_pages
from docs.renewal import ledger, pages
from docs.renewal.catalog import Result
from tests import dialect


@pytest.fixture(scope="module")
def entries():
    return ledger.read()


def test_pages_hold_the_texts_of_the_ledger(entries):
    assert list(pages.wrong(ledger.texts(entries))) == []


def test_no_line_of_a_page_begins_with_a_result():
    """Markdown takes a line that begins with a comment as HTML, with links as they are typed."""
    files = [
        ROOT / "README.md",
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "docs/reference").glob("*.md"),
    ]
    found = [
        f"{file.name}: {line}"
        for file in files
        for line in file.read_text(encoding="utf-8").splitlines()
        if re.match(r"\s*<!-- =\S+ -->.*\S", line)
    ]
    assert not found


def test_result_of_changed_flights_or_options_is_stale(tmp_path, monkeypatch):
    result = Result(name="one", commands=["circle"], flights=("C*",), texts=lambda *_: {})
    golden = tmp_path / "flights.json"
    monkeypatch.setattr(ledger, "GOLDEN", golden)
    golden.write_text(json.dumps({"Circle": "a", "Hover": "b"}))
    entries = {"one": {"commands": ["circle"], "flights": ledger.digest(result)}}
    assert not ledger.stale(result, entries)
    golden.write_text(json.dumps({"Circle": "a", "Hover": "c"}))
    assert not ledger.stale(result, entries)
    golden.write_text(json.dumps({"Circle": "c", "Hover": "b"}))
    assert ledger.stale(result, entries)
    entries["one"] = {"commands": ["circle --seeds 2"], "flights": ledger.digest(result)}
    assert ledger.stale(result, entries)


def test_committed_reference_pages_equal_the_code():
    texts = environment_pages.pages()
    stale = [f for f, text in texts.items() if not f.exists() or f.read_text("utf-8") != text]
    assert not stale, "make reference"
    assert set(environment_pages.FOLDER.rglob("*.md")) <= {*texts, pages.TABLES}


def test_the_guide_holds_the_table_of_the_default_observation():
    assert environment_pages.observation_table() in environment_pages.GUIDE.read_text("utf-8")


ROOT = Path(__file__).parents[2]


def test_a_sentence_without_a_verb_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(dialect, "ROOT", tmp_path)
    page = tmp_path / "README.md"
    page.write_text(
        "# Title\n\nOne line with no end; and another; and more;\n\nIt takes a minute.\n"
    )
    semicolons, verb = dialect.syntax()
    assert semicolons == "README.md has 3 semicolons in 12 words"
    assert verb.endswith("without a verb: One line with no end; and another; and more;")


def test_contributing_has_the_table_of_words():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = page.split("<!-- words -->")[1].split("<!-- /words -->")[0].strip().split("\n")[2:]
    assert [row.split("|")[1].strip() for row in rows] == list(dialect.WORDS)
