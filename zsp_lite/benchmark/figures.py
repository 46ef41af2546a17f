"""Figures of a run: error distribution, error curves, accuracy against target views, and reliability of confidences."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zsp_lite.benchmark.published import ACCURACIES, TARGETS, VIEWS_FIGURES
from zsp_lite.benchmark.results import Results
from zsp_lite.errors import InputError
from zsp_lite.viz.plots import BLUE, GREEN, ORANGE, VERMILLION
from zsp_lite.viz.reliability import reliability

_VIEWS = (1, 3, 5, 10, 20)
_COLOURS = (BLUE, VERMILLION, GREEN, ORANGE, "#56B4E9", "#CC79A7", "#000000")
_DPI = 150
RIGHT = 30.0  # degrees: a confidence is the probability of an error below this
_LEAST_STATED = 20


def error_distribution(results: Results, row: str = "ours") -> Figure:
    """Draw the rotation error of every pair, one line per category (figure "err_distrib" of the supplement).

    A second cluster near 180 degrees consists of confusions of front and back.
    """
    by_category: dict[str, list[float]] = {}
    for key, error in results.errors(row).items():
        by_category.setdefault(key.split("/")[0], []).append(error)
    categories = sorted(by_category, reverse=True)
    figure, axis = plt.subplots(figsize=(7, 0.9 + 0.32 * len(categories)), layout="constrained")
    jitter = np.random.default_rng(0)
    for height, category in enumerate(categories):
        errors = np.array(by_category[category])
        axis.scatter(errors, height + jitter.uniform(-0.28, 0.28, len(errors)), s=9, alpha=0.55, color=BLUE, lw=0)
        axis.plot([np.median(errors)] * 2, [height - 0.38, height + 0.38], color=VERMILLION, lw=2)
    axis.set_yticks(range(len(categories)), categories)
    axis.set_xticks(range(0, 181, 30))
    axis.set(xlim=(-3, 183), ylim=(-0.6, len(categories) - 0.4), xlabel="rotation error (degrees)")
    axis.set_title(f'Errors of "{row}" by category; the bar is the median', fontsize=10)
    axis.grid(axis="x", alpha=0.3)
    return figure


def accuracy_against_views(results: Results) -> Figure:
    """Draw Acc30 and Acc15 against the number of target views, with 95 % intervals.

    The results that the paper published for CO3D are dotted grey; those of the verified solver are dashed.
    """
    methods, views = results.summary["methods"], results.summary["data"]["targets"]
    lines = []
    for label, row, published, style, colour in (
        ("full method", "ours", "full", "o-", BLUE),
        ("best view only", "ours-bv", "best view", "s-", GREEN),
        ("verified solver", "verified", "", "D--", VERMILLION),
    ):
        found = {n: methods.get(f"{row}-n{n}") or (methods.get(row) if n == views else None) for n in _VIEWS}
        found = {n: one for n, one in found.items() if one is not None}
        if published or len(found) > 1:
            lines.append((found, published, style, {"color": colour, "label": label}))
    if max(len(found) for found, published, *_ in lines if published) < 2:
        raise InputError("accuracy against views: the run has fewer than two numbers of target views")
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharex=True)
    for axis, name, title in zip(axes, ("acc30", "acc15"), ACCURACIES, strict=True):
        for found, published, style, look in lines:
            ends = np.array([one[f"{name}_ci"] for one in found.values()]).reshape(-1, 2)
            axis.fill_between(list(found), *ends.T, color=look["color"], alpha=0.18, lw=0)
            axis.plot(list(found), [one[name] for one in found.values()], style, **look)
            if published:
                column = 2 + VIEWS_FIGURES.index(f"{published}: {title}")  # after the names of the rows
                values, label = [TARGETS[str(n)][column] for n in _VIEWS], f"{look['label']}, published on CO3D"
                axis.plot(_VIEWS, values, ":", marker="s", ms=3, color="0.55", label=label)
        axis.set(xlabel="target views N", ylabel=title, xticks=_VIEWS, ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    return figure


def error_curves(results: Results, rows: Sequence[str] | None = None) -> Figure:
    """Draw the cumulative distribution of the errors, one line per row; by default for the first seven rows."""
    names = list(rows or list(results.summary["methods"])[: len(_COLOURS)])
    figure, axis = plt.subplots(figsize=(6.5, 4), layout="constrained")
    for index, name in enumerate(names):
        errors = np.sort(list(results.errors(name).values()))
        share = 100 * np.arange(len(errors) + 1) / len(errors)
        style = {"color": _COLOURS[index % len(_COLOURS)], "ls": ("-", "--", "-.", ":")[index % 4]}
        axis.step(np.concatenate([[0], errors]), share, where="post", label=name, **style)
    for threshold in (15, 30):
        axis.axvline(threshold, color="0.7", lw=1, zorder=0)
    axis.set(xlim=(0, 180), ylim=(0, 100), xticks=range(0, 181, 30))
    axis.set(xlabel="rotation error (degrees)", ylabel="pairs with at most this error (%)")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower right")
    return figure


def reliability_diagram(results: Results) -> Figure:
    """Draw a reliability diagram and a histogram of the confidences of the first row that states enough of them.

    The diagram shows the fraction of errors below 30 degrees against the mean confidence, in ten bins of equal size.
    """
    names = dict.fromkeys([*results.summary.get("methods", ()), *results.rows])  # in the order of the run
    row = next((name for name in names if len(results.confidences(name)) >= _LEAST_STATED), None)
    if row is None:
        raise InputError(f"reliability: no row has {_LEAST_STATED} confidences")
    errors, stated = results.errors(row), results.confidences(row)
    confidence = np.array(list(stated.values()))
    right = np.array([errors[key] < RIGHT for key in stated])
    found = reliability(confidence, right, min(10, len(right) // 5))
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(5, 5.6), layout="constrained", sharex=True, height_ratios=[3, 1]
    )
    spread = np.sqrt(found.accuracy * (1 - found.accuracy) / found.count)
    above.plot([0, 1], [0, 1], ":", color="0.5", label="calibrated")
    above.errorbar(found.confidence, found.accuracy, spread, fmt="o-", color=BLUE, capsize=2, ms=4, label=f'"{row}"')
    above.set(ylim=(-0.02, 1.05), ylabel="fraction within 30°")
    above.set_title(
        f"AUROC {found.auroc:.2f}, calibration error {100 * found.calibration_error:.1f} points,\n"
        f"more confident half {100 * found.top_half_accuracy:.0f} % correct (all: {100 * right.mean():.0f} %)",
        fontsize=10,
    )
    above.legend(fontsize=8, loc="upper left")
    look = {"color": [BLUE, ORANGE], "label": ["correct", "wrong"]}
    below.hist([confidence[right], confidence[~right]], bins=np.linspace(0, 1, 21), stacked=True, **look)
    for patch in below.containers[1].patches:
        patch.set_hatch("///")
    below.set(xlim=(-0.02, 1.02), xlabel="confidence", ylabel="pairs")
    below.legend(fontsize=8, loc="upper left")
    for axis in (above, below):
        axis.grid(alpha=0.3)
    return figure


def write_figures(results: Results, folder: str | Path) -> list[Path]:
    """Write the figures for which the run has rows as PNG files; returns their paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    first = "ours" if "ours" in results.rows else next(iter(results.rows))
    makers = {
        "error_distribution": lambda: error_distribution(results, first),
        "accuracy_against_views": lambda: accuracy_against_views(results),
        "error_curves": lambda: error_curves(results),
        "reliability": lambda: reliability_diagram(results),
    }
    written = []
    for name, make in makers.items():
        path = folder / f"{name}.png"
        with plt.rc_context({"text.parse_math": False}):  # names of rows and categories are no TeX
            try:
                figure = make()
            except InputError:  # the run has no rows for this figure
                continue
            figure.savefig(path, dpi=_DPI)
        plt.close(figure)
        written.append(path)
    return written
