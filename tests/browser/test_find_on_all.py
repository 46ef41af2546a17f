"""The page docs/find_on_all.md in Chromium: it shows the places that the library finds, and a
person can use it."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose
from one_page import SCREENS, build_page, open_page, screen, tab_to, wait_until_drawn
from playwright.sync_api import Browser, Page

from docs.playground.found import CATEGORIES, OBJECTS, RENDERED, ShownObject, shown_object
from zsp_lite import Co3D, load_backbone
from zsp_lite.alignment import Sim3
from zsp_lite.course.synthetic.export import export_categories
from zsp_lite.scans.category import AlignedObject, CategoryAlignment
from zsp_lite.scans.transfer import TransferredPoints, surface_views, transfer

# What the page shows on the second object of every mark of a side of the first.
SHOWN = """() => {
  const { starts, sides } = state.objects[0], picture = sides[state.side], found = [];
  for (let one = starts[picture]; one < starts[picture + 1]; one++) {
    Object.assign(state, { source: 0, mark: one });
    found.push({ ...placeOn(1), marked: placeOn(0).pixel, index: one });
  }
  return found;
}"""


@pytest.fixture(scope="module")
def address(tmp_path_factory) -> str:
    """The address of the page, as a file."""
    folder = build_page("docs/find_on_all", tmp_path_factory.mktemp("site"))
    return (folder / "docs/find_on_all.html").as_uri()


def open_objects(browser: Browser, address: str, **options) -> Page:
    """Open the page and wait until the objects are shown."""
    return open_page(browser, address, "objects", **options)


def choose(page: Page, category: str) -> None:
    """Choose a category, and wait until its objects are shown."""
    page.select_option("#category", category)
    wait_until_drawn(page, "objects")


class Expected(NamedTuple):
    """The library's places, on the second object of a category, of all marks of the first."""

    category: str
    source: ShownObject
    target: ShownObject
    places: TransferredPoints


@pytest.fixture(scope="module", params=CATEGORIES)
def expected(browser, address, tmp_path_factory, request) -> Expected:
    """Two objects of a category of the page, rendered again, in the poses that the page has."""
    category = request.param
    root = tmp_path_factory.mktemp("data")
    export_categories([category], root, 2, **RENDERED)
    dataset = Co3D(root)
    page = open_objects(browser, address)
    choose(page, category)
    objects = page.evaluate("state.objects.map(({ name, pose }) => [name, pose])")
    alignment = CategoryAlignment(
        {
            name: AlignedObject(Sim3.from_matrix(np.array(pose)), np.zeros(3), 1.0, None, 0.0)
            for name, pose in objects[:2]
        },
        (),
    )
    first, second = alignment.objects
    backbone = load_backbone("zsp-tiny", "cpu")
    views = [
        surface_views(alignment, dataset, category, name, backbone) for name in (first, second)
    ]
    directions = [view.direction for view in views[0][::2]]
    source, target = [
        shown_object(dataset, category, name, one, directions)
        for name, one in zip((first, second), views, strict=True)
    ]
    marks = source.surface[: source.starts[-1]]
    return Expected(category, source, target, transfer(marks, *views))


@pytest.fixture(scope="module")
def shown(browser, address) -> Page:
    return open_objects(browser, address)


