"""The checker of annotations.

A module of its own, since tests/ and tests/browser/ both have a `conftest`: an import of that name
would be ambiguous.
"""

from beartype import BeartypeConf, beartype

typechecker = beartype(conf=BeartypeConf(is_pep484_tower=True))  # accepts an int for a float
