"""The page docs/find_on_all.md in Chromium: it shows the places that are stored, and a person can
use it. tests/test_playground.py tests that the library finds these."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from one_page import SCREENS, build_page, open_page, screen, tab_to, wait_until_drawn
from playwright.sync_api import Browser, Page
from stored_places import FOLDER, stored_objects

from docs.playground.found import CATEGORIES, HIDDEN, OBJECTS
from zsp_lite.scans.transfer import FOUND

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


@pytest.fixture(scope="module")
def shown(browser, address) -> Page:
    """The page on a screen of the usual size."""
    return open_objects(browser, address)


@pytest.mark.parametrize("side", range(6))
@pytest.mark.parametrize("category", CATEGORIES)
def test_the_page_shows_the_stored_places(shown, category, side):
    choose(shown, category)
    shown.fill("#side", str(side))
    marks = shown.evaluate(SHOWN)
    source, target = stored_objects(category)[:2]
    picture = source["sides"][side]
    index = np.arange(*source["starts"][picture : picture + 2])
    assert [mark["index"] for mark in marks] == index.tolist()
    assert_array_equal([mark["marked"] for mark in marks], source["pixels"][index, picture])
    pixels = target["pixels"][source["places"][1, index], target["sides"][side]]
    assert_array_equal([mark["pixel"] for mark in marks], pixels)
    confidence = source["confidences"][1, index]  # of 256
    hidden = np.where(pixels[:, 0] == HIDDEN, "hidden", "found")
    kinds = np.where(confidence < 256 * FOUND, "nothing", hidden)
    assert [mark["kind"] for mark in marks] == kinds.tolist()
    assert (kinds == "found").mean() > 0.3  # of the marks, so that places are compared


def spot(page: Page, number: int) -> dict | None:
    """Where the mark on an object is on the screen."""
    return page.locator(".picture span").nth(number).bounding_box()


def test_pointing_shows_a_place_where_the_data_have_it(shown):
    choose(shown, CATEGORIES[0])
    marks = [mark for mark in shown.evaluate(SHOWN) if mark["kind"] == "found"][::25]
    boxes = [shown.locator(".picture").nth(i).bounding_box() for i in range(2)]
    for mark in marks:
        at, there = [  # coordinates are stored as 254ths of a picture's side
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
    files = list(FOLDER.glob("*.js"))
    assert sorted(file.stem for file in files) == sorted(CATEGORIES)
    assert sum(file.stat().st_size for file in files) < 4e6  # bytes
