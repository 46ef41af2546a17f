"""How long a widget takes from a control's move to the new picture."""

import importlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from zsp_lite.errors import InputError
from zsp_lite.widgets import WIDGETS

if TYPE_CHECKING:
    from ipywidgets import ValueWidget, VBox

LIMIT = 150.0  # milliseconds, at the median


def build_example(name: str) -> "VBox":
    """The widget `name` of `WIDGETS` on sample data.  Raises InputError where there is none of that name."""
    if name not in WIDGETS:
        raise InputError(f"widget is {name!r}, expected one of {', '.join(WIDGETS)}")
    module, function = WIDGETS[name].split(":")
    return getattr(importlib.import_module(f"zsp_lite.widgets.{module}"), function)()


def moves(control: "ValueWidget", n: int) -> list[Any]:
    """`n` positions spread over a slider, or a menu's options in turn; no two that follow each other are equal."""
    options = [False, True] if isinstance(control.value, bool) else getattr(control, "options", None)
    if options is not None:
        # Options may be (label, value) pairs.
        options = [option[1] if isinstance(option, tuple) else option for option in options]
    else:
        options = np.linspace(control.min, control.max, n).tolist()
        options = [round(x) if isinstance(control.value, int) else x for x in options]
    positions = [options[i % len(options)] for i in range(n)]
    return [x for x, before in zip(positions, [control.value, *positions]) if x != before]


def measure(widget: "VBox", n: int = 9, clock: Callable[[], float] = time.perf_counter) -> dict[str, float]:
    """Median milliseconds of about `n` moves of each control, by the control's name; all are put back afterwards.

    Measured from the new value to the encoded picture, as the kernel does it; the way to the browser is not in it.
    clock: in seconds; `time.process_time` counts this process's work alone, on a machine that is busy with others'.
    """
    medians = {}
    for name, control in widget.controls.items():
        before, taken = control.value, []
        for position in moves(control, n):
            start = clock()
            control.value = position
            taken.append(1000 * (clock() - start))
        control.value = before
        medians[name] = float(np.median(taken)) if taken else 0.0
    return medians
