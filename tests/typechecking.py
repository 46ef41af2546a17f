"""The checker of annotations.

It is looked up by the name of its module, and `conftest` is the name of two.
"""

from beartype import BeartypeConf, beartype

typechecker = beartype(conf=BeartypeConf(is_pep484_tower=True))  # accepts an int for a float
