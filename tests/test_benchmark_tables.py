"""Tables, figures and comparisons of a run that was made up, so that every figure in them
is known."""

import csv
import gzip
import io
import re

import numpy as np
import pandas as pd
import pytest
from benchmark_folder import CATEGORIES, made_up_run, write_run
from refusals import refused

from zsp_lite.benchmark import tables
from zsp_lite.benchmark.methods import read_paper_tables, resolve
from zsp_lite.benchmark.runs import LINES, SETTINGS, read_run
from zsp_lite.benchmark.statistics import draws_of, paired_difference
from zsp_lite.benchmark.tables import (
    PUBLISHED,
    Cell,
    all_rows,
    as_latex,
    as_markdown,
    every_table,
    paper_tables,
)
from zsp_lite.choices import METRICS, METRICS_SHOWN
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError

pytestmark = pytest.mark.slow

ROWS = list(resolve(["table1", "ablations", "views", "ours-bv", "rootsift", "verified"]))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return made_up_run(tmp_path_factory.mktemp("made-up"), ROWS)


def cell(table, row, column, group=""):
    return table.cells.loc[row, f"{group}: {column}" if group else column]


def test_a_tables_figures_are_the_runs_and_the_published_ones_stand_apart(run):
    found = {table.name: table for table in paper_tables(run.summary)}
    assert [*found] == [one["name"] for one in read_paper_tables()][:-1]
    methods = run.summary["methods"]
    acc30 = cell(found["table_1"], "Ours (K=50)", "Acc30 (%)")
    assert (acc30.value, acc30.low, acc30.high) == (
        methods["ours"]["acc30"],
        *methods["ours"]["acc30_ci"],
    )
    medians = [methods["ours"]["per_category"][category]["median"] for category in CATEGORIES]
    median = cell(found["table_1"], "Ours (K=50)", "Med. err. (°)")
    assert (
        median.value == pytest.approx(np.mean(medians)) and median.low < median.value < median.high
    )
    assert (
        cell(found["table_1"], "ICP", "toaster Acc30").value
        == methods["icp"]["per_category"]["toaster"]["acc30"]
    )
    assert cell(found["table_1"], "ICP", "toaster Acc30", PUBLISHED).value == 7.0
    assert cell(found["table_1"], "SWaV", "Acc30 (%)") is None
    acc15 = cell(found["table_a_correspondences"], "K = 70, no k-means", "Acc15 (%)")
    assert acc15.value == methods["ours-k70-nokmeans"]["acc15"]


def test_a_run_of_three_rows_has_the_tables_of_these_with_chosen_metrics_and_differences_to_ours(
    tmp_path,
):
    made = made_up_run(tmp_path, ["ours", "ours-bv", "rootsift"])
    names = [table.name for table in paper_tables(made.summary)]
    assert names == ["table_2", "table_a_targets", "table_a_depth"]
    ours, other = made.row("ours"), made.row("rootsift")
    test = paired_difference(ours["error"], other["error"], weights=draws_of(ours))
    assert made.summary["against"]["rootsift"] == test
    table = all_rows(made.summary)
    titles = ["pairs", *(METRICS[name] for name in METRICS_SHOWN), "failed", "Acc30 − ours", "p"]
    assert (
        list(table.cells.index) == ["ours", "ours-bv", "rootsift"] and list(table.cells) == titles
    )
    gain, p = cell(table, "rootsift", "Acc30 − ours"), cell(table, "rootsift", "p")
    acc30 = [made.summary["methods"][name]["acc30"] for name in ("ours", "rootsift")]
    assert gain.value == pytest.approx(acc30[1] - acc30[0]) and gain.low <= gain.value <= gain.high
    assert p.value == test["accuracy_gain_p"] and cell(table, "ours", "p") is None
    table, errors = all_rows(made.summary, ["above150", "median"]), other["error"]
    assert (
        list(table.cells)[1:3] == ["above 150° (%)", "pooled med. err. (°)"]
        and "Med. err." not in table.note
    )
    found = [cell(table, "rootsift", title).value for title in list(table.cells)[1:3]]
    assert found == pytest.approx([100 * np.mean(errors > 150), np.median(errors)])
    assert every_table(made.summary, ["acc30"])[0].cells.shape[1] == 5


