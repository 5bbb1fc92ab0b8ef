"""Pages of reports: one HTML file with tables and figures, which needs no network."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

_PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 64rem; margin: 2rem auto;
  padding: 0 1rem; }}
table {{ border-collapse: collapse; margin: 1rem 0; font-size: 14px; }}
th, td {{ padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #ddd; }}
th:first-child, td:first-child {{ text-align: left; }}
figure {{ margin: 1.5rem 0; }} img, video {{ max-width: 100%; }} figcaption {{ color: #666; }}
</style></head><body>
{body}
</body></html>
"""


def write_page(file: Path, title: str, *parts: str) -> Path:
    """Write a page of HTML elements below a title.

    Returns:
        Path of the file.
    """
    body = "\n".join([element("h1", title), *parts])
    file.write_text(_PAGE.format(title=escape(title), body=body), encoding="utf-8")
    return file


def element(tag: str, text: str) -> str:
    """Element that contains only text, such as a paragraph."""
    return f"<{tag}>{escape(text)}</{tag}>"


def bullets(sentences: Sequence[str]) -> str:
    """List of sentences."""
    return f"<ul>{''.join(element('li', sentence) for sentence in sentences)}</ul>"


def table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table of texts."""
    cells = [[element("th", text) for text in headings]]
    cells += [[element("td", text) for text in row] for row in rows]
    rows_text = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
    return f"<table>{rows_text}</table>"


def figure(file: Path, caption: str) -> str:
    """Picture or film, contained in the page, with a caption."""
    kind, data = file.suffix[1:], base64.b64encode(file.read_bytes()).decode()
    shown = f'<img alt="{escape(caption)}" src="data:image/{kind};base64,{data}">'
    if kind == "mp4":
        shown = f'<video controls loop src="data:video/mp4;base64,{data}"></video>'
    return f"<figure>{shown}{element('figcaption', caption)}</figure>"
