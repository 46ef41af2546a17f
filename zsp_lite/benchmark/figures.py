"""Figures of a run: errors of every pair, error curves, and accuracy against the number of target views."""

import re
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zsp_lite.benchmark.runs import Run
from zsp_lite.benchmark.tables import own_rows, read_paper_tables
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
    """Draw the cumulative distribution of the errors, one line per row; by default of seven, first one's own."""
    names = list(rows or dict.fromkeys([*own_rows(run.summary), *run.summary["methods"]]))[: len(COLOURS)]
    curves = {}
    for name in names:
        errors = np.sort(run.row(name)["error"])
        shares = 100 * np.arange(len(errors) + 1) / len(errors)
        curves[name] = np.repeat([0, *errors], 2)[1:], np.repeat(shares, 2)[:-1]  # a step at every error
    labels = {"xlabel": "rotation error (degrees)", "ylabel": "pairs with at most this error (%)"}
    labels |= {"xlim": (0, 180), "ylim": (0, 100), "xticks": (0, 15, 30, 60, 90, 120, 150, 180)}
    return show_panels({"": curves}, size=(6.5, 4), **labels)


def accuracy_against_views(run: Run) -> Figure | None:
    """Draw Acc30 and Acc15 against the number of target views, with 95 % intervals; None without two numbers of views.

    The results that the paper published for CO3D are grey.
    """
    methods, views = run.summary["methods"], run.summary["data"]["targets"]
    published = next(one["rows"] for one in read_paper_tables() if one["name"] == "table_a_targets")
    numbers = [int(line["label"].rpartition(" ")[2]) for line in published]
    names = dict.fromkeys(re.sub(r"-n\d+$", "", name) for name in own_rows(run.summary))
    drawn = {
        row: {n: methods.get(f"{row}-n{n}") or (methods.get(row) if n == views else None) for n in numbers}
        for row in ("ours", "ours-bv", "verified", *names)
    }
    drawn = {row: {n: one for n, one in found.items() if one} for row, found in drawn.items()}
    drawn = {row: found for row, found in drawn.items() if len(found) > 1}
    if not drawn:
        return None
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharex=True)
    for place, (axis, metric) in enumerate(zip(axes, ("acc30", "acc15"), strict=True)):
        for index, (row, found) in enumerate(drawn.items()):
            colour, ends = COLOURS[index % len(COLOURS)], np.array([one[f"{metric}_ci"] for one in found.values()])
            axis.fill_between(list(found), *ends.T, color=colour, alpha=0.18, lw=0)
            values = [one[metric] for one in found.values()]
            axis.plot(list(found), values, "os^Dv"[index % 5] + "-", color=colour, label=row)
        # the published columns: Acc30 and Acc15 of each
        for first, row, look in ((0, "ours-bv", "s:"), (2, "ours", "o--")):
            values = [line["published"][first + place] for line in published]
            axis.plot(numbers, values, look, ms=3, color="0.55", label=f"{row}, published on CO3D")
        axis.set(xlabel="target views N", ylabel=METRICS[metric], xticks=numbers, ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    return figure


def write_figures(run: Run, folder: str | Path) -> None:
    """Write the figures for which the run has rows as PDF and PNG files."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    methods = run.summary["methods"]
    first = [*own_rows(run.summary), *(["ours"] if "ours" in methods else methods)][0]
    with plt.rc_context({"text.parse_math": False}):  # names of rows and categories are no TeX
        figures = {
            "error_distribution": error_distribution(run, first),
            "error_curves": error_curves(run),
            "accuracy_against_views": accuracy_against_views(run),
        }
        for name, figure in figures.items():
            if figure is not None:
                figure.savefig(Path(folder) / f"{name}.pdf", metadata={"CreationDate": None})
                figure.savefig(Path(folder) / f"{name}.png", dpi=150)
                plt.close(figure)
