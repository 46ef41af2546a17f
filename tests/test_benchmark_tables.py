"""Tables, figures and comparisons of a run that was made up, so that every figure in them is known."""

import csv
import functools
import gzip
import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from zsp_lite.benchmark import figures, published, tables
from zsp_lite.benchmark.compare import compare, comparison_table, split_rows
from zsp_lite.benchmark.formats import as_csv, as_html, as_latex, as_markdown, insert_tables, write_tables
from zsp_lite.benchmark.methods import GROUPS, METHODS
from zsp_lite.benchmark.published import PAPER_TABLES, VERIFIED_TARGETS
from zsp_lite.benchmark.records import add_lines, open_run
from zsp_lite.benchmark.reports import write_reports
from zsp_lite.benchmark.results import Results, export_results, pool, read_results, read_runs
from zsp_lite.benchmark.statistics import bootstrap_ci, object_draws, paired_test
from zsp_lite.benchmark.summary import category_of, draws_of_pairs, objects_of, summarise_run
from zsp_lite.benchmark.tables import PUBLISHED, THIS_RUN, PValue, all_rows, every_table, make_table, paper_tables
from zsp_lite.cli.terminal import as_rich
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy

pytestmark = pytest.mark.slow

CATEGORIES = ("bicycle", "hydrant", "motorcycle", "teddybear", "toaster", "chair")
PAIRS = 8
ROWS = [*GROUPS["table1"], *GROUPS["ablations"], *GROUPS["views"], "ours-bv", "rootsift", "verified"]


def made_up_run(out, rows=ROWS, seed=0, objects=PAIRS):
    """A run's folder with random errors of pairs that share a few objects, other ones for each seed."""
    rng = np.random.default_rng(seed)
    rows = list(dict.fromkeys(rows))
    names = [f"{seed}_{i}" for i in range(objects)]
    pairs = {}
    for name in rows:
        n = METHODS[name].targets if name in METHODS else None
        pairs[name] = [
            Pair(category, names[i % objects], i, names[(i * i + 1) % objects], tuple(range(n or 5)))
            for category in CATEGORIES for i in range(PAIRS)
        ]  # fmt: skip
    settings = {"data": "made up", "seed": seed, "targets": 5, "backbone": "none", "library": {"version": "0"}}
    settings |= {"methods": dict.fromkeys(rows, "x")}
    call = {"command": ["zsp-lite", "benchmark"], "rows": rows, "categories": list(CATEGORIES)}
    with open_run(out, settings):
        add_lines(out, [{"call": call}])
        for name, pair in ((name, pair) for name in rows for pair in pairs[name]):
            found = {"error": float(rng.uniform(0, 180)), "view": 0, "scale": 1.0, "note": "", "inliers": 9}
            add_lines(out, [{"pair": pair.key, "seconds": 1.0, "timings": {}, "results": {name: found}}])
    return read_results(out).summary


@functools.cache
def read_once(out):
    """Summarising all rows takes a second."""
    return read_results(out)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("made-up")
    return out, made_up_run(out)


def cell(table, row, column, group=THIS_RUN):
    return table.cells.loc[row, (group, column)]


def test_a_tables_figures_are_the_runs_and_the_published_ones_stand_apart(run):
    found = {table.name: table for table in paper_tables(run[1])}
    assert list(found) == [*(table.name for table in PAPER_TABLES), "beyond"]
    ours = run[1]["methods"]["ours"]
    acc30 = cell(found["table_1"], "Ours (K=50)", "Acc30 (%)")
    assert (acc30.value, acc30.low, acc30.high) == (ours["acc30"], *ours["acc30_ci"])
    medians = [ours["per_category"][category]["median"] for category in CATEGORIES]
    median = cell(found["table_1"], "Ours (K=50)", "Med. err. (°)")
    assert median.value == pytest.approx(np.mean(medians)) and median.low < median.value < median.high
    assert "ours-n1" in run[1]["against_ours"] and "ours" not in run[1]["against_ours"]
    toasters = run[1]["methods"]["icp"]["per_category"]["toaster"]
    assert cell(found["table_1"], "ICP", "toaster Acc30").value == toasters["acc30"]
    assert cell(found["table_1"], "ICP", "toaster Acc30", PUBLISHED).value == 7.0
    assert cell(found["table_1"], "SWaV", "Acc30 (%)") is None
    assert cell(found["table_1"], "SWaV", "Acc30 (%)", PUBLISHED).value == 7.5
    acc15 = cell(found["table_a_correspondences"], "K = 70", "Acc15 (%)", f"{THIS_RUN}: without k-means")
    assert acc15.value == run[1]["methods"]["ours-k70-nokmeans"]["acc15"]
    assert cell(found["table_a_targets"], "views = 20", "full: Acc30 (%)", PUBLISHED).value == 52.1
    assert list(found["beyond"].cells.index) == ["ours", "rootsift", "verified"]


