"""The drawings of the course: as the script makes them, legible, described, and one for each notebook."""

import re
from pathlib import Path
from xml.etree import ElementTree

import matplotlib
import nbformat
import numpy as np
import pytest
from PIL import ImageFont

from tools import drawings

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
FONT = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"  # wider than what most browsers take
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def stored() -> dict[str, ElementTree.Element]:
    return {path.stem: ElementTree.parse(path).getroot() for path in sorted(drawings.FOLDER.glob("*.svg"))}


def texts(root: ElementTree.Element) -> list[tuple[str, np.ndarray]]:
    """All texts of a drawing with their boxes: left, top, right, bottom."""
    found = []

    def visit(element: ElementTree.Element, shift: np.ndarray, scale: float) -> None:
        if transform := element.get("transform"):
            (x, y), *factor = re.findall(r"translate\((\S+) (\S+)\)", transform) + re.findall(
                r"scale\((\S+)\)", transform
            )
            shift = shift + scale * np.array([float(x), float(y)])
            scale *= float(factor[0]) if factor else 1
        if element.tag == f"{SVG}text":
            size = float(element.get("font-size"))
            words = "".join(element.itertext())
            wide = ImageFont.truetype(str(FONT), 100).getlength(words) * size / 100
            left = float(element.get("x")) - wide * {None: 0, "middle": 0.5, "end": 1}[element.get("text-anchor")]
            base = float(element.get("y"))
            found.append((words, np.tile(shift, 2) + scale * np.array([left, base - 0.75 * size, left + wide, base])))
        for child in element:
            visit(child, shift, scale)

    visit(root, np.zeros(2), 1.0)
    return found


def test_the_stored_drawings_are_those_of_the_script():
    assert {path.stem for path in drawings.FOLDER.iterdir()} == set(drawings.DRAWINGS)
    for name, draw in drawings.DRAWINGS.items():
        assert (drawings.FOLDER / f"{name}.svg").read_text(encoding="utf-8") == draw(), name


def test_every_notebook_has_its_place_in_the_method(stored):
    assert {path.stem[:2] for path in NOTEBOOKS} == set(drawings.HERE)
    for number in drawings.HERE:
        shown = [words for words, _ in texts(stored[f"here_{number}"])]
        assert sum(words.startswith("you are here") for words in shown) == 1


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_opens_with_its_place_in_the_method(path):
    title, picture = nbformat.read(path, as_version=4).cells[0].source.split("\n\n")[:2]
    assert title.startswith("# ") and re.fullmatch(rf"!\[[^]]{{20,}}\]\(figures/here_{path.stem[:2]}\.svg\)", picture)


def test_no_text_is_small_leaves_its_drawing_or_covers_another(stored):
    for name, root in stored.items():
        width, height = float(root.get("width")), float(root.get("height"))
        found = texts(root)
        for i, (words, (left, top, right, bottom)) in enumerate(found):
            assert left >= 2 and top >= 2 and right <= width - 2 and bottom <= height - 2, f"{name}: {words}"
            for others, (a, b, c, d) in found[:i]:
                apart = right <= a or c <= left or bottom <= b or d <= top
                assert apart, f"{name}: {words!r} covers {others!r}"
        sizes = [float(element.get("font-size")) for element in root.iter(f"{SVG}text")]
        assert min(sizes) >= 13, name


def test_every_drawing_is_described_and_needs_nothing_from_elsewhere(stored):
    for name, root in stored.items():
        title, description = root.find(f"{SVG}title").text, root.find(f"{SVG}desc").text
        assert len(title) > 3 and len(description) > 60, name
        assert not {f"{SVG}image", f"{SVG}use", f"{SVG}style"} & {element.tag for element in root.iter()}, name
