"""The one error that bad input raises."""


class InputError(ValueError):
    """Something the caller gave cannot be used: one line that names it, what came and what was expected.

    The command line turns it into that line on stderr and exit code 2; every
    other exception is a bug and shows its traceback.
    """
