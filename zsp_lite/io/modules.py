"""Import of objects of the user's own."""

import os
import pkgutil
import sys
from contextlib import chdir
from typing import Any

from zsp_lite.errors import InputError, describe_failure


def import_object(path: str) -> Any:
    """Import "module:name", of an installed module or one in the current folder."""
    if "" not in sys.path and os.getcwd() not in sys.path:
        # The module path of a console script lacks the current folder.
        sys.path.append(os.getcwd())
    try:
        with chdir("."):  # returns to the current folder if the module leaves it
            return pkgutil.resolve_name(path)
    except (Exception, SystemExit) as error:  # a module may raise anything
        raise InputError(f"{path!r} cannot be imported: {describe_failure(error)}") from error
