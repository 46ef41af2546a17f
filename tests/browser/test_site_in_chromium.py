"""The course site in Chromium: pages fit a phone, fields can be read, the class does not see the
presenter's notes."""


def test_no_page_is_wider_than_the_screen_of_a_phone(browser, site):
    page, wide = browser.new_page(viewport={"width": 390, "height": 800}), {}
    for path in sorted(site.rglob("*.html")):
        name = str(path.relative_to(site))
        if "_static" not in path.parts and name != "index.html":  # which leads on to the start page
            page.goto(path.as_uri())
            if (width := page.evaluate("document.documentElement.scrollWidth")) > 390:
                wide[name] = width
    assert not wide


def test_notes_are_shown_in_the_presenters_view_alone(browser, site):
    page = browser.new_page()
    page.goto((site / "docs/slides/lab_2.html").as_uri())
    with page.expect_popup() as opened:
        page.keyboard.press("n")
    presenter = opened.value
    assert "questions on exercise 02, 10 min" in presenter.inner_text("article")
    for key, window in (("ArrowRight", page), ("ArrowRight", presenter)):
        window.keyboard.press(key)
    assert page.inner_text("#place") == presenter.inner_text("header b")
    assert page.inner_text("#place").startswith("3 /")
    assert presenter.locator("article img").count() == 1
    assert "comes close" in presenter.inner_text("article")
    assert "comes close" not in page.inner_text("main")
    page.keyboard.press("ArrowRight")
    assert "equation 3" in presenter.inner_text("article")
    assert "Taken literally" in presenter.inner_text("article")
    assert "equation 3" not in page.inner_text("main")
    assert "Taken literally" not in page.inner_text("main")
