"""Equations as pictures within the page: no script, no network, no installation of LaTeX.

Ziamath draws LaTeX as SVG, in the color of the text around it. Widths are in `em`: equations
grow with the text.
"""

import re
from typing import Any
from xml.etree import ElementTree

import ziamath
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging
from ziamath.tex import tex2mml

LOGGER = logging.getLogger(__name__)
SIZE, SCALE = 18.0, 1.08
"""Size at which equations are drawn [pixels], and their scale relative to the text."""

ROW_SPACE, COLUMN_SPACE = "0.5em", "1em"
"""Space between rows of tables, and between columns of matrices."""

NUMBER = re.compile(r"\\tag\{(\d+)\}\s*$")
"""The number of an equation, at its end; repositories' web pages show it, too."""


_SIGN = re.compile(r"(^|[=<>(\[{,;&]|\\\\|\\(?:le|ge|approx|times|cdot)\b)(\s*)([-+]|\\[pm][mp]\b)")
"""A sign without an operand before it, which Ziamath would space as if there were one."""


def with_signs(tex: str) -> str:
    """LaTeX in which a sign of one operand is close to it: as {-}x."""
    return _SIGN.sub(r"\1\2{\3}", tex)


def mathml(tex: str, *, inline: bool) -> ElementTree.Element:
    """MathML of an equation, in the color of the text, with space between cells of matrices."""
    found = ElementTree.fromstring(tex2mml(with_signs(tex), inline=inline))
    found.set("mathcolor", "currentColor")
    for table in found.findall(".//{*}mtable"):
        table.set("rowspacing", ROW_SPACE)
        if table.get("columnspacing") is None:  # aligned equations have theirs
            table.set("columnspacing", COLUMN_SPACE)
    return found


def _picture(node: nodes.Element, *, inline: bool) -> str:
    tex = NUMBER.sub("", " ".join(node.astext().split()))
    try:
        drawn = ziamath.Math(mathml(tex, inline=inline), size=SIZE)
        svg = drawn.svgxml()
    except Exception as error:  # the warning names page and line
        LOGGER.warning("equation: %r", error, location=node)
        return ""
    for side in ("width", "height"):
        svg.set(side, f"{float(svg.get(side)) / SIZE * SCALE:.3f}em")
    svg.set("style", f"vertical-align: {drawn.getyofst() / SIZE * SCALE:.3f}em")
    svg.set("role", "img")
    svg.set("aria-label", tex)
    return ElementTree.tostring(svg, encoding="unicode")


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(_picture(node, inline=True))
    raise nodes.SkipNode


def _display(self: Any, node: nodes.math_block) -> None:
    number = NUMBER.search(node.astext())
    shown = f'<span class="eqno" id="equation-{number[1]}">({number[1]})</span>' if number else ""
    picture = _picture(node, inline=False)
    self.body.append(f'<div class="math" tabindex="0">{picture}{shown}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer."""
    app.add_html_math_renderer("pictures", (_inline, None), (_display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
