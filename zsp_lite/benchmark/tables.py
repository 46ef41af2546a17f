"""The paper's tables from the summary of a run, with intervals, and the published results in
columns of their own; the comparison of two runs; and the figures of a run.

Medians are means of the categories' medians, as in the paper; accuracies are over all pairs.
`paper_tables.json` has the rows of each table, and what the paper published for CO3D (20 categories
with 100 pairs each) with DINO ViT-S/8.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
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
from zsp_lite.benchmark.statistics import draws_of, paired_difference
from zsp_lite.choices import METRICS, METRICS_SHOWN
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.files import write_atomic
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
# Rows that see more than the pair, in tables of their own: by the name of the table its title and
# rows.
SEE_MORE = {
    "with_scans": ("With several frames of the reference object", GROUPS["scans"]),
    "with_others": ("With other unlabelled objects of the category", ["category"]),
}
_LOWEST_IS_BEST = ("mean_category_median", "median", "above150", "translation", "milliseconds")
_SYMBOLS = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_SYMBOLS |= {"°": r"$^\circ$", "−": "$-$"}
_SYMBOLS |= {one: f"\\{one}" for one in "%_&#${}"} | {one: f"${one}$" for one in "<>|"}
_escape = methodcaller("translate", str.maketrans(_SYMBOLS))


@dataclass(frozen=True)
class Cell:
    """A figure of a table, with its interval if it has one."""

    value: float
    low: float | None = None
    high: float | None = None
    decimals: int = 1
    metric: str = ""  # of `METRICS`

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
    data: str = ""  # what was evaluated
    across: bool = False  # the columns are methods, not the rows

    @property
    def text(self) -> pd.DataFrame:
        """The cells as text, "–" where there is none."""
        return self.cells.map(lambda cell: "–" if cell is None else str(cell))


def choose(run: Run, rows: Sequence[str]) -> dict[str, Any]:
    """Return the summary of a run with some rows, in this order, for the tables; InputError for an
    unknown row."""
    for name in rows:
        run.row(name)
    return run.summary | {
        "methods": {name: run.summary["methods"][name] for name in rows},
        "chosen": list(rows),
    }


def every_table(summary: Mapping[str, Any], metrics: Sequence[str] = METRICS_SHOWN) -> list[Table]:
    """Return all tables of a run; `metrics` are the figures of the table of all rows (see
    `METRICS`)."""
    times = summary["milliseconds"]
    methods = {
        name: row | {"milliseconds": times.get(name)} for name, row in summary["methods"].items()
    }
    summary = {**summary, "methods": methods}
    first = (all_rows(summary, metrics, name) for name in ("all_rows", *SEE_MORE))
    shown = *PAPER, *(metric for metric in metrics if metric == "milliseconds")
    tables = *first, *paper_tables(summary, shown), *(by_category(summary, one) for one in PAPER)
    return [table for table in tables if table.cells.size]


def all_rows(
    summary: Mapping[str, Any], metrics: Sequence[str] = METRICS_SHOWN, table: str = "all_rows"
) -> Table:
    """Return every row that sees the pair only, or those of a table of `SEE_MORE` below "verified",
    which does, too."""
    title, members = SEE_MORE.get(table, ("All rows", []))
    names = [
        name
        for name in summary["methods"]
        if base_name(name) in members or not members and not _sees_more(name)
    ]
    if members and names:  # what they add to
        names = [*(name for name in summary["methods"] if name == "verified"), *names]
    rows = {}
    for name in names:
        row = summary["methods"][name]
        pairs, failed = (Cell(row[count], decimals=0) for count in ("n", "failed"))
        difference = _difference(summary.get("against", {}).get(name))
        rows[name] = [pairs, *(_cell(row, metric) for metric in metrics), failed, *difference]
    titles = ["pairs", *(METRICS[name] for name in metrics), "failed", "Acc30 − ours", "p"]
    gain = (
        'Acc30 − ours: difference to "ours" on the same pairs, in points, and its p value by the '
        "same bootstrap."
    )
    return _table(summary, table, title, rows, titles, metrics, gain)


def paper_tables(summary: Mapping[str, Any], metrics: Sequence[str] = PAPER) -> list[Table]:
    """Return tables 1 to 3, those of the supplement and more, where the run has two of
    their rows."""
    tables = [_paper_table(spec, summary, metrics) for spec in read_paper_tables()]
    return [table for table in tables if table.cells[METRICS["acc30"]].count() > 1]


def _paper_table(
    spec: Mapping[str, Any], summary: Mapping[str, Any], metrics: Sequence[str]
) -> Table:
    """A table with the run's rows, the published figures, and in Table 1, rows of one's own below
    the paper's."""
    categories, methods, views = (
        summary["data"]["categories"],
        summary["methods"],
        f"-n{summary['data']['targets']}",
    )
    lines = [
        (one["row"] if one["row"] in methods else one["row"].removesuffix(views), one)
        for one in spec["rows"]
    ]
    if spec["name"] == "table_1":
        lines += [(name, {"label": name, "published": []}) for name in own_rows(summary)]
    if chosen := summary.get("chosen"):
        lines = sorted(
            (line for line in lines if line[0] in chosen), key=lambda line: chosen.index(line[0])
        )
    # Of the single categories with a published Acc30, those of the run are shown.
    names = [title.removesuffix(" Acc30") for title in spec["published"]]
    kept = [
        k
        for k, (name, title) in enumerate(zip(names, spec["published"]))
        if name in (title, *categories)
    ]
    featured = [names[k] for k in kept if names[k] in categories]
    titles = [
        *(METRICS[metric] for metric in metrics),
        *(f"{category} Acc30" for category in featured),
    ]
    rows = {}
    for name, line in lines:
        row = methods.get(name)
        cells = [_cell(row, metric) for metric in metrics]
        cells += [
            _cell(row and row["per_category"].get(category), "acc30") for category in featured
        ]
        rows[line["label"]] = cells + [
            Cell(line["published"][k]) if line["published"] else None for k in kept
        ]
    titles += [f"{PUBLISHED}: {spec['published'][k]}" for k in kept]
    notes = _PUBLISHED_NOTE if kept else "", spec.get("note", "")
    return _table(summary, spec["name"], spec["title"], rows, titles, metrics, *notes)


