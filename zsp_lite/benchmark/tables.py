"""The paper's tables from the summary of a run, with intervals, and the published results in
columns of their own; the comparison of two runs; and the figures of a run.

Medians are means of the categories' medians, as in the paper; accuracies are over all pairs.
`paper_tables.json` has the rows of each table, and what the paper published for CO3D (20 categories
with 100 pairs each) with DINO ViT-S/8.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from zsp_lite.alignment import Sim3
from zsp_lite.benchmark.methods import GROUPS, base_name, is_own, read_paper_tables
from zsp_lite.benchmark.runs import Run
from zsp_lite.benchmark.summary import draws_of, paired_difference
from zsp_lite.choices import METRICS, METRICS_SHOWN
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy, median
from zsp_lite.views import object_crop
from zsp_lite.viz.plots import (
    COLOURS,
    draw_moved_cloud,
    frame_cloud,
    pale,
    show_dots,
    show_images,
    show_panels,
)

PAPER = METRICS_SHOWN[:3]
PUBLISHED = "paper, CO3D"
_PUBLISHED_NOTE = "Figures of the paper: other data (CO3D) and another backbone (DINO ViT-S/8)."
_DECIMALS = {"n": 0, "failed": 0, "scale": 2, "translation": 2, "accuracy_gain_p": 3}  # others: 1
# Tables of a run's rows: all rows that see the pair only, and those that see more.
ROW_TABLES = {
    "all_rows": "All rows",
    "with_scans": "With several frames of the reference object",
    "with_others": "With other unlabelled objects of the category",
}
# Characters that LaTeX does not have in text mode.
_LATEX = str.maketrans({"°": r"$^\circ$", "−": "$-$", "–": "--", "|": "$|$"})


@dataclass(frozen=True)
class Cell:
    """A figure of a table, with its interval if it has one."""

    value: float
    low: float | None = None
    high: float | None = None
    decimals: int = 1

    def __str__(self) -> str:
        if self.decimals == 3 and self.value < 0.001:  # a p value
            return "< 0.001"
        number = f"{{:.{self.decimals}f}}"
        text = number if self.low is None else f"{number} [{number}, {number}]"
        return text.format(self.value, self.low, self.high)


@dataclass(frozen=True, eq=False)
class Table:
    """A table to print or write."""

    name: str  # stem of its files
    title: str
    cells: pd.DataFrame  # of `Cell`, or None
    note: str = ""  # how to read it

    @property
    def text(self) -> pd.DataFrame:
        """The cells as text, "–" where there is none."""
        return self.cells.map(lambda cell: "–" if cell is None else str(cell))


def every_table(summary: Mapping[str, Any], metrics: Sequence[str] = METRICS_SHOWN) -> list[Table]:
    """Return all tables of a run; `metrics` are the figures of the table of all rows (see
    `METRICS`)."""
    times = summary["milliseconds"]
    methods = {
        name: row | {"milliseconds": times.get(name)} for name, row in summary["methods"].items()
    }
    summary = {**summary, "methods": methods}
    of_paper = [*PAPER, "milliseconds"] if "milliseconds" in metrics else PAPER
    by_row = [_all_rows(summary, metrics, name) for name in ROW_TABLES]
    papers = [_paper_table(spec, summary, of_paper) for spec in read_paper_tables()]
    return [
        *(table for table in by_row if table.cells.size),
        # Those that show at least two rows of the run.
        *(table for table in papers if table.cells[METRICS["acc30"]].count() > 1),
        *(by_category(summary, metric) for metric in PAPER),
    ]


def _all_rows(summary: Mapping[str, Any], metrics: Sequence[str], table: str) -> Table:
    """Return one of `ROW_TABLES`; rows that see more stand below "verified", which does not."""
    methods = summary["methods"]
    names = [name for name in methods if _table_of(name) == table]
    if table != "all_rows" and names and "verified" in methods:  # to compare them with
        names.insert(0, "verified")
    titles = {
        "n": "pairs",
        **{metric: METRICS[metric] for metric in metrics},
        "failed": "failed",
        "accuracy_gain": "Acc30 − ours",
        "accuracy_gain_p": "p",
    }
    rows = [methods[name] | summary["against"].get(name, {}) for name in names]
    cells = pd.DataFrame(
        {title: [_cell(row, figure) for row in rows] for figure, title in titles.items()},
        names,
        dtype=object,
    )
    gain = (
        'Acc30 − ours: difference to "ours" on the same pairs, in points, and its p value by the '
        "same bootstrap."
    )
    return _table(summary, table, ROW_TABLES[table], cells, gain)


def _paper_table(
    spec: Mapping[str, Any], summary: Mapping[str, Any], metrics: Sequence[str]
) -> Table:
    """Return a table of the paper with the run's rows and the published figures.

    Table 1 has rows of one's own, too, below the paper's.
    """
    methods = summary["methods"]
    categories = summary["data"]["categories"]
    lines = list(spec["rows"])
    if spec["name"] == "table_1":
        lines += [{"label": name, "row": name, "published": []} for name in own_rows(summary)]
    # A row at the run's own number of target views goes by either name.
    views = f"-n{summary['data']['targets']}"
    shown = []  # lines, each with the figures of its row
    for line in lines:
        row = methods.get(line["row"]) or methods.get(line["row"].removesuffix(views), {})
        if row or "chosen" not in summary:
            shown.append((line, row))

    # The run's own figures, those of single categories, and the published ones.
    columns = {METRICS[metric]: [_cell(row, metric) for _, row in shown] for metric in metrics}
    published = {}
    for place, title in enumerate(spec["published"]):
        # Titles are "CATEGORY Acc30" for a single category; those for all pairs stay as they are.
        category = title.removesuffix(" Acc30")
        if category in categories:
            parts = [row.get("per_category", {}).get(category, {}) for _, row in shown]
            columns[title] = [_cell(part, "acc30") for part in parts]
        if category in (title, *categories):
            # Lists of one figure, or empty: rows of one's own have none.
            figures = [line["published"][place : place + 1] for line, _ in shown]
            published[f"{PUBLISHED}: {title}"] = [Cell(*one) if one else None for one in figures]
    labels = [line["label"] for line, _ in shown]
    cells = pd.DataFrame(columns | published, labels, dtype=object)
    notes = [_PUBLISHED_NOTE if published else "", spec.get("note", "")]
    return _table(summary, spec["name"], spec["title"], cells, *notes)


def by_category(
    summary: Mapping[str, Any], metric: str = "acc30", most: int | None = None
) -> Table:
    """Return a figure of the first `most` rows, or of all, with a line for each category and one
    for all pairs."""
    categories = summary["data"]["categories"]
    cells = {}
    for name in important_rows(summary)[:most]:
        row = summary["methods"][name]
        parts = [row["per_category"].get(category, {}) for category in categories]
        cells[name] = [_cell(part, metric) for part in (*parts, row)]
    # "median" of "mean_category_median": a category has one median.
    name = f"categories_{metric.rpartition('_')[2]}"
    title = f"By category: {METRICS[metric]}"
    return _table(summary, name, title, pd.DataFrame(cells, [*categories, "all"], dtype=object))


def compare(first: Run, second: Run, rows: Sequence[str] | None = None) -> Table:
    """Compare rows of two runs, by default every row that both have, on the pairs that both have
    evaluated.

    Rows are texts "A:B", for row A of the first and B of the second run, or "A". InputError if a
    row or a common pair is missing.
    """
    of_first = first.table["row"].unique()
    of_second = second.table["row"].unique()
    if rows is None:
        rows = [name for name in of_first if name in of_second]
    if not len(rows):
        raise InputError(
            f"runs have no row in common: {', '.join(of_first)} and {', '.join(of_second)}"
        )
    cells = {}
    for text in rows:
        row_a, _, row_b = (text, "", text) if text in of_first else text.partition(":")
        common = first.row(row_a).merge(
            second.row(row_b), on=["pair", "repeat"], suffixes=("", "_b")
        )
        if common.empty:
            raise InputError(
                f"rows {row_a} and {row_b} have no pair in common: other data or number of views"
            )
        errors = common[["error", "error_b"]].to_numpy().T  # (2, pairs)
        gain = paired_difference(*errors, weights=draws_of(common))
        cells[text] = [
            Cell(len(common), decimals=0),
            *map(Cell, accuracy(errors, 30)),
            _cell(gain, "accuracy_gain"),
            _cell(gain, "accuracy_gain_p"),
            *map(Cell, median(errors)),
        ]
    titles = ["pairs", "Acc30 of A (%)", "Acc30 of B (%)", "B − A", "p"]
    titles += [f"{run}: {METRICS['median']}" for run in "AB"]
    note = (
        "On the common pairs. Intervals (95 %) and p: bootstrap over objects. "
        "Of twenty rows without a difference, one has p < 0.05 by chance."
    )
    title = f"A = {first.folder}, B = {second.folder}"
    return Table("compare", title, pd.DataFrame.from_dict(cells, "index", object, titles), note)


def own_rows(summary: Mapping[str, Any]) -> list[str]:
    """List the rows of a run that are not the library's."""
    return [*filter(is_own, summary["methods"])]


