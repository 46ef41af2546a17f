"""Chromium for the tests of this folder."""

import pytest
from lab_in_browser import running_chromium


@pytest.fixture(scope="session")
def browser():
    """A Chromium that all tests share."""
    with running_chromium() as running:
        yield running