def by_category(
    summary: Mapping[str, Any], metric: str = "acc30", most: int | None = None
) -> Table:
    """Return a figure of the first `most` rows, or of all, with a line for each category and one
    for all pairs."""
    methods = {name: summary["methods"][name] for name in important_rows(summary)[:most]}
    rows = {
        category: [_cell(row["per_category"].get(category), metric) for row in methods.values()]
        for category in summary["data"]["categories"]
    }
    rows["all"] = [_cell(row, metric) for row in methods.values()]
    name, title = f"categories_{metric.rpartition('_')[2]}", f"By category: {METRICS[metric]}"
    return _table(summary, name, title, rows, list(methods), [metric], across=True)


def compare(
    first: Run, second: Run, rows: Sequence[str] | None = None, names: Sequence[str] = "AB"
) -> Table:
    """Compare rows of two runs, by default every row that both have, on the pairs that both have
    evaluated.

    Rows are texts "A:B", for row A of the first and B of the second run, or "A"; `names` are those
    of the runs. InputError if a row or a common pair is missing.
    """
    of_first, of_second = (run.table["row"].unique() for run in (first, second))
    rows, cells = [name for name in of_first if name in of_second] if rows is None else rows, {}
    if not len(rows):
        raise InputError(
            f"runs have no row in common: {', '.join(of_first)} and {', '.join(of_second)}"
        )
    for text in rows:
        one, _, other = (text, "", text) if text in of_first else text.partition(":")
        lines = (
            run.row(name).set_index("repeat", append=True, drop=False)
            for run, name in ((first, one), (second, other))
        )
        both = next(lines).join(next(lines)["error"].rename("other"), how="inner").sort_index()
        if both.empty:
            raise InputError(
                f"rows {one} and {other} have no pair in common: other data or number of views"
            )
        errors = both[["error", "other"]].to_numpy().T
        figures = [Cell(len(both), decimals=0), *map(Cell, accuracy(errors, 30))]
        difference = _difference(paired_difference(*errors, weights=draws_of(both)))
        cells[text] = [*figures, *difference, *map(Cell, median(errors))]
    medians = (f"{run}: {METRICS['median']}" for run in "AB")
    titles = ["pairs", "Acc30 of A (%)", "Acc30 of B (%)", "B − A", "p", *medians]
    note = "On the common pairs. Intervals (95 %) and p: bootstrap over objects. "
    note += "Of twenty rows without a difference, one has p < 0.05 by chance."
    title = "A = {}, B = {}".format(*names)
    return Table("compare", title, pd.DataFrame.from_dict(cells, "index", object, titles), note)