def important_rows(summary: Mapping[str, Any]) -> list[str]:
    """List the rows of a run that see the pair only (all rows if none does), "ours" and one's own
    first; or the rows that were chosen in `write_reports`."""
    if "chosen" in summary:
        return summary["chosen"]
    names = [name for name in summary["methods"] if _table_of(name) == "all_rows"]
    names = names or list(summary["methods"])
    leading = ["ours", *own_rows(summary), "ours-bv", "verified"]
    return list(dict.fromkeys([name for name in leading if name in names] + names))


def _table_of(name: str) -> str:
    """Return the one of `ROW_TABLES` that a row stands in."""
    base = base_name(name)
    if base == "category":
        return "with_others"
    return "with_scans" if base in GROUPS["scans"] else "all_rows"


def _cell(row: Mapping[str, Any], figure: str) -> Cell | None:
    """Return a figure of a row or of one of its categories; a category has one median only."""
    if figure == "mean_category_median" and figure not in row:
        figure = "median"
    value = row.get(figure)
    if value is None:
        return None
    return Cell(value, *row.get(f"{figure}_ci", ()), decimals=_DECIMALS.get(figure, 1))


def _table(
    summary: Mapping[str, Any], name: str, title: str, cells: pd.DataFrame, *more: str
) -> Table:
    """Make a table of a run, with notes on how to read it."""
    notes = [summary.get("note", "")]
    if METRICS["mean_category_median"] in cells:
        notes.append("Med. err.: mean of the categories' medians.")
    if METRICS["milliseconds"] in cells:
        notes.append(
            "ms per pair: median; what rows share, such as features, counts for the first "
            "that needs it."
        )
    notes.append("Intervals: 95 %, bootstrap over objects.")
    deviation = summary["methods"].get("ours", {}).get("acc30_sd_of_seeds")
    if deviation is not None:
        notes.append(
            "Means over seeds, whose spread the intervals include; by seed, Acc30 of ours has a "
            f"standard deviation of {deviation:.1f} points."
        )
    return Table(name, title, cells, " ".join(filter(None, [*notes, *more])))


