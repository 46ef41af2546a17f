"""Every test runs with the library's annotations checked: shapes by jaxtyping, types by beartype."""

import contextlib
import os
from functools import wraps

import pytest
from beartype import BeartypeConf, beartype
from jaxtyping import config, install_import_hook

os.environ.setdefault("MPLBACKEND", "Agg")  # figures are drawn, never shown

# An int is fine where a float is asked for.
typechecker = beartype(conf=BeartypeConf(is_pep484_tower=True))
# Has to stand before the first import of zsp_lite; outside the tests nothing is checked.
install_import_hook("zsp_lite", f"{__name__}.typechecker")

from zsp_lite.errors import InputError  # noqa: E402

_raises = pytest.raises


@contextlib.contextmanager
def _unchecked(expectation):
    config.update("jaxtyping_disable", True)
    try:
        with expectation as caught:
            yield caught
    finally:
        config.update("jaxtyping_disable", False)


@wraps(_raises)
def raises(expected, *args, **kwargs):
    """`pytest.raises`, but inside `raises(InputError)` annotations are not checked.

    Bad input breaks the annotations by its nature; the subject there is the library's own refusal.
    """
    expectation = _raises(expected, *args, **kwargs)
    if expected is InputError and not args:
        return _unchecked(expectation)
    return expectation


pytest.raises = raises
