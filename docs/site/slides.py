"""Sphinx extension of the course site: slides for the labs, from the pages of `docs/slides/`.

A page becomes a deck in one HTML file that needs no network: its title is the first slide, each of
its sections another one. The directive `picture` embeds a picture that a notebook shows, so that
the slides show the stored results:

    ```{picture} ../../notebooks/02_cyclical_maps.ipynb
    :heading: The map of a real pair
    ```

embeds the first picture below the heading ## that contains these words; with the option `number`
the second one, the third one, ... The path may also be that of a drawing, whose description becomes
the alternative text. The text of the directive `notes` is shown in the presenter's view only.
"""

import base64
import re
from html import escape, unescape
from pathlib import Path

import nbformat
from course import pictures
from docutils import nodes
from docutils.parsers.rst import directives
from formulas import math_font
from nbformat import NotebookNode
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

DECKS = "docs/slides/"


class Picture(SphinxDirective):
    """Embed a picture file or a picture of a notebook's stored outputs, with its
    alternative text."""

    required_arguments = 1
    option_spec = {"heading": directives.unchanged, "number": directives.positive_int}

    def run(self) -> list[nodes.Node]:
        # The second of two paths is absolute.
        path = Path(self.env.relfn2path(self.arguments[0])[1])
        self.env.note_dependency(str(path))
        if path.suffix == ".svg":
            form = "image/svg+xml"
            data = base64.b64encode(path.read_bytes()).decode()
            alt = unescape(re.search("<desc[^>]*>(.*?)</desc>", path.read_text("utf-8"))[1])
        else:
            heading = self.options["heading"]
            found = pictures_below(nbformat.read(path, as_version=4), heading)
            number = self.options.get("number", 1)
            if len(found) < number:
                raise self.error(f"no picture {number} below {heading!r}")
            form, data, alt = found[number - 1]
        image = f'<img src="data:{form};base64,{data}" alt="{escape(alt)}">'
        return [nodes.raw("", image, format="html")]


class Notes(SphinxDirective):
    """Notes for the lecturer, in Markdown."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        return [nodes.container("", *self.parse_content_to_nodes(), classes=["notes"])]


def pictures_below(notebook: NotebookNode, heading: str) -> list[tuple[str, str, str]]:
    """Find the `pictures` of a section, whose title has the words `heading`."""
    found = []
    inside = False
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            for title in re.findall("^## .*", cell.source, re.MULTILINE):
                inside = heading in title
        elif inside:
            found += pictures(cell)
    return found


def choose_template(
    app: Sphinx, pagename: str, templatename: str, context: dict, doctree: object
) -> str | None:
    """Use the template of the slides, which embeds the font of formulas, for the pages of
    `docs/slides/` (Sphinx's event `html-page-context`)."""
    if not pagename.startswith(DECKS):
        return None
    context["math_font"] = base64.b64encode(math_font()).decode()
    return "slides.html"


def setup(app: Sphinx) -> None:
    """Register the directives and the choice of the template with Sphinx."""
    app.add_directive("picture", Picture)
    app.add_directive("notes", Notes)
    app.connect("html-page-context", choose_template)
