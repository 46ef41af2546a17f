"""Sphinx extension of the course site: what MyST-NB and the theme do not do with stored notebooks.

- Widgets become the picture that they showed when the notebook was stored.
- The outputs that answer a prediction are folded, and left out of the notebooks to run.
- Exercises lose their solutions, hidden tests and guides for marking, by nbgrader's own
  preprocessors.
- Each notebook can be downloaded and, if the repository's address is known, opened in Colab with an
  install cell.
- Docstrings keep their indented examples.
- Intervals such as [47.6, 66.2] never break over two lines.
- The members of the modules in the reference are folded.
"""

import re
import shutil
from collections.abc import Iterator
from copy import deepcopy
from html import escape, unescape
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import nbformat
from docutils import nodes
from nbformat import NotebookNode
from nbgrader.preprocessors import ClearHiddenTests, ClearMarkScheme, ClearSolutions
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from traitlets.config import PyFileConfigLoader

from tools.lab import answering_cells, clear_answers

WIDGET = "application/vnd.jupyter.widget-view+json"
BRANCH = "gh-pages"  # where the workflow publishes the site, and so the notebooks that Colab opens

# An interval such as [47.6, −6.2].
INTERVAL = re.compile(r"\[[-−]?[\d.]+, [-−]?[\d.]+\]")

# Pages that belong to a page but that the sidebar leaves out, as patterns. Each page below
# notebooks/exercises/ but its README has an underscore in its path.
CHILDREN = {"notebooks/README": "../docs/slides/*", "notebooks/exercises/README": "**_*"}
HIDDEN_LINKS = """

```{toctree}
:hidden:
:glob:

%s
```
"""

# A line "- `zsp_lite.NAME`" of a page of the reference becomes a section with the docstrings of
# this module.
MODULE = r"""
## \1

```{eval-rst}
.. automodule:: zsp_lite.\1
```
"""

# The link to data_samples is for `sample_data`, which looks in the working folder: the installed
# package is outside the clone.
INSTALL_IN_COLAB = """\
# Colab only: fetches zsp-lite with its sample data, installs what Colab lacks (about a minute).
import sys

if "google.colab" in sys.modules:
    # Without the exercises, which have the solutions, and, by `cat`, without progress bars.
    !git clone --depth 1 --filter=blob:none --sparse {repository} /content/zsp-lite 2>&1 | cat
    %cd /content/zsp-lite
    !git sparse-checkout add zsp_lite data_samples notebooks/results 2>&1 | cat
    %pip install --quiet . anywidget jupyterquiz
    %cd notebooks
    !ln -sfn ../data_samples
    from google.colab import output

    output.enable_custom_widget_manager()  # the 3D view for clicks on point clouds
"""


def read_source(app: Sphinx, docname: str, source: list[str]) -> None:
    """Prepare the text of a page before it is parsed, and write the notebook to run (Sphinx's event
    `source-read`)."""
    if app.env.doc2path(docname).suffix == ".ipynb":
        notebook = nbformat.reads(source[0], as_version=4)
        remove_solutions(notebook, app.srcdir)
        copy = runnable(notebook, docname, app.config.course_repository)
        file = app.outdir / "run" / f"{docname}.ipynb"
        file.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(copy, file)
        # Checks, and outputs that answer a prediction, are folded.
        answering = answering_cells(notebook)
        widgets = notebook.metadata.pop("widgets", {})
        for cell in notebook.cells:
            if cell.cell_type == "code":
                tags = cell.metadata.setdefault("tags", [])
                if cell in answering:
                    tags.append("hide-output")
                if "checks" in tags:
                    tags.append("hide-cell")
                cell.outputs = [
                    shown for output in cell.outputs for shown in without_widget(output, widgets)
                ]
        # `describe_pictures` gives these to the pictures of the page, in the same order.
        app.env.temp_data["alternative texts"] = [
            alt for cell in notebook.cells for *_, alt in pictures(cell)
        ]
        # The links stand below the title, which is the first cell.
        notebook.cells.insert(
            1, nbformat.v4.new_markdown_cell(run_links(docname, app.config.course_repository))
        )
        source[0] = nbformat.writes(notebook)
    if docname in CHILDREN:
        source[0] += HIDDEN_LINKS % CHILDREN[docname]
    if docname.startswith("docs/api/"):
        source[0] = re.sub(r"^- `zsp_lite\.(\S+)`$", MODULE, source[0], flags=re.MULTILINE)


