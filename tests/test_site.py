"""The course site (`make site`): every link leads somewhere, notebooks are complete, solutions stay
out."""

import importlib
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import nbformat
import pytest
from bs4 import BeautifulSoup

import zsp_lite
from tools.lab import answering_cells

REPOSITORY = Path(__file__).parents[1]
NOTEBOOKS = sorted((REPOSITORY / "notebooks").glob("*.ipynb"))
EXERCISES = sorted((REPOSITORY / "notebooks/exercises/source").glob("*/*.ipynb"))
DECKS = sorted((REPOSITORY / "docs/slides").glob("*.md"))
pytestmark = pytest.mark.slow  # the site is built once, for all tests of this file


class Page:
    """Links, loaded files, anchors and pictures of an HTML page."""

    def __init__(self, path: Path):
        html = BeautifulSoup(path.read_bytes(), "html.parser")
        self.links = [tag["href"] for tag in html.find_all("a", href=True)]
        self.pictures = html.find_all("img")
        self.text = html.get_text()
        self.folded = len(html.select("div.cell > details"))
        self.loaded = [tag["src"] for tag in html.select("img[src], script[src], iframe[src]")]
        # All other links of the head load a file.
        leading_on = {"next", "prev", "canonical", "search", "index"}
        self.loaded += [
            tag["href"] for tag in html.find_all("link") if not leading_on & {*tag["rel"]}
        ]
        self.anchors = {
            tag[key] for key in ("id", "name") for tag in html.find_all(attrs={key: True})
        }


@pytest.fixture(scope="module")
def pages(site):
    """All pages by their path in the site; the theme keeps templates of its own in _static/."""
    paths = [path for path in sorted(site.rglob("*.html")) if "_static" not in path.parts]
    return {str(path.relative_to(site)): Page(path) for path in paths}


def page_of(source: Path) -> str:
    """The path in the site of the page of a source."""
    return str(source.relative_to(REPOSITORY).with_suffix(".html"))


def test_every_link_and_anchor_leads_somewhere_and_every_page_is_reached(site, pages):
    broken = []
    reached = {"index.html", "search.html", "docs/index.html"}
    for name, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue  # the link leads out of the site
            path = (site / name).resolve()
            if parts.path:
                path = (path.parent / unquote(parts.path)).resolve()
            target = str(path.relative_to(site.resolve()))
            reached.add(target)
            anchor = unquote(parts.fragment)
            lacks_anchor = anchor and target in pages and anchor not in pages[target].anchors
            if not path.is_file() or lacks_anchor:
                broken.append(f"{name}: {link}")
    assert not broken, "\n".join(broken)
    assert set(pages) <= reached


def test_no_page_loads_anything_from_elsewhere(site, pages):
    for name, page in pages.items():
        for source in page.loaded:
            path = urlsplit(source)
            if path.scheme != "data":
                assert not path.netloc and ((site / name).parent / unquote(path.path)).is_file(), (
                    f"{name}: {source}"
                )


@pytest.mark.parametrize("path", DECKS, ids=lambda path: path.stem)
def test_a_deck_of_slides_is_a_single_file_with_its_pictures(pages, path):
    page = pages[page_of(path)]
    assert len(page.pictures) == path.read_text("utf-8").count("```{picture}")
    assert page.loaded == [picture["src"] for picture in page.pictures]
    assert all(source.startswith("data:image/") for source in page.loaded)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_shows_its_stored_pictures_its_drawings_and_what_it_printed(pages, path):
    page, cells = pages[page_of(path)], nbformat.read(path, 4).cells
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    texts = [
        output.metadata[form]["alt"]
        for output in outputs
        for form in output.get("data", {})
        if "image/" in form
    ]
    shown = [picture["alt"] for picture in page.pictures]
    assert [text for text in shown if text in texts] == texts
    drawings = re.findall(r"!\[([^]]+)\]\(", "\n".join(cell.source for cell in cells))
    assert all(" ".join(text.split()) in shown for text in drawings)
    # What is folded: checks, and outputs that answer a prediction.
    checks = [cell for cell in cells if "checks" in cell.metadata.get("tags", [])]
    answers = [cell for cell in answering_cells(nbformat.read(path, 4)) if cell.outputs]
    assert page.folded == len(checks) + len(answers)
    for output in outputs:
        if output.output_type == "stream" and output.text.strip():
            assert output.text.strip().splitlines()[0].strip() in page.text


def test_no_formula_shows_a_command_of_latex(site, pages):
    for path in pages:
        formulas = re.findall("<math.*?</math>", (site / path).read_text("utf-8"))
        assert not re.findall(r"\\\w+", " ".join(formulas)), path


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_shows_every_line_also_one_that_begins_with_a_percent_sign(pages, path):
    shown = "".join(pages[page_of(path)].text.split())
    cells = [cell.source for cell in nbformat.read(path, 4).cells if cell.cell_type == "markdown"]
    # What the page shows in another form: formulas, code, tags, pictures and links.
    others = r"\$\$.*?\$\$|\$.*?\$|```.*?```|<.*?>|!\[.*?\)|\]\(.*?\)"
    for line in re.sub(others, "|", "\n".join(cells), flags=re.DOTALL).splitlines():
        # The longest part of the line without signs, which the page may show as others.
        longest = max(re.findall("[%A-Za-z0-9, ]+", line), key=len, default="")
        assert "".join(longest.split()) in shown, line


