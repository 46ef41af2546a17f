"""Tables, figures and comparisons of a run that was made up, so that every figure in them
is known."""

import csv
import gzip
import io
import re
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from benchmark_folder import CATEGORIES, RESULT, made_up_run, write_run
from refusals import refused

from zsp_lite.benchmark import tables
from zsp_lite.benchmark.methods import read_paper_tables, resolve
from zsp_lite.benchmark.run import write_reports
from zsp_lite.benchmark.runs import LINES, SETTINGS, Run, read_run
from zsp_lite.benchmark.summary import draws_of, paired_difference
from zsp_lite.benchmark.tables import (
    PUBLISHED,
    Cell,
    Table,
    as_latex,
    as_markdown,
    every_table,
)
from zsp_lite.data.co3d import Pair

pytestmark = pytest.mark.slow

ROWS = list(resolve("table1 ablations views ours-bv rootsift verified".split()))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Run:
    """A run of the paper's rows and the library's."""
    return made_up_run(tmp_path_factory.mktemp("made-up"), ROWS)


@pytest.fixture(scope="module")
def three(tmp_path_factory) -> Run:
    """A run of three rows."""
    return made_up_run(tmp_path_factory.mktemp("three"), ["ours", "ours-bv", "rootsift"])


def by_name(found: list[Table]) -> dict[str, Table]:
    """Tables by their names."""
    return {table.name: table for table in found}


@pytest.fixture(scope="module")
def every(whole):
    """All tables of the run, by their names."""
    return by_name(every_table(whole.summary))


def cell(table: Table, row: str, column: str, group: str = "") -> Cell | None:
    """A cell of a table, in a column of a group."""
    return table.cells.loc[row, f"{group}: {column}" if group else column]


def bounds(cell: Cell) -> tuple:
    """A figure and its interval."""
    return cell.value, cell.low, cell.high


PAPERS = [table["name"] for table in read_paper_tables()]


def test_a_run_has_the_papers_tables_of_its_rows(every, three):
    # The rows of the last table differ from those of the others: they are not in `ROWS`.
    assert [name for name in every if name in PAPERS] == PAPERS[:-1]
    names = [table.name for table in every_table(three.summary) if table.name in PAPERS]
    assert names == ["table_2", "table_a_targets", "table_a_depth"]


def test_accuracies_of_a_table_are_the_runs(whole, every):
    methods = whole.summary["methods"]
    acc30 = cell(every["table_1"], "Ours (K=50)", "Acc30 (%)")
    assert bounds(acc30) == (methods["ours"]["acc30"], *methods["ours"]["acc30_ci"])
    toaster = cell(every["table_1"], "ICP", "toaster Acc30")
    assert toaster.value == methods["icp"]["per_category"]["toaster"]["acc30"]


def test_the_median_of_a_table_is_the_mean_of_the_categories_medians(whole, every):
    ours = whole.summary["methods"]["ours"]["per_category"]
    median = cell(every["table_1"], "Ours (K=50)", "Med. err. (°)")
    assert median.value == pytest.approx(np.mean([ours[name]["median"] for name in CATEGORIES]))
    assert median.low < median.value < median.high


def test_published_figures_stand_apart(every):
    assert cell(every["table_1"], "ICP", "toaster Acc30", PUBLISHED).value == 7.0
    assert cell(every["table_1"], "SWaV", "Acc30 (%)") is None  # was published only


def test_a_difference_to_ours_is_the_paired_difference(three):
    ours = three.row("ours")
    test = paired_difference(ours["error"], three.row("rootsift")["error"], weights=draws_of(ours))
    assert three.summary["against"]["rootsift"] == test
    table = every_table(three.summary)[0]
    gain = cell(table, "rootsift", "Acc30 − ours")
    first, second = [three.summary["methods"][name]["acc30"] for name in ("ours", "rootsift")]
    assert gain.value == pytest.approx(second - first)
    assert gain.low <= gain.value <= gain.high
    assert cell(table, "rootsift", "p").value == test["accuracy_gain_p"]
    assert cell(table, "ours", "p") is None


def test_the_table_of_all_rows_has_chosen_metrics(three):
    table = every_table(three.summary, ["above150", "median"])[0]
    errors = three.row("rootsift")["error"]
    expected = {
        "above 150° (%)": 100 * np.mean(errors > 150),
        "pooled med. err. (°)": np.median(errors),
    }
    assert list(table.cells)[1:3] == list(expected)
    assert {title: cell(table, "rootsift", title).value for title in expected} == pytest.approx(
        expected
    )
    assert "Med. err." not in table.note


