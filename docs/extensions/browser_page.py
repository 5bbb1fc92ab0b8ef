"""The page for flights in the browser, bundled when the site is built."""

from pathlib import Path
from typing import TYPE_CHECKING

from docs.browser.build import page
from docs.browser.emission import missing_tools

if TYPE_CHECKING:
    from sphinx.application import Sphinx

_WITHOUT = (
    "<!doctype html><title>quad_gym</title><p>This site was built on a machine without {tools}, "
    "which the page needs. In a clone: <code>python -m docs.browser.build fly.html</code></p>\n"
)
"""Page of a site that is built without the tools."""


def write_page(app: "Sphinx", error: Exception | None) -> None:
    """Write `_static/fly.html` into the site, or a sentence if tools are missing."""
    if error is None and app.builder.format == "html":
        missing = missing_tools()
        text = _WITHOUT.format(tools=", ".join(missing)) if missing else page()
        Path(app.outdir, "_static", "fly.html").write_text(text, encoding="utf-8")


_LINK = '<p><strong><a href="_static/fly.html">Open the page</a></strong></p>'


def show_link(app: "Sphinx", name: str, source: list[str]) -> None:
    """Put the link into the guide, which a repository shows without it."""
    if name == "fly":
        source[0] = source[0].replace("<!-- link -->", _LINK)


def setup(app: "Sphinx") -> dict[str, bool]:
    """Register the extension."""
    app.connect("build-finished", write_page)
    app.connect("source-read", show_link)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