def test_exercises_are_offered_without_solutions_hidden_tests_and_guides(site, pages):
    for path in EXERCISES:
        source = "\n".join(cell.source for cell in nbformat.read(path, 4).cells)
        hidden = re.compile(r"### BEGIN (?:SOLUTION|HIDDEN TESTS)\n(.*?)### END", re.DOTALL)
        shown = hidden.sub("", source)
        lines = {line.strip() for part in hidden.findall(source) for line in part.splitlines()}
        # Short lines may stand elsewhere by chance.
        secrets = {line for line in lines if len(line) > 25 and line not in shown}
        copy = nbformat.read(site / "run" / path.relative_to(REPOSITORY), 4)
        for text in (pages[page_of(path)].text, "\n".join(cell.source for cell in copy.cells)):
            assert "raise NotImplementedError" in text
            assert len(secrets) > 10
            assert not [secret for secret in secrets if secret in text], path.name
    for path in site.rglob("*"):
        if path.suffix in (".html", ".ipynb", ".js", ".txt"):
            text = path.read_text("utf-8")
            assert not re.search("BEGIN (SOLUTION|HIDDEN TESTS)|Guide for marking", text), path.name


def test_the_reference_describes_every_public_class_and_function(pages):
    anchors = set().union(
        *(page.anchors for name, page in pages.items() if name.startswith("docs/api/"))
    )
    homes = zsp_lite._HOME_OF  # without importing them, which takes seconds
    public = [
        name
        for name in homes
        if name[0].isupper() or name in ("load_backbone", "estimate_pose", "open_source")
    ]
    assert len(public) > 10
    for name in public:
        assert f"{homes[name]}.{name}" in anchors, name


def test_every_notebook_can_be_downloaded_with_its_drawings(site, pages):
    for path in (*NOTEBOOKS, *EXERCISES):
        copy = Path("run", path.relative_to(REPOSITORY))
        assert any(link.endswith(str(copy)) for link in pages[page_of(path)].links), path.name
        for drawing in re.findall(r"\]\((figures/[^)]+)\)", (site / copy).read_text("utf-8")):
            assert (site / copy.parent / drawing).is_file(), f"{path.name}: {drawing}"
        answers = answering_cells(nbformat.read(site / copy, 4))
        assert not any(cell.outputs for cell in answers), path.name


def test_with_an_address_a_notebook_has_links_to_run_it_and_an_install_cell(monkeypatch):
    monkeypatch.syspath_prepend(REPOSITORY / "docs/site")
    course = importlib.import_module("course")
    address = "https://github.com/someone/zsp"
    links = course.run_links("notebooks/00_quickstart", address)
    branch = f"https://colab.research.google.com/github/someone/zsp/blob/{course.BRANCH}"
    assert f'href="{branch}/run/notebooks/00_quickstart.ipynb"' in links
    stored = nbformat.read(NOTEBOOKS[0], 4)
    first, *others = course.runnable(stored, "notebooks/00_quickstart", address).cells
    assert [cell.id for cell in others] == [cell.id for cell in stored.cells]
    text = "\n".join(cell.source for cell in others if cell.cell_type == "markdown")
    assert f"({address}/raw/HEAD/notebooks/figures/here_00.svg)" in text
    assert f"({address}/blob/HEAD/docs/glossary.md#depth)" in text
    assert not re.search(r"\]\((?!https:|#)", text)
    # Outside Colab the cell does nothing: its commands are lines of IPython, indented below the
    # condition.
    assert re.match(
        r'# .*\nimport sys\n\nif "google.colab" in sys.modules:\n(( {4}.*)?\n)+$', first.source
    )


def test_in_colab_the_cell_fetches_everything_but_the_exercises(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(REPOSITORY / "docs/site")
    course = importlib.import_module("course")
    source = tmp_path / "zsp"
    needed = {"pyproject.toml", "zsp_lite/a.py", "data_samples/a.jpg", "notebooks/results/a.csv"}
    solution = "notebooks/exercises/source/a.ipynb"
    for name in (*needed, solution):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(name)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a", "-c", "init.defaultBranch=main", "-C"]
    for words in ("init -q", "config uploadpack.allowFilter true", "add .", "commit -qm a"):
        subprocess.run([*git, source, *words.split()], check=True)

    # Colab's module and folder, and no installation.
    (tmp_path / "google").mkdir()
    (tmp_path / "google/__init__.py").write_text("")
    (tmp_path / "google/colab.py").write_text("class output: enable_custom_widget_manager = print")
    cell = course.runnable(nbformat.v4.new_notebook(), "a", source.as_uri()).cells[0].source
    cell = cell.replace("/content", str(tmp_path / "content")).replace("%pip", "!echo")
    (tmp_path / "cell.ipy").write_text(f"import google.colab\n{cell}")
    settings = {"PYTHONPATH": str(tmp_path), "IPYTHONDIR": str(tmp_path / "ipython")}
    command = [sys.executable, "-m", "IPython", "cell.ipy"]
    subprocess.run(command, cwd=tmp_path, env=os.environ | settings, check=True)

    clone = tmp_path / "content/zsp-lite"
    files = {str(path.relative_to(clone)) for path in clone.rglob("*") if path.is_file()}
    assert {name for name in files if not name.startswith(".git/")} == needed
    assert (clone / "notebooks/data_samples/a.jpg").is_file()


def test_one_line_of_pyproject_gives_the_site_the_address_of_the_repository(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(tmp_path)  # restores the path, which the configuration changes
    (tmp_path / "docs/site").mkdir(parents=True)
    conf = shutil.copy(REPOSITORY / "docs/site/conf.py", tmp_path / "docs/site")
    project = (REPOSITORY / "pyproject.toml").read_text("utf-8")
    address = "https://github.com/YOU/zsp-lite"
    for line, expected in (("", ""), (f'Repository = "{address}.git/"', address)):
        text = re.sub(r"(?m)^(# )?Repository = .*$", line, project)
        (tmp_path / "pyproject.toml").write_text(text)
        assert runpy.run_path(conf)["course_repository"] == expected