def test_a_run_of_three_rows_has_no_table_of_what_it_lacks(tmp_path):
    summary = made_up_run(tmp_path, ["ours", "ours-bv", "rootsift"])
    assert [table.name for table in paper_tables(summary)] == ["table_2", "table_a_targets", "table_a_depth", "beyond"]
    assert len(all_rows(summary).cells) == 3
    found = read_results(tmp_path)
    keys = sorted(found.rows["ours"], key=lambda key: (CATEGORIES.index(category_of(key)), key))
    errors = [[found.errors(name)[key] for key in keys] for name in ("rootsift", "ours")]
    test = paired_test(*errors, weights=draws_of_pairs(keys))
    against = summary["against_ours"]["rootsift"]
    assert against == {name: test[name] for name in against} and "accuracy_gain_ci" in against


def test_the_verified_solver_stands_beside_the_papers_by_number_of_views(tmp_path):
    rows = ["ours", "ours-n1", *GROUPS["verified-views"]]
    summary = made_up_run(tmp_path, rows)
    table = next(table for table in paper_tables(summary) if table.name == "verified_targets")
    assert list(table.cells.index) == [f"views = {n}" for n in (1, 3, 5, 10)]
    for n, name in ((1, "verified-mask-n1"), (5, "verified-mask"), (10, "verified-mask-n10")):
        found = cell(table, f"views = {n}", "Acc30 (%)", f"{THIS_RUN}: verified, true mask")
        assert found.value == summary["methods"][name]["acc30"]
    assert cell(table, "views = 3", "Acc30 (%)", f"{THIS_RUN}: the paper's") is None
    left, _ = figures.accuracy_against_views(read_results(tmp_path)).axes
    assert list(left.get_lines()[-1].get_xdata()) == [1, 3, 5, 10]


def test_figures_by_category_are_those_of_the_summary(run):
    found = [*zip(tables.category_tables(run[1]), ("median", "acc30", "acc15"))]
    for table, figure in [*found, (tables.by_category(run[1], ROWS[:2]), None)]:
        for category in CATEGORIES:
            for name in ROWS[:2]:
                at = (name, ("", category)) if figure else (category, ("", name))
                assert table.cells.loc[at].value == run[1]["methods"][name]["per_category"][category][figure or "acc30"]
    with pytest.raises(InputError, match="no row nobody, expected some of icp"):
        tables.by_category(run[1], ["nobody"])


@pytest.mark.parametrize("content", [b"no gzip", gzip.compress(b'{"pairs": []}'), gzip.compress(b"{}")[:15]])
def test_what_is_no_run_is_refused(tmp_path, content):
    (tmp_path / "a.json.gz").write_bytes(content)
    for path in (tmp_path, tmp_path / "a.json.gz", tmp_path / "missing"):
        with pytest.raises(InputError, match=str(path)):
            read_results(path)


def test_all_formats_say_the_same(run, tmp_path):
    table = next(table for table in paper_tables(run[1]) if table.name == "table_3")
    ours = run[1]["methods"]["ours"]
    text = f"{ours['acc30']:.1f} [{ours['acc30_ci'][0]:.1f}, {ours['acc30_ci'][1]:.1f}]"
    lines = list(csv.DictReader(io.StringIO(as_csv(table))))
    assert lines[3]["row"] == "CorrespondSim"
    assert float(lines[3][f"{THIS_RUN}: Acc30 (%)"]) == ours["acc30"]
    assert float(lines[3][f"{THIS_RUN}: Acc30 (%) low"]) == ours["acc30_ci"][0]
    assert f"{PUBLISHED}: Acc30 (%) low" not in lines[0]
    markdown = as_markdown(table).splitlines()
    assert text in markdown[-3] and markdown[2].count("|") == markdown[-3].count("|")
    console = Console(width=250, file=io.StringIO())
    console.print(as_rich(table))
    for other in (as_latex(table), as_html(table), console.file.getvalue()):
        assert all(part in other for part in (*text.split(" ", 1), "46.3", "CorrespondSim"))
    written = write_tables([table] * 2, tmp_path)
    assert len(written) == 2 * 4 + 1 and all(path.stat().st_size for path in written)
    assert written[-1].read_text().count("<table") == 2


