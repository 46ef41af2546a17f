"""Every notebook runs without errors in JupyterLab in Chromium, and its widgets react to their
sliders.

A self-check gives feedback and asks nothing of the network.
"""

import shutil
from pathlib import Path

import lab_in_browser as reader
import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from test_your_turn import SOLUTIONS

NOTEBOOKS = sorted(path.name for path in (reader.REPOSITORY / "notebooks").glob("*.ipynb"))
PICTURES = reader.REPOSITORY / "outputs/browser"
LABELLING = {"08_label_poses.ipynb"}  # notebooks with a 3D view in which clicks label points
WIDGET = "application/vnd.jupyter.widget-view+json"
MINUTES = 20  # a notebook may take on a busy machine


@pytest.fixture(scope="module")
def lab(browser, tmp_path_factory):
    """JupyterLab on copies of the data and of the notebooks, which have no outputs (of 06 two), and
    a notebook "asking" with a self-check."""
    folder = tmp_path_factory.mktemp("lab")
    left_out = shutil.ignore_patterns("exercises", ".*")
    shutil.copytree(reader.REPOSITORY / "notebooks", folder / "notebooks", ignore=left_out)
    shutil.copytree(reader.REPOSITORY / "data_samples", folder / "data_samples")
    for path in (folder / "notebooks").glob("*.ipynb"):
        notebook = nbformat.read(path, as_version=4)
        for cell in notebook.cells:
            if cell.cell_type == "code":
                cell.outputs = []
                cell.execution_count = None
        nbformat.write(notebook, path)
    # For the test of typed parts: the other one keeps what its own test has run.
    shutil.copy(folder / "notebooks/06_end_to_end_demo.ipynb", folder / "notebooks/mine.ipynb")
    python = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    check = new_code_cell('from zsp_lite.course.widgets import self_check\nself_check("00", 1)')
    asking = new_notebook(
        cells=[new_markdown_cell("A formula, for MathJax: $x^2$"), check], metadata=python
    )
    nbformat.write(asking, folder / "notebooks/asking.ipynb")
    with reader.serve(folder / "notebooks", folder, folder / "data_samples") as running:
        yield running


@pytest.fixture
def page(browser, lab):
    """An empty page of the browser; kernels of its notebook end with it."""
    context = browser.new_context(viewport={"width": 1300, "height": 1000})
    context.set_default_timeout(180_000)  # milliseconds, for a busy machine
    yield context.new_page()
    context.close()
    lab.stop_kernels()


def test_a_self_check_gives_feedback_without_a_network(page, lab):
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    reader.open_notebook(page, lab, "asking.ipynb")
    reader.run_all(page, patience=300)
    feedback = page.locator(".Feedback").first
    for answer, words in (
        ("CAD model", "No CAD model is used."),
        ("one image of the first object", "Yes."),
    ):
        page.locator(".MCButton", has_text=answer).click()
        assert feedback.inner_text().startswith(words)
    page.wait_for_timeout(2000)  # milliseconds: jupyterquiz looks for MathJax after 500
    assert page.evaluate("typeof MathJax") == "object"
    assert asked
    assert not [
        url for url in asked if not url.startswith((lab.url, "ws://127.0.0.1", "data:", "blob:"))
    ]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_its_widgets_react(page, lab, name):
    reader.open_notebook(page, lab, name)
    reader.run_all(page, patience=60 * MINUTES)
    try:
        notebook = reader.saved(page, lab, name)
        wrong = reader.errors(page, notebook)
        assert not wrong
        outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
        widgets = sum(WIDGET in output.get("data", {}) for output in outputs)
        shown = page.locator(
            ".jp-Notebook .jp-OutputArea-output", has=page.locator(".jupyter-widgets")
        )
        assert shown.count() >= widgets, f"{shown.count()} widgets in the page, expected {widgets}"
        moved = [reader.slider_moves_picture(output) for output in reader.slider_outputs(page)]
        assert all(moved), (
            f"which pictures of widgets of {name} changed when their sliders were moved: {moved}"
        )
        if name in LABELLING:
            reader.label_by_clicks(page)
    finally:
        reader.photograph(page, PICTURES / f"{Path(name).stem}.png")


def test_solutions_typed_in_two_notebooks_outlive_their_kernels_and_06_uses_both(page, lab):
    try:
        for count, (name, part) in enumerate((("02", "cycle"), ("04", "unproject")), 1):
            (notebook,) = (path for path in NOTEBOOKS if path.startswith(name))
            first, *rest = SOLUTIONS[part].splitlines()
            leave_a_trace = f'    open("{part}.used", "w").close()'
            lines = ["from zsp_lite.course.your_turn import check", "", first, leave_a_trace]
            reader.open_notebook(page, lab, notebook)
            cell = page.locator(".jp-CodeCell", has_text=f"check({part})")
            cell.locator(".cm-content").click()
            page.keyboard.press("Control+a")
            page.keyboard.insert_text("\n".join([*lines, *rest, f"check({part})"]))
            page.keyboard.press("Control+Enter")
            cell.get_by_text(f"right: {count} of 10 parts are yours").wait_for()
            lab.stop_kernels()
            lab.ask(f"contents/{part}.used", "DELETE")
        reader.open_notebook(page, lab, "mine.ipynb")
        reader.run_all(page, patience=60 * MINUTES)
        assert not reader.errors(page, reader.saved(page, lab, "mine.ipynb"))
        files = {file["name"] for file in lab.ask("contents")["content"]}
        assert {"cycle.used", "unproject.used"} <= files
    finally:
        lab.ask("contents/my_method.py", "DELETE")
