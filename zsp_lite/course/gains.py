"""What each part of the method gains: the accuracy of a row of the benchmark with it, minus that of
a row without it, on the same pairs."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from zsp_lite.benchmark.methods import read_paper_tables
from zsp_lite.benchmark.summary import draws_of, paired_difference
from zsp_lite.viz import plots
from zsp_lite.viz.reliability import reliability

# For each section and part of the method: the row with the part, and the row without it.
PARTS = json.loads(Path(__file__).with_suffix(".json").read_text("utf-8"))


def gains(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Compute the gains in accuracy within 30 degrees (Acc30), in points.

    Args:
        runs: the tables of runs (`read_run(OUT).table`) by name.

    Returns:
        A line for each section and part; a column for each run, with the gain and the ends of its
        95 % interval (objects and seeds are drawn again); and "paper", with its gain on CO3D.
    """
    # Where several of the paper's tables have a row, its figure is the same in all.
    published = {}
    for table in read_paper_tables():
        if "Acc30 (%)" in table["published"]:
            column = table["published"].index("Acc30 (%)")
            for line in table["rows"]:
                published[line["row"]] = line["published"][column]
    parts = {
        (section, part): rows for section, some in PARTS.items() for part, rows in some.items()
    }
    columns: dict[str, list] = {}
    for name, table in runs.items():
        rows = {row: lines for row, lines in table.groupby("row")}
        draws = {}  # by the number of seeds: the rows of a run have the same pairs in one order
        columns[name] = []
        for pair in parts.values():
            # The seeds that both rows have: rows of several frames or views have one.
            seeds = min(rows[row]["repeat"].nunique() for row in pair)
            with_part, without = (rows[row][rows[row]["repeat"] < seeds] for row in pair)
            if seeds not in draws:
                draws[seeds] = draws_of(with_part)
            found = paired_difference(without["error"], with_part["error"], weights=draws[seeds])
            columns[name].append((found["accuracy_gain"], *found["accuracy_gain_ci"]))
    columns["paper"] = [
        published.get(row, np.nan) - published.get(without, np.nan)
        for row, without in parts.values()
    ]
    return pd.DataFrame(columns, pd.MultiIndex.from_tuples(parts))


def show_trust(runs: Mapping[str, pd.DataFrame], rows: Sequence[str]) -> Figure:
    """Draw the share of right poses over their probability, in ten bins with equal numbers of
    poses, for up to three rows of two runs; the legend has the calibration errors."""
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.6), sharey=True, layout="constrained")
    for axis, (name, table) in zip(axes, runs.items()):
        for row, style in zip(rows, ("o-", "s--", "^:")):
            # The first seed, which all rows have.
            lines = table[(table["row"] == row) & (table["repeat"] == 0)]
            bins = reliability(lines["confidence"].to_numpy(), lines["error"].to_numpy() < 30)
            label = f"{row}: error {100 * bins.calibration_error:.0f} points"
            axis.plot(100 * bins.confidence, 100 * bins.accuracy, style, label=label)
        axis.plot([0, 100], [0, 100], ":", color="0.5")
        axis.set(title=name, xlabel="probability (%)", ylabel="right (%)")
        axis.legend(loc="lower right")
    return figure


def show_gains(found: pd.DataFrame, section: str) -> Figure:
    """Draw the gains of a section's parts: a mark with its interval for each run, of which there
    are at most two, and a cross for the paper."""
    here = found.loc[section]
    heights = np.arange(len(here))
    figure, axis = plt.subplots(figsize=(8, 1.1 + 0.42 * len(here)), layout="constrained")
    # One run is drawn a little above the line of a part, the other below.
    styles = zip("os", (plots.BLUE, plots.ORANGE), (-0.15, 0.15))
    for name, (marker, colour, shift) in zip(found.columns.drop("paper"), styles):
        value, low, high = np.transpose(here[name].tolist())
        style = {"fmt": marker, "color": colour, "capsize": 2, "label": name}
        axis.errorbar(value, heights + shift, xerr=(value - low, high - value), **style)
    axis.plot(here["paper"], heights, "kx", label="paper, CO3D", zorder=3)
    axis.axvline(0, color="0.4", linewidth=1)
    axis.set_yticks(heights, here.index)
    # The first part is at the top.
    axis.set(xlabel="gain in Acc30 (points)", ylim=(len(here) - 0.4, -0.6))
    figure.legend(loc="outside upper center", ncols=3)
    return figure
