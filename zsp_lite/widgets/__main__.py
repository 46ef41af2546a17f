"""`python -m zsp_lite.widgets [NAME ...]`: median milliseconds from a control's move to the redrawn picture."""

import argparse
import sys

from zsp_lite.errors import InputError
from zsp_lite.widgets import WIDGETS
from zsp_lite.widgets.latency import LIMIT, build_example, measure


def main() -> int:
    """A line for each control of each widget.  Exit code 0: all keep the limit, 1: one does not, 2: bad input."""
    parser = argparse.ArgumentParser(prog="python -m zsp_lite.widgets", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(WIDGETS)}; default: all")
    slow = 0
    try:
        for name in parser.parse_args().names or WIDGETS:
            for control, milliseconds in measure(build_example(name)).items():
                slow += milliseconds > LIMIT
                print(f"{name:24} {control:16} {milliseconds:6.0f} ms", "" if milliseconds <= LIMIT else "too slow")
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return int(slow > 0)


sys.exit(main())
