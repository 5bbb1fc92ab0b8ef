"""Reports: files of numbers and figures, and one HTML page that shows them without a network."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from quad_gym.analysis.plots import save_figure

_PAGE = Path(__file__).with_name("page.html")


class Report:
    """Report in a folder, with a title: its page grows by one element with each call."""

    def __init__(self, folder: Path, title: str) -> None:
        self.folder, self._title = folder, title
        self.files: list[Path] = []
        """Files of the report"""
        self._parts: list[str] = []
        self.add("h1", title)

    def add(self, tag: str, text: str) -> None:
        """Add an element that contains only text, such as a paragraph."""
        self._parts.append(_element(tag, text))

    def add_bullets(self, sentences: Sequence[str]) -> None:
        """Add a list of sentences."""
        items = "".join(_element("li", sentence) for sentence in sentences)
        self._parts.append(f"<ul>{items}</ul>")

    def add_table(self, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table of texts."""
        cells = [[_element("th", text) for text in headings]]
        cells += [[_element("td", text) for text in row] for row in rows]
        rows_text = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
        self._parts.append(f"<table>{rows_text}</table>")

    def add_figure(self, name: str, figure: Any, caption: str) -> None:
        """Save a matplotlib figure under a name, and add it."""
        picture, *others = save_figure(figure, self.folder / name)
        self.add_picture(picture, caption)
        self.files += others

    def add_picture(self, file: Path, caption: str) -> None:
        """Add a picture or film of the folder, contained in the page, with a caption."""
        self.files.append(file)
        kind, data = file.suffix[1:], base64.b64encode(file.read_bytes()).decode()
        shown = f'<img alt="{escape(caption)}" src="data:image/{kind};base64,{data}">'
        if kind == "mp4":
            shown = f'<video controls loop src="data:video/mp4;base64,{data}"></video>'
        self._parts.append(f"<figure>{shown}{_element('figcaption', caption)}</figure>")

    def write(self) -> list[Path]:
        """Write the page, report.html; return all files, the page last."""
        page = self.folder / "report.html"
        template = Template(_PAGE.read_text(encoding="utf-8"))
        text = template.substitute(title=escape(self._title), body="\n".join(self._parts))
        page.write_text(text, encoding="utf-8")
        return [*self.files, page]


def _element(tag: str, text: str) -> str:
    return f"<{tag}>{escape(text)}</{tag}>"
