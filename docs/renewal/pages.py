"""Results on pages: text between marks, `<!-- =NAME -->` and `<!-- / -->`.

Marks may be within a sentence or around a table. A name may occur in several places.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from quad_gym.analysis.reports import markdown_table

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "docs" / "reference" / "measurements.md"
"""Page of the large tables."""
MARKED = re.compile(r"(<!-- =([\w.]+) -->)(.*?)(<!-- / -->)", re.DOTALL)


def pages() -> list[Path]:
    """README, the pages that are not generated, the page of large tables, and the paper."""
    paper = ROOT / "docs/paper/paper.md"
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), TABLES, paper]


def marked(page: Path) -> dict[str, list[str]]:
    """The texts between the marks of a page, by name."""
    found: dict[str, list[str]] = {}
    for _, name, text, _ in MARKED.findall(page.read_text(encoding="utf-8")):
        found.setdefault(name, []).append(text)
    return found


def renewed(text: str, texts: Mapping[str, str]) -> str:
    """The text of a page with new texts between its marks; other names stay as they are."""
    return MARKED.sub(lambda m: f"{m[1]}{texts.get(m[2], m[3])}{m[4]}", text)


def write(texts: Mapping[str, str]) -> list[Path]:
    """Write texts between the marks of all pages; return the pages that changed."""
    changed = []
    for page in pages():
        before = page.read_text(encoding="utf-8")
        after = renewed(before, texts)
        if after != before:
            page.write_text(after, encoding="utf-8")
            changed.append(page)
    return changed


def wrong(texts: Mapping[str, str]) -> Iterable[str]:
    """Yield a sentence for each mark that differs from the ledger, has no result, or is missing."""
    shown = {page: marked(page) for page in pages()}
    for page, marks in shown.items():
        for name, found in marks.items():
            if name not in texts:
                yield f"{page.name}: no result is named {name}"
            elif any(text != texts[name] for text in found):
                yield f"{page.name}: {name} differs from the ledger"
    for name in texts.keys() - {name for marks in shown.values() for name in marks}:
        if "\n" in texts[name]:
            yield f"no page shows the table {name}"


def console(text: str) -> str:
    """The output of a command as a block of a page."""
    return f"\n```text\n{text.strip()}\n```\n"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown, with numbers aligned to the right."""
    return f"\n{markdown_table(heads, rows)}\n"