def remove_solutions(notebook: NotebookNode, root: Path) -> None:
    """Make the student version of an exercise; other notebooks stay as they are."""
    folder = str(root / "notebooks" / "exercises")
    config = PyFileConfigLoader("nbgrader_config.py", path=folder).load_config()
    for clear in (ClearSolutions, ClearHiddenTests, ClearMarkScheme):
        clear(config=config).preprocess(notebook, {})


def without_widget(output: NotebookNode, widgets: dict) -> list[NotebookNode]:
    """Return what a stored widget shows: its picture, its caption, and the names and values of its
    controls; other outputs stay as they are."""
    data = output.get("data", {})
    if WIDGET not in data:
        return [output]
    models = widgets["application/vnd.jupyter.widget-state+json"]["state"]
    images = []
    captions = []
    controls = []
    for model in widget_parts(models, data[WIDGET]["model_id"]):
        state = model["state"]
        if model["model_name"] == "ImageModel":
            (buffer,) = model["buffers"]
            images.append({f"image/{state['format']}": buffer["data"]})
        elif model["model_name"] == "HTMLModel":
            # The first HTML of a widget describes its picture and is not visible, the last is the
            # caption below it: see `interactive_figure`.
            captions.append(
                re.sub("<style>.*?</style>|<[^>]*>", "", state["value"], flags=re.DOTALL).strip()
            )
        elif state.get("description"):
            value = state.get("value", "")
            if "index" in state:  # a choice, which stores only the place of its value
                value = state["_options_labels"][state["index"]]
            text = state["description"]
            controls.append(text if value == "" else f"{text} = {value}")
    shown = []
    for image in images:
        alt = unescape(" ".join(captions).removeprefix("Picture: "))
        metadata = {form: {"alt": alt} for form in image}
        shown.append(nbformat.v4.new_output("display_data", image, metadata=metadata))
        shown.append(note(captions[-1]))
    return [*shown, note(f"Interactive in a running notebook: {escape(', '.join(controls))}.")]


def widget_parts(models: dict, identifier: str) -> Iterator[dict]:
    """Yield the models of a widget and of the parts inside it."""
    model = models[identifier.removeprefix("IPY_MODEL_")]
    yield model
    for child in model["state"].get("children", []):
        yield from widget_parts(models, child)


def note(html: str) -> NotebookNode:
    """Make an output that is a small text below a widget."""
    html = f'<p class="widget">{html}</p>'
    return nbformat.v4.new_output("display_data", {"text/html": html})


def pictures(cell: NotebookNode) -> list[tuple[str, str, str]]:
    """List media type, data in base64 and alternative text of the pictures in a cell's outputs."""
    return [
        (form, output.data[form], output.metadata[form]["alt"])
        for output in cell.get("outputs", [])
        for form in output.get("data", {})
        if form.startswith("image/")
    ]


def describe_pictures(app: Sphinx, doctree: nodes.document) -> None:
    """Give the pictures of stored outputs their alternative texts, which MyST-NB leaves out
    (`doctree-read`)."""
    images = [node for node in doctree.findall(nodes.image) if "jupyter_execute" in node["uri"]]
    for node, alt in zip(images, app.env.temp_data.get("alternative texts", []), strict=True):
        node["alt"] = alt


def keep_intervals(app: Sphinx, doctree: nodes.document) -> None:
    """Join the ends of intervals in text, and in the HTML tables of outputs, by a no-break space
    (`doctree-read`)."""
    verbatim = nodes.raw | nodes.literal | nodes.literal_block | nodes.math | nodes.math_block
    space = "\N{NO-BREAK SPACE}"
    for text in list(doctree.findall(nodes.Text)):
        table = isinstance(text.parent, nodes.raw) and "<table" in text
        if table or not isinstance(text.parent, verbatim):
            joined = INTERVAL.sub(lambda interval: interval[0].replace(" ", space), text)
            text.parent.replace(text, nodes.Text(joined))


def mark_place(app: Sphinx, doctree: nodes.document) -> None:
    """Give the strip at the top of a notebook, a drawing of the method's stages, a class such as
    here-324 (`doctree-read`).

    The number is the left end, in pixels, of the first box that is marked as this notebook's;
    `static/site.js` scrolls to it.
    """
    for image in doctree.findall(nodes.image):
        if "/here_" in image["uri"]:
            strip = (app.srcdir / image["uri"]).read_text(encoding="utf-8")
            box = re.search(r'<rect x="(\d+)[^>]*stroke="#0072B2"', strip)
            image["classes"].append(f"here-{box[1]}")