def test_rows_that_see_more_stand_apart_from_those_that_see_the_pair_only(tmp_path):
    rows = "ours category scans-8 verified category-n3 scans-2".split()
    summary = made_up_run(tmp_path, rows).summary
    found = by_name(every_table(summary))
    stand = {name: list(found[name].cells.index) for name in ("with_others", "with_scans")}
    assert stand == {
        "with_others": ["verified", "category", "category-n3"],
        "with_scans": ["verified", "scans-8", "scans-2"],
    }
    assert found["with_others"].title == "With other unlabelled objects of the category"
    assert found["with_scans"].title == "With several frames of the reference object"
    assert list(found["all_rows"].cells.index) == ["ours", "verified"]
    assert list(found["categories_acc30"].cells) == ["ours", "verified"]


@pytest.mark.parametrize(
    "name, metric, of_all",
    [
        ("median", "median", "mean_category_median"),
        ("acc30", "acc30", "acc30"),
        ("acc15", "acc15", "acc15"),
    ],
)
def test_figures_by_category_are_those_of_the_summary(whole, every, name, metric, of_all):
    cells = every[f"categories_{name}"].cells
    assert list(cells.index) == [*CATEGORIES, "all"]
    assert list(cells) == tables.important_rows(whole.summary)
    for row in cells:
        figures = whole.summary["methods"][row]
        of_row = [figures["per_category"][category] for category in CATEGORIES]
        expected = [(one[metric], *one[f"{metric}_ci"]) for one in of_row]
        expected.append((figures[of_all], *figures[f"{of_all}_ci"]))
        assert list(map(bounds, cells[row])) == expected


def test_rows_of_ones_own_stand_below_the_papers_and_in_every_figure(tmp_path):
    own = ["a_b & 50%", "mine", "mine-n3"]
    made = made_up_run(tmp_path, ["ours", "ours-n3", "verified", *own])
    assert tables.own_rows(made.summary) == own
    table = by_name(every_table(made.summary))["table_1"]
    published = len(read_paper_tables()[0]["rows"])
    # The last published row is the method itself.
    assert list(table.cells.index)[published - 1 :] == ["Ours (K=50)", *own]
    mine = made.summary["methods"]["mine"]
    assert cell(table, "mine", "hydrant Acc30").value == mine["per_category"]["hydrant"]["acc30"]
    assert cell(table, "mine", "Acc30 (%)", PUBLISHED) is None
    curves = tables.error_curves(made).axes[0].get_lines()
    # The first line of each row; a dashed one may follow.
    assert [line.get_label() for line in curves][:5] == ["ours", *own, "verified"]


def frame(rows: dict[str, list], titles: list[str]) -> pd.DataFrame:
    """Cells by row and title."""
    return pd.DataFrame(list(rows.values()), list(rows), titles, dtype=object)


def body_of(table: Table) -> list[list[str]]:
    """The lines between the rules of a LaTeX table, divided into cells."""
    text = as_latex(table)
    lines = text[text.index(r"\toprule") : text.index(r"\bottomrule")].splitlines()
    rows = [re.split(r"(?<!\\)&", line.removesuffix(r" \\")) for line in lines if "&" in line]
    return [[part.strip() for part in row] for row in rows]


def test_a_latex_table_has_three_columns_and_its_texts_have_no_commands():
    rows = {
        "a_b & 50%": [Cell(12.34), Cell(50.0, 40, 60), Cell(-3.21), Cell(1, decimals=0)],
        "none ~^\\{}": [Cell(99.9), None, None, Cell(0.0002, decimals=3)],
        "empty": [None, None, None, Cell(1)],
    }
    cells = frame(rows, ["Med. err. (°)", "Acc30 (%)", "B − A", "pairs"])
    table = Table("mine", "Table 9. 50% & more", cells)
    # The numbers of pairs are left out, and so is the row that has nothing else.
    assert r"\begin{tabular}{lrrr}" in as_latex(table)
    assert body_of(table) == [
        ["", r"Med. err. ($^\circ$)", r"Acc30 (\%)", "B $-$ A"],
        [r"a\_b \& 50\%", "12.3", "50.0", "$-$3.2"],
        [r"none \textasciitilde{}\^{}\textbackslash{}\{\}", "99.9", "--", "--"],
    ]


def test_table_1_has_the_single_categories_that_the_run_has(tmp_path):
    results = {"bicycle/a:0/b:4": {"error": 1.0}}
    made = write_run(tmp_path, {"ours": results, "icp": results}, ["bicycle"])
    table = by_name(every_table(made.summary))["table_1"]
    single = [title for title in table.cells if title.endswith(" Acc30")]
    assert single == ["bicycle Acc30", f"{PUBLISHED}: bicycle Acc30"]


