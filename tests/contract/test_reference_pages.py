"""The committed reference pages are those that the code makes."""

from docs.extensions import environment_pages


def test_committed_reference_pages_equal_the_code():
    texts = environment_pages.pages()
    stale = [f for f, text in texts.items() if not f.exists() or f.read_text("utf-8") != text]
    assert not stale, "make reference"
    assert set(environment_pages.FOLDER.rglob("*.md")) <= set(texts)


def test_the_guide_holds_the_table_of_the_default_observation():
    assert environment_pages.observation_table() in environment_pages.GUIDE.read_text("utf-8")
