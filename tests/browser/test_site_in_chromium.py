"""The course site in Chromium: pages fit a phone, the worksheet one sheet, and the class does not
see the presenter's notes."""

import pytest


def test_no_page_is_wider_than_the_screen_of_a_phone(browser, site):
    screen = 390  # pixels
    page = browser.new_page(viewport={"width": screen, "height": 800})
    wide = {}
    for path in sorted(site.rglob("*.html")):
        name = str(path.relative_to(site))
        # index.html leads on to the start page.
        if "_static" not in path.parts and name != "index.html":
            page.goto(path.as_uri())
            width = page.evaluate("document.documentElement.scrollWidth")
            if width > screen:
                wide[name] = width
    assert wide == {}


def test_the_worksheet_prints_on_one_page(browser, site):
    page = browser.new_page()
    page.goto((site / "notebooks/exercises/worksheet_06.html").as_uri())
    assert page.pdf(format="A4").count(b"/Type /Page\n") == 1


@pytest.fixture
def windows(browser, site):
    """The window of a lab's slides that the class sees, and the presenter's window."""
    page = browser.new_page()
    page.goto((site / "docs/slides/lab_2.html").as_uri())
    with page.expect_popup() as opened:
        page.keyboard.press("n")
    return page, opened.value


def test_the_keys_of_both_windows_turn_the_slides_of_both(windows):
    page, presenter = windows
    assert "questions on exercise 02, 10 min" in presenter.inner_text("article")
    page.keyboard.press("ArrowRight")
    presenter.keyboard.press("ArrowRight")
    assert page.inner_text("#place").startswith("3 /")
    assert presenter.inner_text("header b") == page.inner_text("#place")
    assert presenter.locator("article img").count() == 1


def test_notes_are_shown_in_the_presenters_view_alone(windows):
    page, presenter = windows
    page.keyboard.press("ArrowRight")
    # Parts of the notes on slides 3 and 4.
    for notes in (["Let the class order"], ["equation 3", "Taken literally"]):
        page.keyboard.press("ArrowRight")
        for note in notes:
            assert note in presenter.inner_text("article")
            assert note not in page.inner_text("main")