@pytest.mark.parametrize("side", range(6))
def test_the_page_shows_the_librarys_places(shown, expected, side):
    choose(shown, expected.category)
    shown.fill("#side", str(side))
    marks = shown.evaluate(SHOWN)
    picture = expected.source.sides[side]
    index = np.arange(*expected.source.starts[picture : picture + 2])
    assert [mark["index"] for mark in marks] == index.tolist()

    # The marks are where the picture shows these points.
    def stored(one: ShownObject, points: np.ndarray) -> np.ndarray:
        frame = one.pictures[one.sides[side]]
        return frame.camera.project(points)[0] / frame.camera.size * 254

    marked = [mark["marked"] for mark in marks]
    assert_allclose(marked, stored(expected.source, expected.source.surface[index]), atol=0.51)

    # So are their places, if they are found and not hidden.
    confidence = expected.places.confidence[index]
    assert_allclose([mark["confidence"] / 256 for mark in marks], confidence, atol=0.005)
    nothing = np.array([mark["kind"] == "nothing" for mark in marks])
    # Another processor may round a few values across the threshold, or to another point.
    assert (nothing == (expected.places.confidence[index] < 0.5)).mean() > 0.99
    found = np.array([mark["kind"] == "found" for mark in marks])
    assert found.mean() > 0.3
    places = stored(expected.target, expected.places.world[index])
    pixels = np.array([mark["pixel"] for mark in marks])
    error = abs(pixels[found] - places[found]).max(axis=1)
    assert (error < 0.51).mean() > 0.99


def spot(page: Page, number: int) -> dict | None:
    """Where the mark on an object is on the screen."""
    return page.locator(".picture span").nth(number).bounding_box()


def test_pointing_shows_a_place_where_the_data_have_it(shown):
    choose(shown, CATEGORIES[0])
    marks = [mark for mark in shown.evaluate(SHOWN) if mark["kind"] == "found"][::25]
    boxes = [shown.locator(".picture").nth(i).bounding_box() for i in range(2)]
    for mark in marks:
        at, there = [
            [box["x"] + x / 254 * box["width"], box["y"] + y / 254 * box["width"]]
            for box, (x, y) in zip(boxes, (mark["marked"], mark["pixel"]), strict=True)
        ]
        shown.mouse.move(*at)
        centre = spot(shown, 1)
        middle = [centre["x"] + centre["width"] / 2, centre["y"] + centre["height"] / 2]
        assert_allclose(middle, there, atol=1)


@pytest.fixture(params=SCREENS, ids=str)
def touched(browser, address, request) -> Page:
    """The page on a screen of a width, in a scheme of colours."""
    return open_objects(browser, address, **screen(*request.param))


def test_a_mark_is_held_by_touch_and_moved_by_keyboard(touched):
    assert touched.locator("#objects figure").count() == OBJECTS
    tap = touched.locator(".picture").nth(5).bounding_box()
    touched.touchscreen.tap(tap["x"] + 0.5 * tap["width"], tap["y"] + 0.5 * tap["width"])
    assert "object 6, held" in touched.inner_text("#notice")
    tab_to(touched, "side")
    touched.keyboard.press("Tab")  # to the first object
    place = spot(touched, 0)
    touched.keyboard.press("ArrowUp")
    assert "object 1, held" in touched.inner_text("#notice")
    assert place is None or spot(touched, 0)["y"] < place["y"]
    touched.keyboard.press("Enter")
    assert "object 1:" in touched.inner_text("#notice")


def test_categories_and_sides_are_chosen_by_keyboard(touched):
    pictures = "[...document.querySelectorAll('#objects img')].map((image) => image.src)"
    first = touched.evaluate(pictures)
    tab_to(touched, "side")
    touched.keyboard.press("ArrowRight")
    turned = touched.evaluate(pictures)
    assert not set(first) & set(turned)
    tab_to(touched, "category")
    touched.keyboard.press("ArrowDown")
    touched.wait_for_function("element('category').selectedIndex === 1")
    wait_until_drawn(touched, "objects")
    assert not set(touched.evaluate(pictures)) & {*first, *turned}


def test_the_page_fits_the_screen_and_asks_for_files_alone(touched):
    for category in CATEGORIES:
        choose(touched, category)
        width = touched.evaluate("document.documentElement.scrollWidth")
        assert width <= touched.viewport_size["width"], category
    assert not touched.broken
    assert all(url.startswith(("file:", "data:")) for url in touched.requests)


def test_the_data_are_small():
    files = list(Path("docs/playground/found").glob("*.js"))
    assert sorted(file.stem for file in files) == sorted(CATEGORIES)
    assert sum(file.stat().st_size for file in files) < 4e6