def test_a_document_gets_the_tables_that_it_has_marks_for(run):
    first, second = (f"<!-- table {name} -->\nold\n<!-- end of table -->\n" for name in ("table_1", "table_3"))
    text = f"before\n{first}between\n{second}"
    once = insert_tables(text, every_table(run[1]), 1234)
    assert "old" not in once and once.startswith("before\n<!-- table table_1 -->\n**Table 1.") and "between" in once
    assert f"{run[1]['methods']['ours']['acc30']:.1f}" in once and "hydrant" not in once
    assert insert_tables(once, every_table(run[1]), 1234) == once
    assert "old" not in insert_tables(text.replace("\n", "\r\n"), every_table(run[1]), 1234)
    lost = text.replace("<!-- end of table -->\nbetween", "between")
    for wrong, told in (
        ("no marks", "marks of no table"),
        (text.replace("table_3", "table_9"), "marks .*table_9"),
        (lost, "has the marks table table_1, table table_3, end of table, expected"),
        (text[: text.rindex("<!--")], "for each table"),
        (text[text.index("old") :], "for each table"),
    ):
        with pytest.raises(InputError, match=told):
            insert_tables(wrong, every_table(run[1]), 1234)


def test_the_papers_figures_were_copied_right():
    assert published.TABLE_1["Ours (K=50)"] == ("ours", 53.8, 46.3, 31.1, 71.0, 26.0, 82.0, 39.0, 42.0)
    for table in (*PAPER_TABLES, VERIFIED_TARGETS):
        for line in table.rows.values():
            rows, values = line[: len(table.groups)], line[len(table.groups) :]
            assert METHODS.keys() >= {row.removesuffix("-n5") for row in rows} and len(values) == len(table.published)
            assert all(0 <= value <= 180 for value in values)


def test_a_run_in_one_file_gives_the_same_tables(run, tmp_path):
    out, summary = run
    first = export_results(read_once(out), tmp_path / "results.json.gz")
    again = read_results(first)
    assert again.summary == summary and again.invocations[0]["command"] == ["zsp-lite", "benchmark"]
    errors = read_once(out).errors("ours")
    assert again.errors("ours") == pytest.approx(errors, abs=1e-4) and list(again.errors("ours")) == list(errors)
    assert export_results(again, tmp_path / "again.json.gz").read_bytes() == first.read_bytes()
    with pytest.raises(InputError, match="nonesuch"):
        again.errors("nonesuch")


def test_runs_are_compared_on_the_pairs_that_both_have(run, tmp_path):
    first = read_once(run[0])
    rows = {
        name: {key: {"error": one["error"] / 2} for key, one in first.rows[name].items()} for name in ("ours", "icp")
    }
    second = Results({}, {}, [], rows)
    second.rows["ours"].pop(next(iter(second.rows["ours"])))
    found = {one.first: one for one in compare(first, second)}
    assert set(found) == {"ours", "icp"} and found["ours"].n == 47 and found["icp"].n == 48
    a, b = first.errors("icp"), second.errors("icp")
    keys = sorted(a)
    test = paired_test([a[key] for key in keys], [b[key] for key in keys], weights=draws_of_pairs(keys))
    assert found["icp"].test == test
    assert found["icp"].acc30[1] - found["icp"].acc30[0] == pytest.approx(test["accuracy_gain"])
    (mixed,) = compare(first, first, [("ours", "icp")])
    table = comparison_table([mixed], "a", "b")
    assert list(table.cells.index) == ["ours:icp"]
    heading, rule, line = as_markdown(replace(table, cells=table.cells.set_axis(["a|b"]))).splitlines()[2:5]
    assert len({text.replace("\\|", "").count("|") for text in (heading, rule, line)}) == 1
    with pytest.raises(InputError, match="pair in common"):
        compare(first, second, [("ours-n1", "ours")])
    with pytest.raises(InputError, match="row in common"):
        compare(Results({}, {}, [], {"x": {}}), second)


