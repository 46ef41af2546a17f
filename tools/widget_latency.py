"""Measure the latency of every widget: `python -m tools.widget_latency [NAME ...]`, from the root of the repository."""

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tools.widget_examples import WIDGETS
from zsp_lite.errors import InputError

if TYPE_CHECKING:
    from ipywidgets import ValueWidget, VBox

LIMIT = 150.0  # milliseconds


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(WIDGETS)), metavar="[NAME]...")
def main(names: tuple[str, ...]) -> None:
    """Print the median time from the move of a control to the redrawn figure, for each control of each widget.

    The value in brackets is the processor time. The exit code is 1 if both exceed 150 ms for any control.
    """
    slow = False
    for name in names or WIDGETS:
        try:
            widget = WIDGETS[name]()
        except InputError as error:
            raise click.UsageError(str(error)) from error
        processor = latency(widget, clock=time.process_time)
        for control, milliseconds in latency(widget).items():
            above = min(milliseconds, processor[control]) > LIMIT
            slow |= above
            verdict = f"above {LIMIT:.0f} ms" if above else ""
            print(f"{name:20} {control:16} {milliseconds:6.0f} ms ({processor[control]:4.0f} ms) {verdict}".rstrip())
    sys.exit(int(slow))


def latency(widget: "VBox", n: int = 9, clock: Callable[[], float] = time.perf_counter) -> dict[str, float]:
    """Measure the median time from a new value of a control to the encoded figure, without the transfer to a browser.

    Args:
        widget: Widget with the attribute `controls`.
        n: Number of moves per control.
        clock: Time in seconds; `time.process_time` ignores other processes.

    Returns:
        Control name to milliseconds.
    """
    medians = {}
    for name, control in widget.controls.items():
        before, times = control.value, []
        for value in control_values(control, n):
            start = clock()
            control.value = value
            times.append(1000 * (clock() - start))
        control.value = before
        medians[name] = float(np.median(times)) if times else 0.0
    return medians


def control_values(control: "ValueWidget", n: int) -> list[Any]:
    """Return about `n` values of a control, spread over its range, such that each changes the control."""
    options = [False, True] if isinstance(control.value, bool) else getattr(control, "options", None)
    if options is not None:
        # Options may be (label, value) pairs.
        options = [option[1] if isinstance(option, tuple) else option for option in options]
    else:
        options = np.linspace(control.min, control.max, n).tolist()
        options = [round(x) if isinstance(control.value, int) else x for x in options]
    values = [options[i % len(options)] for i in range(n)]
    return [value for value, before in zip(values, [control.value, *values]) if value != before]


if __name__ == "__main__":
    main()