def _difference(test: Mapping[str, Any] | None) -> tuple[Cell | None, Cell | None]:
    """The gain and the p value of a `paired_difference`."""
    if test is None:
        return None, None
    return Cell(test["accuracy_gain"], *test["accuracy_gain_ci"]), Cell(
        test["accuracy_gain_p"], decimals=3
    )


def own_rows(summary: Mapping[str, Any]) -> list[str]:
    """List the rows of a run that are not the library's."""
    return [*filter(is_own, summary["methods"])]


def important_rows(summary: Mapping[str, Any]) -> list[str]:
    """List the rows of a run that see the pair only, or all if none does, "ours" and one's own
    first; or the chosen."""
    if "chosen" in summary:
        return summary["chosen"]
    first = ["ours", *own_rows(summary), "ours-bv", "verified"]
    names = [name for name in summary["methods"] if not _sees_more(name)]
    return sorted(
        names or summary["methods"],
        key=lambda name: first.index(name) if name in first else len(first),
    )


def _sees_more(name: str) -> bool:
    return any(base_name(name) in rows for _, rows in SEE_MORE.values())


def _cell(row: Mapping[str, Any] | None, metric: str) -> Cell | None:
    """A figure of a row, or of a category, which has no mean of categories."""
    if row is not None and metric not in row and metric == "mean_category_median":
        metric = "median"
    if row is None or row.get(metric) is None:
        return None
    decimals = 2 if metric in ("scale", "translation") else 1
    return Cell(row[metric], *row.get(f"{metric}_ci", (None, None)), decimals, metric)


def _table(
    summary: Mapping[str, Any],
    name: str,
    title: str,
    rows: Mapping[str, Sequence[Cell | None]],
    titles: Sequence[str],
    metrics: Sequence[str],
    *more: str,
    across: bool = False,
) -> Table:
    """Make a table of a run, with notes on how to read it, and with what the run has evaluated."""
    data, notes = summary["data"], [summary.get("note", "")]
    if "mean_category_median" in metrics:
        notes.append("Med. err.: mean of the categories' medians.")
    if {"translation", "scale"} & set(metrics):
        notes.append("Translation and scale: medians of the pairs for which a row has them.")
    if any("@threshold=" in name for name in summary["methods"]):
        notes.append(
            "A threshold is to be chosen on validation categories, never on those that are "
            "evaluated."
        )
    if "milliseconds" in metrics:
        notes.append(
            "ms per pair: median; what rows share, such as features, counts for the first "
            "that needs it."
        )
    notes += ["Intervals: 95 %, bootstrap over objects.", *_note_on_seeds(summary), *more]
    pairs = f"{data['pairs']} pairs" + (
        " of an unfinished run" if "Not finished" in notes[0] else ""
    )
    what = (
        f"{Path(data['root']).name}, {pairs}, {data['targets']} target views, backbone "
        f"{summary['backbone']}"
    )
    cells = pd.DataFrame.from_dict(rows, "index", object, titles)
    return Table(name, title, cells, " ".join(filter(None, notes)), what, across)


def _note_on_seeds(summary: Mapping[str, Any]) -> list[str]:
    """Say how much the draws of k-means and RANSAC alone change Acc30, if there are several of each
    pair."""
    spread = {
        name: row["acc30_sd_of_seeds"]
        for name, row in summary["methods"].items()
        if "acc30_sd_of_seeds" in row
    }
    if not spread:
        return []
    name = "ours" if "ours" in spread else next(iter(spread))
    return [
        f"Means over seeds, which the intervals hold; by seed, Acc30 of {name} has a standard "
        "deviation of "
        f"{spread[name]:.1f} points."
    ]


