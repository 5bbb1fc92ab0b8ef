"""Pages and docstrings use the field's words; the number of others only falls."""

from pathlib import Path

from tests import dialect

ROOT = Path(__file__).parents[2]


def test_no_text_exceeds_its_ceiling():
    assert dialect.too_many(dialect.counts()) == []


def test_contributing_has_the_table_of_words():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert page.split("<!-- words -->")[1].split("<!-- /words -->")[0].strip() == dialect.table()
