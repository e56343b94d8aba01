"""Formulas as MathML, written when the pages are built.

A page then shows its formulas without JavaScript and without a network. All current
browsers show MathML.
"""

import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util.logging import getLogger
from sphinx.writers.html5 import HTML5Translator

# What the converter does not know it leaves as it is.
LEFT_OVER = re.compile(r"<m\w+>(\\[^<]*|&)</m\w+>")

logger = getLogger(__name__)


def mathml(node: nodes.Element, display: str) -> str:
    """Return a formula as MathML, with a warning where a part cannot be written."""
    written = convert(node.astext(), display=display)
    for found in LEFT_OVER.finditer(written):
        logger.warning("MathML has nothing for %r", found[1], location=node)
    return written


def visit_inline(self: HTML5Translator, node: nodes.Element) -> None:
    """Write a formula in a line of text."""
    self.body.append(mathml(node, "inline"))
    raise nodes.SkipNode


def visit_block(self: HTML5Translator, node: nodes.Element) -> None:
    """Write a formula in lines of its own, with the number that it has."""
    self.body.append(self.starttag(node, "div", CLASS="math"))
    if node["number"]:
        self.body.append(f'<span class="eqno">({node["number"]})')
        self.add_permalink_ref(node, "Link to this equation")
        self.body.append("</span>")
    self.body.append(mathml(node, "block"))
    self.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Offer the renderer under the name mathml."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