def as_csv(table: Table) -> str:
    """Format as plain numbers, an interval in two columns of its own."""
    columns = {
        f"{title} {part}".removesuffix(" value"): [getattr(cell, part, None) for cell in cells]
        for title, cells in table.cells.items()
        for part in ("value", "low", "high")
    }
    numbers = pd.DataFrame(columns, table.cells.index).dropna(axis="columns", how="all")
    return numbers.to_csv(index_label="row", float_format="%.6g")


def as_markdown(table: Table) -> str:
    """Format as a pipe table under its title."""
    text = table.text.rename(
        **dict.fromkeys(("index", "columns"), lambda name: name.replace("|", "\\|"))
    )
    lines = text.to_markdown(
        disable_numparse=True, colalign=("left", *["right"] * len(text.columns))
    )
    return "\n\n".join(filter(None, [f"**{table.title}**", lines, table.note])) + "\n"


def as_latex(table: Table, intervals: bool = False) -> str:
    """Format three columns and the time as a booktabs table, the best value of a metric in bold.

    The paper's figures of these columns follow in lines of their own.
    """
    time = METRICS["milliseconds"]
    titles = [title for title in table.cells if title not in ("pairs", time)][:3] + [time] * (
        time in table.cells
    )
    shown = table.cells[titles].dropna(how="all")
    texts, best = (
        shown.map(_number, interval=intervals),
        shown.apply(_are_best, axis=int(table.across)),
    )
    published = table.cells.reindex(columns=[f"{PUBLISHED}: {title}" for title in titles]).dropna(
        how="all"
    )
    published = published.set_axis(titles, axis="columns").rename(
        lambda label: f"{PUBLISHED}: {label}"
    )
    lines = pd.concat([texts.mask(best, r"\textbf{" + texts + "}"), published.map(_number)])
    lines = lines.rename(index=_escape, columns=_escape)
    # LaTeX counts tables itself
    title = re.sub(r"^(Table \d+|Supplement|Beyond the paper)\. ", "", table.title)
    caption = _escape(
        ". ".join(filter(None, (title, table.data, _PUBLISHED_NOTE if len(published) else "")))
    )
    alignment = "l" + "r" * len(titles)
    return lines.to_latex(
        position="tb", label=f"tab:{table.name}", caption=caption, column_format=alignment
    )


def _are_best(cells: pd.Series) -> pd.Series:
    """Tell which cells of one metric are the best, if there are rivals; a row that is told the true
    view is none."""
    rivals = {
        name: cell
        for name, cell in cells.items()
        if cell and cell.metric and "oracle-view" not in name
    }
    values = pd.Series(
        {name: round(cell.value, cell.decimals) for name, cell in rivals.items()},
        cells.index,
        float,
    )
    lowest = any(cell.metric in _LOWEST_IS_BEST for cell in rivals.values())
    return (values == (values.min() if lowest else values.max())) & (len(rivals) > 1)


def _number(cell: Any, interval: bool = False) -> str:
    if not isinstance(cell, Cell):
        return "--"
    text = str(cell) if interval else str(replace(cell, low=None))
    return text.replace("-", "$-$")


def write_tables(tables: Iterable[Table], folder: str | Path, intervals: bool = False) -> None:
    """Write each table as NAME.csv, NAME.md and NAME.tex, this with `intervals` or without."""
    for table in tables:
        texts = {
            ".csv": as_csv(table),
            ".md": as_markdown(table),
            ".tex": as_latex(table, intervals),
        }
        for suffix, text in texts.items():
            write_atomic(Path(folder) / f"{table.name}{suffix}", text.encode())


def error_distribution(run: Run, row: str = "ours") -> Figure:
    """Draw the rotation error of every pair, one line per category (figure "err_distrib" of the
    supplement).

    A second cluster near 180 degrees consists of confusions of front and back.
    """
    groups = {str(name): errors for name, errors in run.row(row).groupby("category")["error"]}
    labels = {
        "xlabel": f"rotation error of {row} (degrees)",
        "xlim": (-3, 183),
        "xticks": range(0, 181, 30),
    }
    return show_dots({row: groups}, **labels)


