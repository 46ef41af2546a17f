"""The check that most tests of bad input make."""

import pytest

from zsp_lite import InputError


def refused(message: str, call, /, *arguments, error=InputError, **options) -> str:
    """Check that a call raises an error with one line in which a pattern is found; returns the
    line."""
    with pytest.raises(error, match=message) as caught:
        call(*arguments, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)
