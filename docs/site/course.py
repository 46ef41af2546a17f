"""Sphinx extension of the course site: what MyST-NB and the theme do not do with stored notebooks.

- Widgets become the picture that they showed when the notebook was stored.
- The outputs that answer a prediction are folded, and left out of the notebooks to run.
- Exercises lose their solutions, hidden tests and guides for marking, by nbgrader's own
  preprocessors.
- Each notebook can be downloaded and, if the repository's address is known, opened in Colab with an
  install cell.
- Docstrings keep their indented examples.
- Intervals such as [47.6, 66.2] never break over two lines. Wide tables use the margin at the
  right.
- The members of the modules in the reference are folded.
"""

import re
import shutil
from copy import deepcopy
from html import escape, unescape
from pathlib import Path
from types import FunctionType, ModuleType
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

# A table uses the margin if one of its rows has at least as many cells and characters.
WIDE_COLUMNS = 7
WIDE_ROW = 80
# An interval such as [47.6, −6.2].
INTERVAL = re.compile(r"\[[-−]?[\d.]+, [-−]?[\d.]+\]")

# Pages that belong to a page but that the sidebar leaves out, as patterns.
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
    """Prepare the text of a page before it is parsed (Sphinx's event `source-read`)."""
    path = app.env.doc2path(docname)
    if path.suffix == ".ipynb":
        notebook = nbformat.reads(source[0], as_version=4)
        remove_solutions(notebook, app.srcdir)
        for cell in answering_cells(notebook):
            cell.metadata.tags = [*cell.metadata.get("tags", []), "hide-output"]  # folded
        widgets = notebook.metadata.pop("widgets", {})
        for cell in notebook.cells:
            if cell.cell_type == "code":
                if "checks" in cell.metadata.get("tags", []):
                    cell.metadata.tags.append("hide-cell")  # folded
                cell.outputs = [
                    shown for output in cell.outputs for shown in static_outputs(output, widgets)
                ]
        # `describe_pictures` gives these to the pictures of the page, in the same order.
        app.env.temp_data["alternative texts"] = [
            output.metadata[form]["alt"]
            for cell in notebook.cells
            for output in cell.get("outputs", [])
            for form in output.get("data", {})
            if form.startswith("image/")
        ]
        notebook.cells.insert(
            1, nbformat.v4.new_markdown_cell(run_links(docname, app.config.course_repository))
        )
        source[0] = nbformat.writes(notebook)
    else:
        # A link to a folder, which has no page, becomes its text.
        source[0] = re.sub(
            r"\[([^]]*)\]\(([^)#:\s]+)\)",
            lambda link: link[1] if (path.parent / link[2]).is_dir() else link[0],
            source[0],
        )
    if docname in CHILDREN:
        source[0] += HIDDEN_LINKS % CHILDREN[docname]
    if docname.startswith("docs/api/"):
        source[0] = re.sub(r"^- `zsp_lite\.(\S+)`$", MODULE, source[0], flags=re.MULTILINE)


def remove_solutions(notebook: NotebookNode, root: Path) -> None:
    """Make the student version of an exercise; other notebooks, without cells of nbgrader, stay as
    they are."""
    if any("nbgrader" in cell.metadata for cell in notebook.cells):
        config = PyFileConfigLoader(
            "nbgrader_config.py", path=str(root / "notebooks" / "exercises")
        ).load_config()
        for clear in (ClearSolutions, ClearHiddenTests, ClearMarkScheme):
            clear(config=config).preprocess(notebook, {})


def static_outputs(output: NotebookNode, widgets: dict) -> list[NotebookNode]:
    """Return the picture and the caption of a stored widget; other outputs stay as they are."""
    data = output.get("data", {})
    if WIDGET in data:
        return widget_outputs(
            widgets["application/vnd.jupyter.widget-state+json"]["state"], data[WIDGET]["model_id"]
        )
    return [output]


def html_output(html: str) -> NotebookNode:
    """Make an output of a cell."""
    return nbformat.v4.new_output("display_data", {"text/html": html})


