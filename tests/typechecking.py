"""The checker of annotations.

A module of its own, since tests/ and tests/browser/ both have a `conftest`: an import of that name
would be ambiguous.
"""

from collections import Counter
from functools import wraps

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping import config

typechecker = beartype(conf=BeartypeConf(is_pep484_tower=True))  # accepts an int for a float
calls = Counter()  # of each function in the present test file
_MOST = 5
_jaxtyped = jaxtyping.jaxtyped


def first_calls(*, typechecker):
    """Check the first calls of a function in each test file: to check all would take a third of the
    tests' time."""

    def decorate(function):
        if isinstance(function, type):
            return _jaxtyped(function, typechecker=typechecker)
        checked = None
        name = function.__module__, function.__qualname__

        @wraps(function)
        def either(*args, **kwargs):
            nonlocal checked
            if config.jaxtyping_disable or calls[name] >= _MOST:
                return function(*args, **kwargs)
            calls[name] += 1
            checked = checked or _jaxtyped(function, typechecker=typechecker)
            return checked(*args, **kwargs)

        return either

    return decorate