def fold_members(app: Sphinx, doctree: nodes.document) -> None:
    """Fold what a module of the reference defines, below links to all of it (`doctree-read`)."""
    for section in list(doctree.findall(nodes.section)):
        members = [node for node in section.children if isinstance(node, addnodes.desc)]
        if members:
            # The first part of a member is its signature.
            links = [
                f'<a href="#{member[0]["ids"][0]}"><code>{member[0]["fullname"]}</code></a>'
                for member in members
            ]
            start = (
                f'<p class="members">{", ".join(links)}</p><details class="members"><summary>'
                "Signatures and arguments</summary>"
            )
            section.insert(section.index(members[0]), nodes.raw("", start, format="html"))
            section += nodes.raw("", "</details>", format="html")


def shorten_titles(app: Sphinx, env: BuildEnvironment) -> None:
    """Shorten the titles of the notebooks in the sidebar to the part before the colon (Sphinx's
    event `env-updated`)."""
    for name, contents in env.tocs.items():
        if name.startswith("notebooks/"):
            title = next(contents.findall(nodes.Text))
            title.parent.replace(title, nodes.Text(title.partition(":")[0]))


def run_links(docname: str, repository: str) -> str:
    """Return HTML with links to run a notebook: instructions, download, Colab, dev container."""
    up = "../" * docname.count("/")
    links = {
        "Run it": f"{up}docs/install.html#run-the-notebooks",
        "Download": f"{up}run/{docname}.ipynb",
    }
    if repository:
        name = urlsplit(repository).path.strip("/")
        place = f"{name}/blob/{BRANCH}/run/{docname}.ipynb"
        links["Open in Colab"] = f"https://colab.research.google.com/github/{place}"
        links["Open in a dev container"] = f"https://codespaces.new/{name}"
    shown = " ".join(f'<a href="{link}">{text}</a>' for text, link in links.items())
    return f'<p class="run">{shown}</p>'


def runnable(notebook: NotebookNode, docname: str, repository: str) -> NotebookNode:
    """Copy a notebook for readers to run, without answers. If the repository's address is known, it
    has a first cell that installs zsp-lite in Colab, and the addresses of drawings and pages on
    GitHub."""
    notebook = deepcopy(notebook)
    clear_answers(notebook)
    if repository:
        for cell in notebook.cells:
            if cell.cell_type == "markdown":
                # Pictures have the sign ! and need the file itself; pages are shown by GitHub. Once
                # the pictures have full addresses, the second pass leaves them.
                for sign, kind in (("!", "raw"), ("", "blob")):
                    place = f"{repository}/{kind}/HEAD/{docname}"
                    cell.source = re.sub(
                        rf"({sign}\[[^]]*\]\()(?![a-z]+:|#)([^)]+)",
                        lambda link: link[1] + urljoin(place, link[2]),
                        cell.source,
                    )
        source = INSTALL_IN_COLAB.format(repository=repository)
        cell = nbformat.v4.new_code_cell(source, id="install")
        notebook.cells.insert(0, cell)
    return notebook


def copy_drawings(app: Sphinx) -> None:
    """Copy the drawings of the notebooks to run (Sphinx's event `builder-inited`)."""
    drawings = Path("notebooks", "figures")
    shutil.copytree(app.srcdir / drawings, app.outdir / "run" / drawings, dirs_exist_ok=True)


def mark_examples(
    app: Sphinx, kind: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """Mark indented blocks of a docstring as literal, and link pages (`autodoc-process-docstring`,
    before napoleon)."""
    text = []
    literal = False  # whether the present line belongs to a literal block
    for line in lines:
        indented = line.startswith("    ")
        # A block begins with an indented line below an empty one that ends a paragraph of text.
        if not literal and indented and text and not text[-1] and not text[-2].startswith(" "):
            literal = True
            text += ["::", ""]
        literal = literal and (indented or not line)
        # In reST, a bar would begin a substitution.
        page = re.sub(r"\bdocs/(\w+)\.md", r"`docs/\1.md <../\1.html>`__", line.replace("|", r"\|"))
        text.append(line if literal else page)
    lines[:] = text


def setup(app: Sphinx) -> None:
    """Connect the functions to Sphinx's events."""
    app.add_config_value("course_repository", "", "env", str)
    app.connect("builder-inited", copy_drawings)
    app.connect("source-read", read_source)
    app.connect("doctree-read", describe_pictures)
    app.connect("doctree-read", keep_intervals)
    app.connect("doctree-read", mark_place)
    app.connect("doctree-read", fold_members)
    app.connect("env-updated", shorten_titles)
    app.connect("autodoc-process-docstring", mark_examples, priority=400)
