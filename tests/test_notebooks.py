"""What the stored notebooks say of themselves; that they run is nbval's to prove."""

from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_kept_picture_has_a_text_for_those_who_cannot_see_it(path):
    pictures = 0
    for number, cell in enumerate(nbformat.read(path, as_version=4).cells):
        for output in cell.get("outputs", []):
            forms = [form for form in output.get("data", {}) if form.startswith("image/")]
            pictures += bool(forms)
            if "application/vnd.jupyter.widget-view+json" not in output.get("data", {}):
                for form in forms:
                    alt = output["metadata"].get(form, {}).get("alt", "")
                    assert len(alt) > 20, f"cell {number}: a picture without a text"
    assert pictures