def test_rows_to_compare_may_have_colons_in_their_names():
    first, second = (Results({}, {}, [], dict.fromkeys(names, {})) for names in (("ours", "my:row"), ("ours", "a:b:c")))
    assert split_rows("ours", first, second) == ("ours", "ours")
    assert split_rows("my:row:ours", first, second) == ("my:row", "ours")
    assert split_rows("my:row:a:b:c", first, second) == ("my:row", "a:b:c")
    for text in ("my:row", "ours:", "", ":ours", "ours:my:row"):
        with pytest.raises(InputError, match="not in the runs, expected A:B or A with A one of ours, my:row and B"):
            split_rows(text, first, second)


def test_runs_on_different_objects_are_pooled(tmp_path):
    rows = ["ours", "ours-bv", "icp"]
    for seed in (0, 1, 2):
        made_up_run(tmp_path / str(seed), rows[: 3 - (seed == 2)], seed)
    runs = [read_results(tmp_path / str(seed)) for seed in (0, 1, 2)]
    pooled = pool(runs)
    assert list(pooled.rows) == ["ours", "ours-bv"]
    row = pooled.summary["methods"]["ours"]
    errors = {key: error for run in runs for key, error in run.errors("ours").items()}
    assert row["n"] == len(errors) == 3 * 48
    assert row["acc30"] == pytest.approx(np.mean([run.summary["methods"]["ours"]["acc30"] for run in runs]))
    objects, categories = [objects_of(key) for key in errors], [category_of(key) for key in errors]
    weights = object_draws(objects, categories)
    expected = bootstrap_ci(list(errors.values()), lambda e, w: accuracy(e, 30, w), weights)
    assert row["acc30_ci"] == pytest.approx(list(expected))
    single = runs[0].summary["methods"]["ours"]["acc30_ci"]
    assert row["acc30_ci"][1] - row["acc30_ci"][0] < 0.8 * (single[1] - single[0])
    assert read_runs([tmp_path / "0"]).summary == runs[0].summary
    write_reports([tmp_path / "0", tmp_path / "1"], tmp_path / "pooled")
    assert read_results(tmp_path / "pooled" / "results.json.gz").summary["methods"]["icp"]["n"] == 96


def test_runs_that_are_not_of_one_benchmark_are_not_pooled(tmp_path):
    made_up_run(tmp_path / "0", ["ours"])
    one = read_results(tmp_path / "0")
    with pytest.raises(InputError, match="share 48 pairs of row ours"):
        pool([one, one])
    for settings, told in (
        ({"backbone": "other"}, "differ in backbone: none, other"),
        ({"targets": 3}, "differ in targets"),
        ({"methods": {"ours": "y"}}, "differ in row ours"),
    ):
        with pytest.raises(InputError, match=told):
            pool([one, replace(one, settings=one.settings | settings)])
    with pytest.raises(InputError, match="no row in common"):
        pool([one, Results({}, {}, [], {"x": {}})])


@pytest.mark.parametrize(("p", "text"), [(0.0004, "< 0.001"), (1e-30, "< 0.001"), (0.0123, "0.012"), (1.0, "1.000")])
def test_small_p_values_are_not_printed_as_zero(p, text):
    assert f"| {text} |" in as_markdown(make_table("t", "T", [("", "p")], {"ours": [PValue(p)]}))


def test_figures_show_every_pair_every_number_of_views_and_every_row(run, tmp_path):
    results = read_once(run[0])
    (axis,) = figures.error_distribution(results).axes
    assert sum(len(points.get_offsets()) for points in axis.collections) == 48
    assert [label.get_text() for label in axis.get_yticklabels()] == sorted(CATEGORIES, reverse=True)
    left, right = figures.accuracy_against_views(results).axes
    line = left.get_lines()[0]
    assert list(line.get_xdata()) == [1, 3, 5, 10, 20]
    assert line.get_ydata()[2] == results.summary["methods"]["ours-n5"]["acc30"]
    assert list(right.get_lines()[1].get_ydata()) == [13.4, 26.2, 31.1, 38.2, 38.3]
    (axis,) = figures.error_curves(results, ["ours", "icp"]).axes
    curve = axis.get_lines()[0]
    errors = np.array(list(results.errors("ours").values()))
    height = curve.get_ydata()[np.searchsorted(curve.get_xdata(), 30, side="right") - 1]
    assert height == pytest.approx(100 * np.mean(errors <= 30))
    made_up_run(tmp_path / "few", ["ours"])
    few = read_results(tmp_path / "few")
    assert {path.stem for path in figures.write_figures(few, tmp_path / "f")} == {"error_distribution", "error_curves"}
    write_reports(run[0], tmp_path / "all")
    assert len(list((tmp_path / "all" / "figures").glob("*.png"))) == 3
    assert (tmp_path / "all" / "results.json.gz").is_file()


