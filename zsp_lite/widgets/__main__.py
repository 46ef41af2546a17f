"""`python -m zsp_lite.widgets [NAME ...]`: median milliseconds from a control's move to the redrawn picture.

In brackets the processor time of it: below the other where the machine was busy with other things, above it where
several cores worked. The smaller of the two is held against the limit.
"""

import argparse
import sys
import time

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
            widget = build_example(name)
            work = measure(widget, clock=time.process_time)
            for control, milliseconds in measure(widget).items():
                late = min(milliseconds, work[control]) > LIMIT
                slow += late
                verdict = f"above {LIMIT:.0f} ms" if late else ""
                print(
                    f"{name:20} {control:16} {milliseconds:6.0f} ms ({work[control]:4.0f} ms) {verdict}".rstrip(),
                    flush=True,
                )
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return int(slow > 0)


sys.exit(main())
