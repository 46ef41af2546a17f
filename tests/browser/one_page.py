"""One page of the course site: building it, opening it on a screen, using it by keyboard."""

import subprocess
import sys
from pathlib import Path

import pytest
from lab_in_browser import REPOSITORY
from playwright.sync_api import Browser, Page

# Widths in pixels, and schemes of colours.
SCREENS = [(width, scheme) for width in (1280, 390) for scheme in ("light", "dark")]


def build_page(name: str, folder: Path) -> Path:
    """Build a site with one page, by its path without extension, and return its folder."""
    only = f"-D include_patterns={name}.md -D root_doc={name}".split()
    options = ["-q", "-c", "docs/site", "-d", folder / "doctrees", *only]
    command = [sys.executable, "-m", "sphinx", *options, ".", folder]
    # Sphinx warns of links to other pages, which this site does not have.
    subprocess.run(command, cwd=REPOSITORY, check=True, stderr=subprocess.DEVNULL)
    return folder


def open_page(browser: Browser, address: str, busy: str, **options) -> Page:
    """Open a page and wait until an element is not busy; `broken` collects the page's errors, and
    `requests` the addresses that it asks for."""
    page = browser.new_context(**options).new_page()
    page.set_default_timeout(180_000)  # milliseconds, for a busy machine
    page.broken = []
    page.requests = []
    page.on("pageerror", lambda error: page.broken.append(str(error)))
    page.on("request", lambda request: page.requests.append(request.url))
    page.goto(address)
    wait_until_drawn(page, busy)
    return page


def wait_until_drawn(page: Page, busy: str) -> None:
    """Wait until an element is not busy."""
    state = f"document.getElementById('{busy}').getAttribute('aria-busy')"
    page.wait_for_function(f"{state} === 'false'")


def screen(width: int, scheme: str) -> dict:
    """Options of `open_page` for one of the `SCREENS`."""
    viewport = {"width": width, "height": 900}
    return {"viewport": viewport, "color_scheme": scheme, "has_touch": True}


def tab_to(page: Page, name: str) -> None:
    """Press Tab until an element has the focus."""
    for _ in range(60):  # The page has fewer elements.
        if page.evaluate("document.activeElement.id") == name:
            return
        page.keyboard.press("Tab")
    pytest.fail(f"{name} is not reached by the keyboard")