def test_rows_that_see_more_stand_apart_from_those_that_see_the_pair_only(tmp_path):
    made = made_up_run(
        tmp_path, ["ours", "category", "scans-8", "verified", "category-n3", "scans-2"]
    )
    found = {table.name: table for table in every_table(made.summary)}
    assert found["with_others"].title == "With other unlabelled objects of the category"
    assert list(found["with_others"].cells.index) == ["verified", "category", "category-n3"]
    assert found["with_scans"].title == "With several frames of the reference object"
    assert list(found["with_scans"].cells.index) == ["verified", "scans-8", "scans-2"]
    rows = [list(found["all_rows"].cells.index), list(found["categories_acc30"].cells)]
    assert rows == [["ours", "verified"]] * 2 == [tables.important_rows(made.summary)] * 2
    names = [
        table.name for table in every_table(made_up_run(tmp_path / "alone", ["category"]).summary)
    ]
    assert (
        names[0] == "with_others" and not {"all_rows", "with_scans"} & {*names} and len(names) == 4
    )


def test_figures_by_category_are_those_of_the_summary(run):
    found = {table.name: table for table in every_table(run.summary)}
    methods, rows = run.summary["methods"], tables.important_rows(run.summary)
    assert rows[:3] == ["ours", "ours-bv", "verified"] and sorted(rows) == sorted(methods)
    assert list(tables.by_category(run.summary, most=3).cells.columns) == rows[:3]
    for metric, of_category in (
        ("mean_category_median", "median"),
        ("acc30", "acc30"),
        ("acc15", "acc15"),
    ):
        table = found[f"categories_{metric.removeprefix('mean_category_')}"]
        assert list(table.cells.index) == [*CATEGORIES, "all"] and list(table.cells) == rows
        for name in rows:
            of_row = [methods[name]["per_category"][category] for category in CATEGORIES]
            known = [(one[of_category], *one[f"{of_category}_ci"]) for one in of_row]
            known.append((methods[name][metric], *methods[name][f"{metric}_ci"]))
            assert [(one.value, one.low, one.high) for one in table.cells[name]] == known


def test_rows_of_ones_own_stand_below_the_papers_and_in_every_figure(run, tmp_path):
    names = ["ours", "ours-n3", "verified", "a_b & 50%", "mine", "mine-n3"]
    made = made_up_run(tmp_path, names)
    assert tables.own_rows(made.summary) == names[3:] and not tables.own_rows(run.summary)
    (table,) = (table for table in paper_tables(made.summary) if table.name == "table_1")
    assert list(table.cells.index)[-4:] == ["Ours (K=50)", *names[3:]] and len(table.cells) == 10
    mine = made.summary["methods"]["mine"]
    assert cell(table, "mine", "Acc30 (%)").value == mine["acc30"]
    assert cell(table, "mine", "hydrant Acc30").value == mine["per_category"]["hydrant"]["acc30"]
    assert cell(table, "mine", "Acc30 (%)", PUBLISHED) is None
    curves = tables.error_curves(made).axes[0].get_lines()
    assert [line.get_label() for line in curves][:5] == ["ours", *names[3:], "verified"]


def frame(rows, titles):
    return pd.DataFrame(list(rows.values()), list(rows), titles, dtype=object)


def body_of(table):
    """The lines between the rules of a LaTeX table, divided into cells."""
    text = as_latex(table)
    lines = text[text.index(r"\toprule") : text.index(r"\bottomrule")].splitlines()
    rows = [re.split(r"(?<!\\)&", line.removesuffix(r" \\")) for line in lines if "&" in line]
    return [[part.strip() for part in row] for row in rows]


