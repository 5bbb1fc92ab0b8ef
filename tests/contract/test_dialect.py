"""Pages and docstrings use the field's words; the number of others only falls."""

from pathlib import Path

import pytest

from tests import dialect

ROOT = Path(__file__).parents[2]


def test_no_text_exceeds_its_ceiling():
    assert dialect.too_many(dialect.counts()) == []


def test_contributing_has_the_table_of_words():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert page.split("<!-- words -->")[1].split("<!-- /words -->")[0].strip() == dialect.table()


@pytest.mark.parametrize(
    "text",
    [
        "A filter that is told its noise is surely right.",
        "What a log has and the suite has not.",
        "It takes the noise for drift, with a deviation of 2 m.",
        "The arm is paid\nfor being sure.",
    ],
)
def test_dialect_is_found(text):
    assert dialect.count(text).found


@pytest.mark.parametrize(
    "text",
    [
        "What is the observation? What to do next. Make sure that it is set.",
        "`told` and $what$ and [link](what.md)\n\n```sh\necho what\n```\n",
        "The standard\ndeviation, and the deviation from the reference.",
        "| 0.25 | doubt | 12.5 [11.3, 14.8] |",
        "It takes 14 s for the first reset.",
    ],
)
def test_standard_words_code_and_tables_of_numbers_are_not_found(text):
    assert not dialect.count(text).found


def test_openings_of_docstrings_are_found():
    assert dialect.count_docstring("Whether it is late.", 1).found
    assert not dialect.count_docstring("True if it is late.", 1).found


def test_docstrings_of_attributes_are_read(tmp_path):
    file = tmp_path / "module.py"
    file.write_text('"""M."""\n\n\nclass A:\n    """C."""\n\n    x: int = 1\n    """F."""\n')
    assert [name for name, *_ in dialect.docstrings(file)] == ["", "A", "A.x"]
