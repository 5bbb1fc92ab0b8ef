"""README and pages hold the texts of the ledger, and changed flights make results stale."""

import json

import pytest

from docs.renewal import ledger, pages
from docs.renewal.catalog import Result


@pytest.fixture(scope="module")
def entries():
    return ledger.read()


def test_pages_hold_the_texts_of_the_ledger(entries):
    assert list(pages.wrong(ledger.texts(entries))) == []


def test_changed_golden_flights_and_changed_options_make_a_result_stale(tmp_path, monkeypatch):
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


def test_texts_replace_those_between_their_marks_and_no_others():
    page = "a <!-- =one -->1 %<!-- / --> b\n<!-- =two -->\n| old |\n<!-- / -->\n"
    assert pages.renewed(page, {"two": "\n| new |\n"}) == page.replace("old", "new")
    assert pages.renewed(page, {}) == page