def as_csv(table: Table) -> str:
    """Format as plain numbers, an interval in two columns of its own."""
    columns = {}
    for title, cells in table.cells.items():
        for part, ending in (("value", ""), ("low", " low"), ("high", " high")):
            columns[title + ending] = [getattr(cell, part, None) for cell in cells]
    numbers = pd.DataFrame(columns, table.cells.index).dropna(axis="columns", how="all")
    return numbers.to_csv(index_label="row", float_format="%.6g")


def as_markdown(table: Table) -> str:
    """Format as a pipe table under its title."""
    escape = methodcaller("replace", "|", "\\|")
    text = table.text.rename(index=escape, columns=escape)
    parts = [f"**{table.title}**", _lines(text, "pipe"), table.note]
    return "\n\n".join(filter(None, parts)) + "\n"


def _lines(cells: pd.DataFrame, form: str) -> str:
    """Format texts as the lines of a table in one of tabulate's forms."""
    alignment = ["left", *["right"] * len(cells.columns)]
    return cells.to_markdown(tablefmt=form, disable_numparse=True, colalign=alignment)


def as_latex(table: Table, intervals: bool = False) -> str:
    """Format the first three figures, by default those of the paper, and the time as the body of a
    booktabs table."""
    time = METRICS["milliseconds"]
    titles = [title for title in table.cells if title not in ("pairs", time)][:3]
    if time in table.cells:
        titles.append(time)
    cells = table.text[titles][table.cells[titles].notna().any(axis="columns")]
    if not intervals:
        cells = cells.replace(r" \[.*", "", regex=True)
    # Minus signs, which `_LATEX` puts into math mode.
    cells = cells.replace(r"(^|\[|, )-", "\\1−", regex=True)
    lines = _lines(cells, "latex_booktabs")
    return lines.translate(_LATEX) + "\n"


