"""What the stored notebooks say of themselves; that they run is nbval's to prove."""

import re
from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def cells_of(path: Path) -> list[nbformat.NotebookNode]:
    return nbformat.read(path, as_version=4).cells


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
def test_cells_of_code_are_short_and_at_most_a_third_of_a_cell_draws(path):
    """Blank lines do not count. A cell may also be one drawing call, with the line that shows it."""
    cells = [cell for cell in cells_of(path) if cell.cell_type == "code"]
    imports = re.findall(r"from (?:matplotlib|plotly|zsp_lite\.viz)\S* import (.+)", "\n".join(c.source for c in cells))
    drawers = "|".join(["plt", "axes", "axis", "ax", "figure", "fig", *re.findall(r"\w+(?=,|$)", ",".join(imports))])
    assert len(code_lines(cells[0])) <= 6, "the first cell of code is longer than 6 lines"
    for cell in cells:
        lines = code_lines(cell)
        assert len(lines) <= 15, f"a cell is longer than 15 lines:\n{cell.source}"
        assert max(map(len, lines)) <= 88, f"a line is longer than 88 characters:\n{cell.source}"
        drawing = [line for line in lines if re.search(rf"\b(?:{drawers})(?:[.\[][^ (]*)?\(", line)]
        assert len(drawing) <= max(len(lines) / 3, 2), f"{len(drawing)} of {len(lines)} lines draw:\n{cell.source}"