def widget_outputs(models: dict, identifier: str) -> list[NotebookNode]:
    """Return the stored picture of a widget, its caption, and the names and values of its
    controls."""
    pictures = []
    captions = []
    controls = []

    def visit(identifier: str) -> None:
        """Collect what a part of the widget, and the parts inside it, show."""
        model = models[identifier]
        state = model["state"]
        if model["model_name"] == "ImageModel":
            (buffer,) = model["buffers"]
            pictures.append({f"image/{state['format']}": buffer["data"]})
        elif model["model_name"] == "HTMLModel":
            captions.append(
                re.sub("<style>.*?</style>|<[^>]*>", "", state["value"], flags=re.DOTALL).strip()
            )
        elif state.get("description"):
            value = state.get("value", "")
            if "index" in state:
                value = state["_options_labels"][state["index"]]
            text = state["description"]
            controls.append(text if value == "" else f"{text} = {value}")
        for child in state.get("children", []):
            visit(child.removeprefix("IPY_MODEL_"))

    visit(identifier)
    note = html_output(
        f'<p class="widget">Interactive in a running notebook: {escape(", ".join(controls))}.</p>'
    )
    if not pictures:
        return [note]
    alt = " ".join(captions).removeprefix("Picture: ")
    (picture,) = pictures
    metadata = {form: {"alt": unescape(alt)} for form in picture}
    return [
        nbformat.v4.new_output("display_data", picture, metadata=metadata),
        html_output(f'<p class="widget">{captions[-1]}</p>'),
        note,
    ]


def describe_pictures(app: Sphinx, doctree: nodes.document) -> None:
    """Give the pictures of stored outputs their alternative texts, which MyST-NB leaves out
    (`doctree-read`)."""
    pictures = [node for node in doctree.findall(nodes.image) if "jupyter_execute" in node["uri"]]
    for node, alt in zip(pictures, app.env.temp_data.get("alternative texts", []), strict=True):
        node["alt"] = alt


def keep_intervals(app: Sphinx, doctree: nodes.document) -> None:
    """Join the ends of intervals in text, and in the HTML tables of outputs, by a no-break space
    (`doctree-read`)."""

    def join(interval: re.Match[str]) -> str:
        return interval[0].replace(" ", "\N{NO-BREAK SPACE}")

    verbatim = nodes.raw | nodes.literal | nodes.literal_block | nodes.math | nodes.math_block
    for text in list(doctree.findall(nodes.Text)):
        table = isinstance(text.parent, nodes.raw) and "<table" in text
        if table or not isinstance(text.parent, verbatim):
            text.parent.replace(text, nodes.Text(INTERVAL.sub(join, text)))


def widen_tables(app: Sphinx, doctree: nodes.document) -> None:
    """Let wide tables, and outputs that have one, use the margin at the right (`doctree-read`)."""
    for table in list(doctree.findall(nodes.table)):
        rows = [[cell.astext() for cell in row] for row in table.findall(nodes.row)]
        if is_wide(rows):
            box = nodes.container(classes=["full-width"])
            table.replace_self(box)
            box += table
    for part in doctree.findall(nodes.raw):
        rows = [
            re.findall(r"<t[hd].*?>(.*?)</t[hd]>", row, re.DOTALL)
            for row in part.astext().split("</tr>")
        ]
        if is_wide([[re.sub("<.*?>", "", cell) for cell in row] for row in rows]):
            output = part.parent
            while "cell_output" not in output.get("classes", ["cell_output"]):
                output = output.parent
            output["classes"].append("full-width")


def is_wide(rows: list[list[str]]) -> bool:
    """Whether a table has a row of many cells and characters."""
    return any(len(row) >= WIDE_COLUMNS and len("".join(row)) >= WIDE_ROW for row in rows)


