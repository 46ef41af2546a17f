"""Figures of a run: errors of every pair, error curves, and accuracy against the number of target views."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zsp_lite.benchmark.methods import read_paper_tables
from zsp_lite.benchmark.runs import Run
from zsp_lite.benchmark.tables import important_rows, library_row, own_rows, row_name
from zsp_lite.choices import METRICS
from zsp_lite.viz.plots import COLOURS, show_dots, show_panels


def error_distribution(run: Run, row: str = "ours") -> Figure:
    """Draw the rotation error of every pair, one line per category (figure "err_distrib" of the supplement).

    A second cluster near 180 degrees consists of confusions of front and back.
    """
    groups = {str(name): errors for name, errors in run.row(row).groupby("category")["error"]}
    labels = {"xlabel": "rotation error (degrees)", "xlim": (-3, 183), "xticks": range(0, 181, 30)}
    return show_dots({row: groups}, title=f'Errors of "{row}" by category; the bar is the median', **labels)


def error_curves(run: Run, rows: Sequence[str] | None = None) -> Figure:
    """Draw the cumulative distribution of the errors, one line per row; by default of the most important rows."""
    curves = {}
    for name in rows or important_rows(run.summary)[: len(COLOURS)]:
        errors = np.sort(run.row(name)["error"])
        shares = 100 * np.arange(len(errors) + 1) / len(errors)
        curves[name] = np.repeat([0, *errors], 2)[1:], np.repeat(shares, 2)[:-1]  # a step at every error
    labels = {"xlabel": "rotation error (degrees)", "ylabel": "pairs with at most this error (%)"}
    labels |= {"xlim": (0, 180), "ylim": (0, 100), "xticks": (0, 15, 30, 60, 90, 120, 150, 180)}
    return show_panels({"": curves}, size=(6.5, 4), **labels)


def accuracy_against_views(run: Run) -> Figure:
    """Draw Acc30 and Acc15 of rows that the run has at several numbers of target views, with 95 % intervals.

    The results that the paper published for CO3D are grey.
    """
    published = {line["row"]: line["published"] for spec in read_paper_tables() for line in spec["rows"]}
    numbers, methods, drawn = (1, 3, 5, 10, 20), run.summary["methods"], {}
    for name in dict.fromkeys(map(library_row, important_rows(run.summary))):
        rows = {n: methods.get(row_name(f"{name}-n{n}", run.summary)) for n in numbers}
        drawn[name] = {n: row for n, row in rows.items() if row}
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharex=True)
    for place, (axis, metric) in enumerate(zip(axes, ("acc30", "acc15"), strict=True)):
        several = ((name, rows) for name, rows in drawn.items() if len(rows) > 1)
        for (name, rows), colour, marker in zip(several, COLOURS, cycle("os^Dv")):
            low, high = zip(*(one[f"{metric}_ci"] for one in rows.values()))
            axis.fill_between(list(rows), low, high, color=colour, alpha=0.18, lw=0)
            axis.plot(list(rows), [one[metric] for one in rows.values()], f"{marker}-", color=colour, label=name)
        for name, look in (("ours-bv", "s:"), ("ours", "o--")):
            values = [published[f"{name}-n{n}"][place - 2] for n in numbers]  # the last two are Acc30 and Acc15
            axis.plot(numbers, values, look, ms=3, color="0.55", label=f"{name}, published on CO3D")
        axis.set(xlabel="target views N", ylabel=METRICS[metric], xticks=numbers, ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    return figure


def write_figures(run: Run, folder: str | Path) -> None:
    """Write the errors of the first row by category, and the error curves, as PDF and PNG files."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    first = [*own_rows(run.summary), *important_rows(run.summary)][0]
    with plt.rc_context({"text.parse_math": False}):  # names of rows and categories are no TeX
        figures = {"error_distribution": error_distribution(run, first), "error_curves": error_curves(run)}
        for name, figure in figures.items():
            figure.savefig(Path(folder) / f"{name}.pdf", metadata={"CreationDate": None})
            figure.savefig(Path(folder) / f"{name}.png", dpi=150)
            plt.close(figure)