def test_chosen_rows_are_the_rows_of_all_tables_in_their_order(whole, tmp_path):
    rows = ["icp", "verified", "ours"]
    found = by_name(every_table(write_reports(whole.folder, tmp_path, rows=rows)))
    refused(
        "row 'nobody' is not in the run", write_reports, whole.folder, tmp_path, rows=["nobody"]
    )
    assert list(found["all_rows"].cells.index) == rows
    assert list(found["categories_acc30"].cells) == rows
    assert list(found["table_1"].cells.index) == ["ICP", "Ours (K=50)"]
    assert "table_3" not in found


@pytest.fixture
def timed(tmp_path) -> Run:
    """A run whose pairs take 20 ms by ours and 10 ms by icp, with errors of 0 to 160 degrees."""
    results = {}
    for name, step in (("ours", 20), ("icp", 10)):
        results[name] = {
            f"chair/{i}:0/{i + 1}:1": {"error": float(i * step), "seconds": step / 1000}
            for i in range(9)
        }
    return write_run(tmp_path, results, ["chair"])


def test_times_are_milliseconds_per_pair(timed):
    table, first_of_paper, *_ = every_table(timed.summary, ["milliseconds"])
    assert [line[-1] for line in body_of(table)] == ["ms per pair", "20.0", "10.0"]
    assert cell(first_of_paper, "ICP", "ms per pair").value == 10


def test_latex_has_intervals_where_they_are_asked_for(timed):
    table = every_table(timed.summary, ["above150"])[0]
    ours = timed.summary["methods"]["ours"]
    low, high = ours["above150_ci"]
    assert low <= ours["above150"] <= high
    line = f"& {ours['above150']:.1f} [{low:.1f}, {high:.1f}] &"
    assert line in as_latex(table, intervals=True)
    assert "[" not in "".join(body_of(table)[1])


def test_figures_have_truetype_fonts_and_the_size_that_is_asked_for(whole, tmp_path):
    tables.write_figures(whole, tmp_path, ["icp", "ours"], (3.5, 2))
    for name in ("error_curves", "error_distribution"):
        document = (tmp_path / f"{name}.pdf").read_bytes()
        assert b"/MediaBox [ 0 0 252 144 ]" in document  # 72 points per inch
        assert b"/FontFile2" in document
        assert b"/Type3" not in document


def test_csv_has_the_figures_and_their_intervals_in_columns(whole, every):
    figures = whole.summary["methods"]["ours"]
    acc30 = [figures["acc30"], *figures["acc30_ci"]]
    lines = list(csv.DictReader(io.StringIO(tables.as_csv(every["table_3"]))))
    (ours,) = [line for line in lines if line["row"] == "CorrespondSim"]
    columns = ["Acc30 (%)", "Acc30 (%) low", "Acc30 (%) high"]
    assert [ours[name] for name in columns] == [f"{figure:.6g}" for figure in acc30]
    published = [name for name in ours if name.startswith(f"{PUBLISHED}: Acc30 (%)")]
    assert published == [f"{PUBLISHED}: Acc30 (%)"]  # without an interval


def test_markdown_escapes_bars_and_has_no_p_of_zero():
    cells = frame({"c|d": [Cell(0.00001, decimals=3)], "i": [None]}, ["a|b"])
    lines = as_markdown(Table("odd", "x", cells)).splitlines()[2:]  # below the title
    # Titles, rule, and two rows have three bars each; escaped ones do not count.
    assert [re.sub(r"\\\|", "", line).count("|") for line in lines] == [3] * 4
    assert "< 0.001" in lines[2]


def test_each_line_of_the_papers_tables_is_whole_and_of_a_known_row():
    for table in read_paper_tables():
        for line in table["rows"]:
            assert len(line["published"]) == len(table["published"])
            if line["row"]:  # the others have published figures only
                assert resolve(line["row"])


def test_names_with_commas_and_bars_keep_their_pairs(tmp_path):
    names = ["plain", "red,small", 'a "b" | c:7,8']
    pairs = [Pair("mug, cup", *ends) for ends in product(names, (1, 2), names, [(3, 4), (5,)])]
    results = dict.fromkeys([pair.key for pair in pairs], RESULT)
    run = write_run(tmp_path, {"ours": results}, ["mug, cup"], backbone="my net")
    assert set(run.poses("ours")[0]) == set(pairs)
    assert (run.summary["backbone"], run.note) == ("my net", "")


def test_the_note_counts_results_that_tables_leave_out(tmp_path):
    results = {"chair/a:0/b:0": RESULT, "chair/b:0/a:0": RESULT}
    run = write_run(tmp_path, {"ours": results, "mine": {"chair/a:0/b:0": RESULT}})
    assert run.note.startswith("Without 1 of 3 results, which are of other pairs")


