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