def test_a_latex_table_has_four_columns_without_commands_in_its_texts():
    rows = {
        "a_b & 50%": [Cell(12.34), Cell(50.0, 40, 60), Cell(-3.21), Cell(1, decimals=0)],
        "none ~^\\{}": [Cell(99.9), None, None, Cell(0.0002, decimals=3)],
        "empty": [None, None, None, Cell(1)],
    }
    cells = frame(rows, ["Med. err. (°)", "Acc30 (%)", "B − A", "pairs"])
    table = tables.Table("mine", "Table 9. 50% & more", cells, data="my_data, 3 pairs")
    text = as_latex(table)
    assert r"\caption{50\% \& more. my\_data, 3 pairs}" in text  # LaTeX writes the number
    assert r"\label{tab:mine}" in text and r"\begin{tabular}{lrrr}" in text
    assert all(rule in text for rule in (r"\toprule", r"\midrule", r"\bottomrule"))
    assert body_of(table) == [
        ["", r"Med. err. ($^\circ$)", r"Acc30 (\%)", "B $-$ A"],
        [r"a\_b \& 50\%", "12.3", "50.0", "$-$3.2"],
        [r"none \textasciitilde{}\textasciicircum{}\textbackslash{}\{\}", "99.9", "--", "--"],
    ]


def test_table_1_has_the_single_categories_that_the_run_has(tmp_path):
    made = write_run(
        tmp_path,
        {name: {"bicycle/a:0/b:4": {"error": 1.0}} for name in ("ours", "icp")},
        ["bicycle"],
    )
    (table,) = paper_tables(made.summary)
    single = [title for title in table.cells if title.endswith(" Acc30")]
    assert single == ["bicycle Acc30", f"{PUBLISHED}: bicycle Acc30"]


def test_chosen_rows_are_the_rows_of_all_tables_in_their_order(run):
    rows = ["icp", "verified", "ours"]
    found = {table.name: table for table in every_table(tables.choose(run, rows))}
    assert list(found["all_rows"].cells.index) == list(found["categories_acc30"].cells) == rows
    assert list(found["table_1"].cells.index) == ["ICP", "Ours (K=50)"] and "table_3" not in found
    gain = cell(found["all_rows"], "icp", "Acc30 − ours").value
    assert gain == run.summary["against"]["icp"]["accuracy_gain"]
    refused(
        "row 'nobody' is not in the run, expected one of icp, ",
        tables.choose,
        run,
        ["ours", "nobody"],
    )


def test_latex_has_intervals_and_times_where_they_are_asked_for(tmp_path):
    pairs = [f"chair/{i}:0/{i + 1}:1" for i in range(9)]
    made = write_run(
        tmp_path,
        {
            name: {
                key: {"error": float(i * step), "seconds": step / 1000}
                for i, key in enumerate(pairs)
            }
            for name, step in (("ours", 20), ("icp", 10))
        },
        ["chair"],
    )
    table, first_of_paper, *_ = every_table(made.summary, ["above150", "milliseconds"])
    ours = made.summary["methods"]["ours"]
    low, high = ours["above150_ci"]
    assert (
        low <= ours["above150"] <= high
        and ours["auc30_ci"][0] < ours["auc30"] < ours["auc30_ci"][1]
    )
    tables.write_tables([table], tmp_path, intervals=True)
    assert (
        f"ours & {ours['above150']:.1f} [{low:.1f}, {high:.1f}] & "
        in (tmp_path / "all_rows.tex").read_text()
    )
    heading, first, second = body_of(table)
    assert [heading[-1], first[-1], second[-1]] == [
        "ms per pair",
        "20.0",
        "10.0",
    ] and "[" not in first[1]
    assert cell(first_of_paper, "ICP", "ms per pair").value == 10


def test_figures_have_truetype_fonts_and_the_size_that_is_asked_for(run, tmp_path):
    tables.write_figures(run, tmp_path, ["icp", "ours"], (3.5, 2))
    for name in ("error_curves", "error_distribution"):
        document = (tmp_path / f"{name}.pdf").read_bytes()
        assert (
            b"/FontFile2" in document
            and b"/Type3" not in document
            and b"/MediaBox [ 0 0 252 144 ]" in document
        )


