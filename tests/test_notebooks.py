"""What the stored notebooks say of themselves; that they run is nbval's to prove."""

import ast
import re
from functools import cache
from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


@cache
def cells_of(path: Path) -> list[nbformat.NotebookNode]:
    return nbformat.read(path, as_version=4).cells


def code_of(path: Path) -> list[nbformat.NotebookNode]:
    return [cell for cell in cells_of(path) if cell.cell_type == "code"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_kept_picture_has_a_text_for_those_who_cannot_see_it(path):
    pictures = 0
    for number, cell in enumerate(cells_of(path)):
        for output in cell.get("outputs", []):
            forms = [form for form in output.get("data", {}) if form.startswith("image/")]
            pictures += bool(forms)
            if "application/vnd.jupyter.widget-view+json" not in output.get("data", {}):
                for form in forms:
                    alt = output["metadata"].get(form, {}).get("alt", "")
                    assert len(alt) > 20, f"cell {number}: a picture without a text"
    assert pictures


def code_lines(cell) -> list[str]:
    return [line for line in cell.source.splitlines() if line.strip()]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_of_code_are_short(path):
    """Blank lines do not count."""
    cells = code_of(path)
    assert len(code_lines(cells[0])) <= 6, "the first cell of code is longer than 6 lines"
    for cell in cells:
        assert len(code_lines(cell)) <= 15, f"a cell is longer than 15 lines:\n{cell.source}"
        assert max(map(len, code_lines(cell))) <= 88, f"a line is longer than 88 characters:\n{cell.source}"


def drawing_lines(cells: list[str]) -> list[int]:
    """Count in each cell of a notebook the lines on which a call that draws begins.

    Such a call is that of a name imported from matplotlib, plotly or zsp_lite.viz anywhere in the notebook
    (`plots.show_views(...)`), or a method of a figure or of axes by their usual names (`axes[0].imshow(...)`).
    """
    trees = [ast.parse(re.sub(r"^[%!].*", "", source, flags=re.MULTILINE)) for source in cells]
    drawers = {"axes", "axis", "ax", "figure", "fig"}
    for node in (node for tree in trees for node in ast.walk(tree)):
        if isinstance(node, ast.ImportFrom) and re.match(r"matplotlib|plotly|zsp_lite\.viz", node.module):
            drawers |= {alias.asname or alias.name for alias in node.names}
        if isinstance(node, ast.Import):
            drawers |= {alias.asname for alias in node.names if re.match(r"matplotlib|plotly", alias.name)}
    counts = []
    for tree in trees:
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        counts.append(len({call.lineno for call in calls if re.match(r"\w*", ast.unparse(call.func))[0] in drawers}))
    return counts


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_at_most_a_third_of_a_cell_draws(path):
    """A cell may also be one drawing call, with the line that shows it."""
    cells = code_of(path)
    for cell, drawing in zip(cells, drawing_lines([cell.source for cell in cells]), strict=True):
        allowed = max(len(code_lines(cell)) / 3, 2)
        assert drawing <= allowed, f"{drawing} of {len(code_lines(cell))} lines draw:\n{cell.source}"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_marks_for_nbval_are_tags_of_the_cell(path):
    """A comment would be read as part of the lesson."""
    for cell in cells_of(path):
        assert not re.search("nbval", cell.source, re.IGNORECASE), cell.source
        for tag in cell.metadata.get("tags", []):
            assert tag in {"nbval-check-output", "nbval-ignore-output", "nbval-raises-exception", "nbval-skip"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_two_self_checks_and_six_to_ten_questions_with_folded_answers(path):
    cells = cells_of(path)
    checks = [call for cell in cells for call in re.findall(r'self_check\("(\d\d)", (\d)\)', cell.source)]
    assert checks == [(path.stem[:2], "1"), (path.stem[:2], "2")]
    questions = 0
    for text in (cell.source for cell in cells if cell.cell_type == "markdown"):
        asked, *answers = text.split("<details><summary>Answer</summary>")
        for part in [asked, *answers[:-1]] if answers else []:
            assert "?" in part, f"an answer without a question:\n{text}"
        assert text.count("<details") == text.count("</details>") == len(answers)
        questions += text.count("**Predict, then run.**")
        assert text.count("**Predict, then run.**") <= len(answers), f"a question without an answer:\n{text}"
    assert 6 <= questions <= 10


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_its_number_numbered_sections_and_what_was_learnt(path):
    texts = [cell.source for cell in cells_of(path) if cell.cell_type == "markdown"]
    sections = re.findall(r"^##+ (.+)$", "\n\n".join(texts), re.MULTILINE)
    assert texts[0].startswith(f"# {path.stem[:2]} · ")
    assert sections[-1] == "What was learnt" and cells_of(path)[-1].source == texts[-1]
    numbers = [int(number) for number in re.findall(r"^(\d+) · \S", "\n".join(sections), re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1))
