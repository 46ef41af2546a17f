"""Sphinx extension of the course site: slides for the labs, from the pages of `docs/slides/`.

A page becomes a deck in one HTML file that needs no network: its title is the first slide, each of
its sections another one. The directive `picture` embeds a picture that a notebook shows, so that
the slides show the stored results:

    ```{picture} ../../notebooks/02_cyclical_maps.ipynb
    :heading: The map of a real pair
    ```

embeds the first picture below the heading that contains these words; with the option `number` the
second one, the third one, ... The path may also be that of a drawing, whose description becomes the
alternative text. The text of the directive `notes` is shown in the presenter's view only.
"""

import base64
import re
from html import escape, unescape
from pathlib import Path

import nbformat
from docutils import nodes
from docutils.parsers.rst import directives
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
        path = (Path(self.env.doc2path(self.env.docname)).parent / self.arguments[0]).resolve()
        if not path.is_file():
            raise self.error(f"no file {self.arguments[0]}")
        self.env.note_dependency(str(path))
        if path.suffix == ".svg":
            form = "image/svg+xml"
            data = base64.b64encode(path.read_bytes()).decode()
            alt = unescape(re.search("<desc[^>]*>(.*?)</desc>", path.read_text("utf-8"))[1])
        else:
            heading = self.options["heading"]
            pictures = pictures_below(nbformat.read(path, as_version=4), heading)
            number = self.options.get("number", 1)
            if len(pictures) < number:
                raise self.error(f"no picture {number} below {heading!r}")
            form, data, alt = pictures[number - 1]
        image = f'<img src="data:{form};base64,{data}" alt="{escape(alt)}">'
        return [nodes.raw("", image, format="html")]


class Notes(SphinxDirective):
    """Notes for the lecturer, in Markdown."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        return [nodes.container("", *self.parse_content_to_nodes(), classes=["notes"])]


def pictures_below(notebook: NotebookNode, heading: str) -> list[tuple[str, str, str]]:
    """Find the pictures of a section.

    Args:
        notebook: Notebook with stored outputs.
        heading: Words of the section's heading.

    Returns:
        Media type, data in base64 and alternative text of each PNG or JPEG picture in the outputs
        from the cell with the heading to the next cell with a heading of the same or a higher
        level. Empty without such a heading.
    """
    pictures = []
    level = 0  # number of # of the heading; 0 above it
    for cell in notebook.cells:
        if cell.cell_type == "markdown" and level:  # Does the section end here?
            if re.search(rf"(?m)^#{{1,{level}}} ", cell.source):
                break
        elif cell.cell_type == "markdown":
            mark = re.search(rf"(?m)^(#+) .*{re.escape(heading)}", cell.source)
            level = len(mark[1]) if mark else 0
        elif level:
            for output in cell.get("outputs", []):
                for form in {"image/png", "image/jpeg"} & set(output.get("data", {})):
                    pictures.append((form, output.data[form], output.metadata[form]["alt"]))
    return pictures


def choose_template(
    app: Sphinx, pagename: str, templatename: str, context: dict, doctree: object
) -> str | None:
    """Use the template of the slides for the pages of `docs/slides/` (Sphinx's event
    `html-page-context`)."""
    return "slides.html" if pagename.startswith(DECKS) else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives and the choice of the template with Sphinx."""
    app.add_directive("picture", Picture)
    app.add_directive("notes", Notes)
    app.connect("html-page-context", choose_template)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