def test_all_formats_say_the_same(run):
    table = next(table for table in paper_tables(run.summary) if table.name == "table_3")
    ours = run.summary["methods"]["ours"]
    text = f"{ours['acc30']:.1f} [{ours['acc30_ci'][0]:.1f}, {ours['acc30_ci'][1]:.1f}]"
    lines = list(csv.DictReader(io.StringIO(tables.as_csv(table))))
    assert lines[3]["row"] == "CorrespondSim"
    assert (
        lines[3]["Acc30 (%)"] == f"{ours['acc30']:.6g}"
        and lines[3]["Acc30 (%) low"] == f"{ours['acc30_ci'][0]:.6g}"
    )
    assert f"{PUBLISHED}: Acc30 (%) low" not in lines[0] and f"{PUBLISHED}: Acc30 (%)" in lines[0]
    markdown = as_markdown(table).splitlines()
    assert text in markdown[-3] and markdown[2].count("|") == markdown[-3].count("|")
    odd = tables.Table(
        "odd", "x", frame({"c|d": [Cell(0.00001, decimals=3)], "i": [None]}, ["a|b"])
    )
    heading, rule, *lines = as_markdown(odd).splitlines()[2:]
    assert {re.sub(r"\\\|", "", line).count("|") for line in (heading, rule, *lines)} == {
        3
    } and "< 0.001" in lines[0]


def test_the_papers_figures_were_copied_right():
    ours = read_paper_tables()[0]["rows"][-1]
    assert ours["row"] == "ours" and ours["published"] == [
        53.8,
        46.3,
        31.1,
        71.0,
        26.0,
        82.0,
        39.0,
        42.0,
    ]
    for table in read_paper_tables():
        assert all(len(line["published"]) == len(table["published"]) for line in table["rows"])
        # The other rows have published figures only.
        assert all(resolve(line["row"]) for line in table["rows"] if line["row"])


def test_a_runs_table_has_the_parts_of_each_result_and_of_each_pairs_key(tmp_path):
    result = {
        "error": 10.0,
        "symmetric_error": 5.0,
        "translation": 0.5,
        "scale": 1.1,
        "view": 1,
        "inliers": 9,
        "seconds": 2.0,
        "note": "flat",
        "confidence": 0.7,
        "rotation": np.eye(3).ravel().tolist(),
        "position": [1.0, 2.0, 3.0],
    }
    results = {
        "chair/a:3/b.c:0,12": result,
        "lamp/a:0/b:4,6": {"error": 180.0, "failed": "no depth"},
    }
    made = write_run(tmp_path, {"mine": results, "last": {}}, ["lamp", "chair", "cup"])
    second, first = made.table.to_dict("records")
    known = {
        "row": "mine",
        "pair": "chair/a:3/b.c:0,12",
        "problem": "chair/a:3/b.c",
        "category": "chair",
    }
    known |= {
        "repeat": 0,
        "reference": "chair/a",
        "target": "chair/b.c",
        "failed": "",
        "milliseconds": 2000,
    }
    assert first == result | known
    assert (second["category"], second["error"], second["failed"], second["note"]) == (
        "lamp",
        180,
        "no depth",
        "",
    )
    assert made.summary["data"] == {
        "root": "made up",
        "categories": ["lamp", "chair"],
        "pairs": 2,
        "targets": 5,
    }
    mine = made.summary["methods"]["mine"]
    assert mine["failed"] == 1 and (
        mine["translation"],
        mine["scale"],
        mine["symmetric_acc30"],
    ) == (0.5, 1.1, 50)
    assert cell(every_table(made.summary, ["milliseconds"])[0], "mine", "ms per pair").value == 2000
    (pair,), (view,), rotations, positions = made.poses("mine")
    assert (
        pair == Pair("chair", "a", 3, "b.c", (0, 12))
        and pair.key == "chair/a:3/b.c:0,12"
        and view == 1
    )
    assert rotations.tolist() == [np.eye(3).tolist()] and positions.tolist() == [[1, 2, 3]]
    assert made.summary["backbone"] == "none" and list(made.summary["methods"]) == ["mine"]


