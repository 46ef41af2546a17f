"""The course site in Chromium: pages fit the screen, the start page shows how to begin, the
worksheet prints on one page, the class does not see the presenter's notes."""

import pytest

# Widths and heights of a phone and of a projector, in pixels.
SCREENS = [(390, 844), (1280, 720)]
SLIDE = "section:not([hidden])"  # the slide that a window shows


@pytest.mark.parametrize("width, height", SCREENS)
def test_no_page_is_wider_than_the_screen(browser, site, width, height):
    page = browser.new_page(viewport={"width": width, "height": height})
    wide = {}
    for path in sorted(site.rglob("*.html")):
        name = str(path.relative_to(site))
        # index.html leads on to the start page.
        if "_static" not in path.parts and name != "index.html":
            page.goto(path.as_uri())
            needed = page.evaluate("document.documentElement.scrollWidth")
            if needed > width:
                wide[name] = needed
    assert wide == {}


def test_the_worksheet_prints_on_one_page(browser, site):
    page = browser.new_page()
    page.goto((site / "notebooks/exercises/worksheet_06.html").as_uri())
    assert page.pdf(format="A4").count(b"/Type /Page\n") == 1


@pytest.mark.parametrize("width, height", SCREENS)
def test_the_start_page_shows_its_picture_and_three_ways_to_begin_at_once(
    browser, site, width, height
):
    page = browser.new_page(viewport={"width": width, "height": height})
    page.goto((site / "docs/index.html").as_uri())
    shown = [part.bounding_box() for part in page.locator("article img, article li").all()]
    assert len(shown) == 4
    assert max(box["y"] + box["height"] for box in shown) <= height


@pytest.fixture
def windows(browser, site):
    """The window of a lab's slides that the class sees, and the presenter's window."""
    page = browser.new_page()
    page.goto((site / "docs/slides/lab_2.html").as_uri())
    with page.expect_popup() as opened:
        page.keyboard.press("n")
    opened.value.wait_for_load_state()
    return page, opened.value


def test_the_keys_of_both_windows_turn_the_slides_of_both(windows):
    page, presenter = windows
    assert "questions on exercise 02, 10 min" in presenter.inner_text(SLIDE)
    page.keyboard.press("ArrowRight")
    presenter.get_by_text("2 /").wait_for()
    presenter.keyboard.press("ArrowRight")
    page.get_by_text("3 /").wait_for()
    assert presenter.locator(f"{SLIDE} img").count() == 1


def test_notes_are_shown_in_the_presenters_view_alone(windows):
    page, presenter = windows
    page.keyboard.press("ArrowRight")
    # Parts of the notes on slides 3 and 4.
    for notes in (["Let the class order"], ["equation 3", "Taken literally"]):
        page.keyboard.press("ArrowRight")
        for note in notes:
            presenter.get_by_text(note).wait_for()
            assert note not in page.inner_text("main")
        box = presenter.locator(f"{SLIDE} .notes").bounding_box()
        assert box["y"] + box["height"] < presenter.evaluate("innerHeight")


def test_the_clouds_of_a_lesson_turn_together(browser, site):
    page = browser.new_page()
    page.goto((site / "notebooks/00_quickstart.html").as_uri())
    clouds = page.locator(".zsp-turning canvas")
    place = "cloud => cloud.pointOnCanvas(0)[0]"
    places = {clouds.last.evaluate(place)}
    clouds.first.drag_to(clouds.first, target_position={"x": 50, "y": 90})
    places.add(clouds.last.evaluate(place))
    clouds.last.press("ArrowRight")
    # The last cloud has turned with the first one, and the first with the last.
    assert len(places | {clouds.first.evaluate(place)}) == 3