def mark_place(app: Sphinx, doctree: nodes.document) -> None:
    """Give the strip at the top of a notebook a class such as here-42: the middle of its first
    marked box is at 42 % of its width (`doctree-read`)."""
    for image in doctree.findall(nodes.image):
        if "/here_" in image["uri"]:
            strip = (app.srcdir / image["uri"]).read_text(encoding="utf-8")
            box = re.search('<rect x="([^"]*)"[^>]*? width="([^"]*)"[^>]*stroke="#0072B2"', strip)
            middle = float(box[1]) + float(box[2]) / 2
            width = float(re.search('width="(.*?)"', strip)[1])  # the first is that of the strip
            image["classes"].append(f"here-{100 * (middle / width):.0f}")


def fold_members(app: Sphinx, doctree: nodes.document) -> None:
    """Fold what a module of the reference defines, below links to all of it (`doctree-read`)."""
    if not app.env.docname.startswith("docs/api/"):
        return
    for section in list(doctree.findall(nodes.section)):
        members = [node for node in section.children if isinstance(node, addnodes.desc)]
        if members:
            links = []
            for member in members:
                signature = member[0]
                if signature["ids"]:
                    name = f"<code>{signature['fullname']}</code>"
                    links.append(f'<a href="#{signature["ids"][0]}">{name}</a>')
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
    links = [
        (f"{up}docs/install.html#run-the-notebooks", "Run it"),
        (f"{up}run/{docname}.ipynb", "Download"),
    ]
    if repository:
        name = urlsplit(repository).path.strip("/")
        links += [
            (
                f"https://colab.research.google.com/github/{name}/blob/{BRANCH}/run/{docname}.ipynb",
                "Open in Colab",
            ),
            (f"https://codespaces.new/{name}", "Open in a dev container"),
        ]
    shown = " ".join(f'<a href="{escape(link)}">{text}</a>' for link, text in links)
    return f'<p class="run">{shown}</p>'


def runnable(notebook: NotebookNode, docname: str, repository: str) -> NotebookNode:
    """Copy a notebook for Colab, if the repository's address is known: with a first cell that
    installs zsp-lite, and with the addresses of drawings and pages on GitHub."""
    notebook = deepcopy(notebook)
    if repository:
        for cell in notebook.cells:
            if cell.cell_type == "markdown":
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


def write_files(app: Sphinx, error: Exception | None) -> None:
    """Write the notebooks to run with their drawings (Sphinx's event `build-finished`)."""
    if error or app.builder.format != "html":
        return
    for docname in app.env.found_docs:
        path = app.env.doc2path(docname)
        if path.suffix == ".ipynb":
            notebook = nbformat.read(path, as_version=4)
            remove_solutions(notebook, app.srcdir)
            clear_answers(notebook)
            copy = app.outdir / "run" / f"{docname}.ipynb"
            copy.parent.mkdir(parents=True, exist_ok=True)
            nbformat.write(runnable(notebook, docname, app.config.course_repository), copy)
    shutil.copytree(
        app.srcdir / "notebooks" / "figures",
        app.outdir / "run" / "notebooks" / "figures",
        dirs_exist_ok=True,
    )


def skip_imported(
    app: Sphinx, what: str, name: str, member: object, skip: bool, options: object
) -> bool | None:
    """Leave out what a module imports from other packages, before autodoc analyses them
    (`autodoc-skip-member`)."""
    if what != "module" or not isinstance(member, ModuleType | type | FunctionType):
        return None
    home = getattr(member, "__module__", "")
    foreign = isinstance(member, ModuleType) or not home.startswith("zsp_lite")
    return True if foreign else None


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
        page = re.sub(r"\bdocs/(\w+)\.md", r"`docs/\1.md <../\1.html>`__", line.replace("|", r"\|"))
        text.append(line if literal else page)
    lines[:] = text


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the functions to Sphinx's events."""
    app.add_config_value("course_repository", "", "env", str)
    app.connect("source-read", read_source)
    app.connect("doctree-read", describe_pictures)
    app.connect("doctree-read", keep_intervals)
    app.connect("doctree-read", widen_tables)
    app.connect("doctree-read", mark_place)
    app.connect("doctree-read", fold_members)
    app.connect("env-updated", shorten_titles)
    app.connect("autodoc-skip-member", skip_imported)
    app.connect("autodoc-process-docstring", mark_examples, priority=400)
    app.connect("build-finished", write_files)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