def error_curves(run: Run, rows: Sequence[str] | None = None) -> Figure:
    """Draw the cumulative distribution of the errors, one line per row; by default of the most
    important rows."""
    curves = {}
    for name in rows or important_rows(run.summary)[: len(COLOURS)]:
        errors = np.sort(run.row(name)["error"])
        shares = 100 * np.arange(len(errors) + 1) / len(errors)
        # a step at every error
        curves[name] = (
            np.repeat([0, *errors], 2)[1:],
            np.repeat(shares, 2)[:-1],
        )
    labels = {"xlabel": "rotation error (degrees)", "ylabel": "pairs with at most this error (%)"}
    labels |= {"xlim": (0, 180), "ylim": (0, 100), "xticks": (0, 15, 30, 60, 90, 120, 150, 180)}
    return show_panels({"": curves}, size=(6.5, 4), **labels)


def pair_figure(run: Run, key: str, dataset: Co3D, rows: Sequence[str] | None = None) -> Figure:
    """Draw the reference of a pair, and for each row with a pose its target view, below it under
    the moved points.

    Without a translation, they are moved to the middle of the target's points. InputError if no row
    has a pose.
    """
    stored = {
        name: run.row(name).dropna(subset=["rotation", "view"])
        for name in rows or run.table["row"].unique()
    }
    # of the first seed
    found = {name: row.loc[[key]].iloc[0] for name, row in stored.items() if key in row.index}
    if not found:
        raise InputError(
            f"pair {key!r} has no pose in the run, expected a key such as "
            f"{run.table['pair'].iloc[0]}"
        )
    reference, targets = dataset.load_pair(Pair.from_key(key))
    crops = [
        object_crop(reference),
        *(object_crop(targets[int(result["view"])]) for result in found.values()),
    ]
    cloud, images = frame_cloud(crops[0]), [crop.rgb for crop in crops]
    poses = [
        Sim3.identity(),
        *(_pose(result, cloud, crop) for result, crop in zip(found.values(), crops[1:])),
    ]
    titles = [
        "reference",
        *found,
        "its points",
        *(f"{result['error']:.0f}° off" for result in found.values()),
    ]
    figure, axes = show_images([*images, *map(pale, images)], titles, len(crops))
    draw_moved_cloud(axes[len(crops) :], [crop.camera for crop in crops], cloud, poses)
    return figure


def _pose(result: pd.Series, cloud: np.ndarray, target: Frame) -> Sim3:
    scale, position = 1.0 if pd.isna(result["scale"]) else result["scale"], result["position"]
    rotation = np.reshape(result["rotation"], (3, 3))
    if position is None:
        position = frame_cloud(target).mean(axis=0) - scale * rotation @ cloud.mean(axis=0)
    return Sim3(scale, rotation, np.array(position))


def write_figures(
    run: Run,
    folder: str | Path,
    rows: Sequence[str] | None = None,
    size: tuple[float, float] | None = None,
) -> None:
    """Write the errors of the first row by category, and the error curves (see `save_figure`)."""
    first = [*(rows or own_rows(run.summary)), *important_rows(run.summary)][0]
    with plt.rc_context({"text.parse_math": False}):  # names of rows and categories are no TeX
        save_figure(error_distribution(run, first), folder, "error_distribution", size)
        save_figure(error_curves(run, rows), folder, "error_curves", size)


def save_figure(
    figure: Figure, folder: str | Path, name: str, size: tuple[float, float] | None = None
) -> Path:
    """Write and close a figure of a size in inches as NAME.pdf and NAME.png, whose path is
    returned."""
    path = Path(folder) / f"{re.sub('[^A-Za-z0-9.,-]', '_', name)[:200]}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    if size is not None:
        figure.set_size_inches(size)
    # publishers refuse fonts of type 3
    with plt.rc_context({"pdf.fonttype": 42, "ps.fonttype": 42}):
        figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None})
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return path
