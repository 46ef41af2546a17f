"""The checker of annotations.

A module of its own, since tests/ and tests/browser/ both have a `conftest`: an import of that name
would be ambiguous.
"""

from collections import Counter
from functools import wraps

import jaxtyping
from beartype import BeartypeConf, beartype

typechecker = beartype(conf=BeartypeConf(is_pep484_tower=True))  # accepts an int for a float
calls = Counter()  # of each function in the present file
_MOST = 5
_jaxtyped = jaxtyping.jaxtyped


def first_calls(*, typechecker):
    """Check the first calls of a function in each file: all would take a third of the time."""

    def decorate(function):
        if isinstance(function, type):
            return _jaxtyped(function, typechecker=typechecker)
        checked = None
        name = function.__module__, function.__qualname__

        @wraps(function)
        def either(*args, **kwargs):
            nonlocal checked
            calls[name] += 1
            if calls[name] > _MOST:
                return function(*args, **kwargs)
            checked = checked or _jaxtyped(function, typechecker=typechecker)
            return checked(*args, **kwargs)

        return either

    return decorate