def test_confidences_are_kept_and_drawn_where_a_row_states_them(run, tmp_path):
    with pytest.raises(InputError, match="reliability: no row has 20 confidences"):
        figures.reliability_diagram(read_once(run[0]))
    rng = np.random.default_rng(0)
    sure = rng.random(200)
    right = rng.random(200) < sure
    rows = {
        f"chair/a:{i}/b:0,1": {"error": 5.0 if ok else 90.0, "confidence": c}
        for i, (c, ok) in enumerate(zip(sure, right, strict=True))
    }
    both = {"ours": {"chair/a:0/b:0,1": {"error": 1.0}}, "verified": rows}
    data = {"root": "", "categories": ["chair"], "pairs": 200, "targets": 2}
    written = Results(summarise_run(both, {}, data, "none"), {}, [], both)
    results = read_results(export_results(written, tmp_path / "results.json.gz"))
    assert results.confidences("ours") == {}
    np.testing.assert_allclose(list(results.confidences("verified").values()), sure, atol=1e-4)
    figure = figures.reliability_diagram(results)
    line = figure.axes[0].lines[1]  # after the diagonal
    order = np.argsort(sure)
    np.testing.assert_allclose(line.get_xdata(), sure[order].reshape(10, 20).mean(1), atol=1e-3)
    np.testing.assert_allclose(line.get_ydata(), right[order].reshape(10, 20).mean(1))
    assert f"(all: {100 * right.mean():.0f} %)" in figure.axes[0].get_title()


def made_up_answers():
    """A run of four pairs: of the row "verified", the second pose is right where the first is not, but for one pair."""
    answers = [
        {"error": 10.0, "second_error": 170.0, "one_of_two": False},
        {"error": 175.0, "second_error": 5.0, "one_of_two": True},
        {"error": 120.0, "second_error": 90.0, "one_of_two": True},
        {"error": 180.0, "failed": "no depth"},
    ]
    keys = [Pair("chair", f"a{i}", 0, f"b{i}", (0,)).key for i in range(4)]
    rows = {"ours": {key: {"error": 40.0} for key in keys}, "verified": dict(zip(keys, answers))}
    data = {"root": "", "categories": ["chair"], "pairs": 4, "targets": 1}
    return Results(summarise_run(rows, {}, data, "none"), {}, [], rows)


def test_right_if_one_of_the_two_is_right_has_a_table_of_its_own():
    results = made_up_answers()
    verified = results.summary["methods"]["verified"]
    assert verified["acc30"] == 25  # is what it was without alternatives
    best_two = dict(verified["best_two"])
    low, high = best_two.pop("acc30_ci")
    assert 0 <= low < 50 < high <= 100
    assert best_two == {"acc30": 50, "one_of_two": 2, "one_of_two_acc30": 50, "one_of_two_first_acc30": 0}
    (table,) = tables.best_two_tables(results.summary)
    assert list(table.text.index) == ["verified"] and "not comparable with Acc30" in table.note
    assert list(table.text.loc["verified"])[2:] == ["2", "50.0", "0.0"]
    assert table.name in [one.name for one in every_table(results.summary)]


def test_the_second_errors_survive_the_export_and_are_checked(tmp_path):
    results = made_up_answers()
    again = read_results(export_results(results, tmp_path / "results.json.gz"))
    assert again.summary == results.summary
    for key, found in results.rows["verified"].items():
        assert again.rows["verified"][key] == found
    key = next(iter(results.rows["verified"]))
    results.rows["verified"][key]["second_error"] = 200.0
    with pytest.raises(InputError, match=r"Expected `float` <= 180.0 - at `\$.*\.second_error`"):
        read_results(export_results(results, tmp_path / "wrong.json.gz"))
    results.rows["verified"][key] |= {"second_error": 20.0, "one_of_two": "yes"}
    with pytest.raises(InputError, match=r"Expected `bool`, got `str` - at `\$.*\.one_of_two`"):
        read_results(export_results(results, tmp_path / "wrong.json.gz"))