def test_a_runs_summary_is_of_the_pairs_and_rows_with_results(tmp_path):
    results = {"chair/a:3/b.c:0,12": RESULT, "lamp/a:0/b:4,6": {"error": 180.0, "failed": "blind"}}
    rows = {"mine": results, "last": {}}
    summary = write_run(tmp_path, rows, ["lamp", "chair", "cup"]).summary
    assert (summary["data"]["categories"], summary["data"]["pairs"]) == (["lamp", "chair"], 2)
    assert list(summary["methods"]) == ["mine"]
    # One pair of two is right, and has the figures of `RESULT`.
    figures = {"failed": 1, "translation": 0.5, "scale": 1.1, "symmetric_acc30": 50}
    assert figures.items() <= summary["methods"]["mine"].items()


@pytest.fixture
def folder(tmp_path) -> Path:
    """The folder of a run of one pair."""
    write_run(tmp_path, {"ours": {"chair/a:0/b:0": {"error": 1.0}}})
    return tmp_path


@pytest.mark.parametrize(
    "name, right, wrong, place",
    [
        (LINES, '"error":1.0', '"error":"1"', ", line 1"),
        (LINES, '"error":1.0', '"error":181', ", line 1"),
        (LINES, "chair/a:0/b:0", "chair/a:0/b", ", line 1"),
        (LINES, "chair/a:0/b:0", "chair/a:0/b/c:0", ", line 1"),
        (SETTINGS, '"calls"', '"call"', ""),
        (SETTINGS, '"targets":5', '"targets":"5"', ""),
    ],
)
def test_results_and_settings_of_another_form_are_refused(folder, name, right, wrong, place):
    path = folder / name
    path.write_text(path.read_text().replace(right, wrong))
    refused(f"{re.escape(str(folder))}.*{place}: ", read_run, folder)


def test_a_damaged_gzip_is_refused(folder):
    packed = folder / f"{LINES}.gz"
    for content in (b"no gzip", gzip.compress((folder / LINES).read_bytes())[:15]):
        packed.write_bytes(content)
        refused(f"{re.escape(str(packed))}.*gzip", read_run, folder)


@pytest.fixture(scope="module")
def halved(whole, tmp_path_factory) -> Run:
    """A run with half the errors of two rows, in which one has no result of the last pair."""
    errors = {
        name: (whole.row(name)[["error"]] / 2).to_dict(orient="index") for name in ("ours", "icp")
    }
    errors["ours"].popitem()
    return write_run(tmp_path_factory.mktemp("halved"), errors)


def test_runs_are_compared_on_the_pairs_that_both_have(whole, halved):
    table = tables.compare(whole, halved)
    assert list(table.cells.index) == ["icp", "ours"]
    assert table.title == f"A = {whole.folder}, B = {halved.folder}"
    b = halved.row("icp").sort_index()
    a = whole.row("icp").loc[b.index]
    pairs, first, second, gain, p, *medians = table.cells.loc["icp"]
    assert pairs.value == 47  # of 48
    known = paired_difference(a["error"], b["error"], weights=draws_of(a))
    assert bounds(gain) == (known["accuracy_gain"], *known["accuracy_gain_ci"])
    assert p.value == known["accuracy_gain_p"]
    assert 0 < gain.value == pytest.approx(second.value - first.value)
    assert [one.value for one in medians] == [np.median(a["error"]), np.median(b["error"])]


def test_rows_of_one_run_are_compared(whole):
    table = tables.compare(whole, whole, ["icp", "ours:icp"])
    assert list(table.cells.index) == ["icp", "ours:icp"]
    assert cell(table, "icp", "p").value == 1  # the same row twice
    *_, p, first, second = [one.value for one in table.cells.loc["ours:icp"]]
    assert 0 < p <= 1
    assert [first, second] == [whole.row(name)["error"].median() for name in ("ours", "icp")]


@pytest.mark.parametrize(
    "rows, message",
    [
        ("ours-n1:ours", "rows ours-n1 and ours have no pair in common"),
        (":ours", "row '.*' is not in the run, expected one of "),
    ],
)
def test_rows_that_cannot_be_compared_are_refused(whole, halved, rows, message):
    refused(message, tables.compare, whole, halved, [rows])


def test_the_curve_of_errors_is_the_share_of_pairs_below_each(whole):
    (axis,) = tables.error_curves(whole, ["ours", "icp"]).axes
    curve = axis.get_lines()[0]
    last_below = np.searchsorted(curve.get_xdata(), 30, side="right") - 1
    share = np.mean(whole.row("ours")["error"] <= 30)
    assert curve.get_ydata()[last_below] == pytest.approx(100 * share)