def error_curves(run: Run, rows: Sequence[str] | None = None) -> Figure:
    """Draw the cumulative distribution of the errors, one line per row; by default of the most
    important rows."""
    curves = {}
    for name in rows or important_rows(run.summary)[: len(COLOURS)]:
        errors = np.sort(run.row(name)["error"])
        curves[name] = (errors, 100 * np.arange(1, len(errors) + 1) / len(errors))
    return show_panels(
        {"": curves},
        size=(6.5, 4),
        xlabel="rotation error (degrees)",
        ylabel="pairs with at most this error (%)",
        xlim=(0, 180),
        ylim=(0, 100),
        xticks=range(0, 181, 30),
    )


def pair_figure(run: Run, key: str, dataset: Co3D, rows: Sequence[str] | None = None) -> Figure:
    """Draw the reference of a pair under its points, and for each row with a pose its target view
    under the moved points.

    Without a translation, they are moved to the middle of the target's points. InputError if no row
    has a pose.
    """
    found = run.table[run.table["pair"] == key].dropna(subset=["rotation", "view"])
    found = found.drop_duplicates("row").set_index("row")  # of the first seed
    results = found.loc[[name for name in rows or found.index if name in found.index]]
    if results.empty:
        raise InputError(
            f"pair {key!r} has no pose in the run, expected a key such as "
            f"{run.table['pair'].iloc[0]}"
        )
    reference, targets = dataset.load_pair(Pair.from_key(key))
    crops = [object_crop(reference)]
    titles = ["reference"]
    poses = [Sim3.identity()]
    cloud = frame_cloud(crops[0])
    for name, result in results.iterrows():
        crop = object_crop(targets[int(result["view"])])
        scale = 1.0 if pd.isna(result["scale"]) else result["scale"]
        rotation = np.reshape(result["rotation"], (3, 3))
        position = result["position"]
        if position is None:
            position = frame_cloud(crop).mean(axis=0) - scale * rotation @ cloud.mean(axis=0)
        crops.append(crop)
        titles.append(f"{name}, {result['error']:.0f}° off")
        poses.append(Sim3(scale, rotation, np.array(position)))
    figure, axes = show_images([pale(crop.rgb) for crop in crops], titles, columns=4)
    draw_moved_cloud(axes, [crop.camera for crop in crops], cloud, poses)
    return figure


def write_figures(
    run: Run,
    folder: str | Path,
    rows: Sequence[str] | None = None,
    size: tuple[float, float] | None = None,
) -> None:
    """Write the errors of the first row by category (figure "err_distrib" of the supplement), and
    the error curves (see `save_figure`).

    A second cluster near 180 degrees consists of confusions of front and back.
    """
    first = [*(rows or own_rows(run.summary)), *important_rows(run.summary)][0]
    errors = dict(list(run.row(first).groupby("category")["error"]))
    label = f"rotation error of {first} (degrees)"
    with plt.rc_context({"text.parse_math": False}):  # names of rows and categories are no TeX
        # With margins, so that dots at 0 and 180 degrees are whole.
        dots = show_dots(errors, xlabel=label, xlim=(-3, 183), xticks=range(0, 181, 30))
        save_figure(dots, folder, "error_distribution", size)
        save_figure(error_curves(run, rows), folder, "error_curves", size)


def save_figure(
    figure: Figure, folder: str | Path, name: str, size: tuple[float, float] | None = None
) -> Path:
    """Write and close a figure of a size in inches as NAME.pdf and NAME.png, whose path is
    returned."""
    # The key of a pair holds slashes, and may be longer than a file's name may be.
    path = Path(folder) / f"{re.sub('[^A-Za-z0-9.,-]', '_', name)[:200]}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    if size is not None:
        figure.set_size_inches(size)
    # Publishers refuse fonts of type 3; 42 is TrueType.
    with plt.rc_context({"pdf.fonttype": 42, "ps.fonttype": 42}):
        # Without a date, equal figures are equal files.
        figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None})
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return path