def test_what_is_no_run_is_refused(tmp_path):
    write_run(tmp_path, {"ours": {"chair/a:0/b:0": {"error": 1.0}}})
    path, packed, whole = (
        tmp_path / LINES,
        tmp_path / f"{LINES}.gz",
        (tmp_path / LINES).read_bytes(),
    )
    refused("row 'ours' has no poses in the run", read_run(tmp_path).poses, "ours")
    errors = (
        b"[]",
        b'"error":"1"',
        b'"error":-1',
        b'"error":181',
        b'"error":null',
        b'"error":1,"confidence":2',
    )
    errors += b'"error":1,"rotation":[1]', b'"error":1,"position":[1,2,3,4]'
    keys = b"chair/a:0/b", b"a:0/b:0", b"chair/a:0/b:0,", b"chair/a:0/b/c:0"
    changed = [(b'"error":1.0', new) for new in errors] + [(b"chair/a:0/b:0", new) for new in keys]
    for old, new in changed:
        path.write_bytes(whole.replace(old, new))
        refused(f"{re.escape(str(tmp_path))}, line 1: ", read_run, tmp_path)
    for content, told in (
        (b"no gzip", f"{re.escape(str(packed))}.*gzip"),
        (gzip.compress(whole)[:15], f"{re.escape(str(packed))}.*gzip"),
    ):
        packed.write_bytes(content)
        refused(told, read_run, tmp_path)
    settings = (tmp_path / SETTINGS).read_bytes()
    for new in (
        b"{}",
        settings.replace(b'"calls"', b'"call"'),
        settings.replace(b'"targets": 5', b'"targets": "5"'),
    ):
        (tmp_path / SETTINGS).write_bytes(new)
        refused(re.escape(f"{tmp_path / SETTINGS}: "), read_run, tmp_path)


def test_runs_are_compared_on_the_pairs_that_both_have(run, tmp_path):
    halves = {
        name: (run.row(name)[["error"]] / 2).to_dict(orient="index") for name in ("ours", "icp")
    }
    halves["ours"].popitem()
    other = write_run(tmp_path / "b", halves)
    found = tables.compare(run, other)
    assert list(found.cells.index) == ["icp", "ours"] and found.title == "A = A, B = B"
    b = other.row("icp").sort_index()
    a = run.row("icp").loc[b.index]
    pairs, first, second, gain, p, *medians = found.cells.loc["icp"]
    known = paired_difference(a["error"], b["error"], weights=draws_of(a))
    assert [gain.value, gain.low, gain.high, p.value] == [
        known["accuracy_gain"],
        *known["accuracy_gain_ci"],
        known["accuracy_gain_p"],
    ]
    assert (
        pairs.value == 47
        and second.value - first.value == pytest.approx(gain.value)
        and gain.value > 0
    )
    assert [one.value for one in medians] == [np.median(a["error"]), np.median(b["error"])]
    table = tables.compare(run, run, ["icp", "ours:icp"], ("x", "y"))
    assert table.title == "A = x, B = y" and list(table.cells.index) == ["icp", "ours:icp"]
    pairs, a, b, gain, p, *medians = (one.value for one in table.cells.loc["ours:icp"])
    assert pairs == 48 and 0 < p <= 1 and gain == pytest.approx(b - a)
    assert cell(table, "icp", "p").value == 1
    assert medians == [run.row(name)["error"].median() for name in ("ours", "icp")]
    refused(
        "rows ours-n1 and ours have no pair in common", tables.compare, run, other, ["ours-n1:ours"]
    )
    for text in ("ours:", ":ours", "nobody:ours", "rootsift"):
        refused("row '.*' is not in the run, expected one of ", tables.compare, run, other, [text])
    with pytest.raises(InputError, match="no row in common: icp, .* and nobody"):
        tables.compare(run, write_run(tmp_path / "c", {"nobody": halves["icp"]}))


def test_figures_show_every_pair_and_every_row(run):
    (axis,) = tables.error_distribution(run).axes
    # and the medians
    assert sum(len(points.get_offsets()) for points in axis.collections) == 48 + len(CATEGORIES)
    assert [label.get_text() for label in axis.get_yticklabels()] == sorted(CATEGORIES)
    (axis,) = tables.error_curves(run, ["ours", "icp"]).axes
    curve = axis.get_lines()[0]
    height = curve.get_ydata()[np.searchsorted(curve.get_xdata(), 30, side="right") - 1]
    assert height == pytest.approx(100 * np.mean(run.row("ours")["error"] <= 30))
