"""Tables, figures and comparisons of a run that was made up, so that every figure in them is known."""

import csv
import gzip
import io
import json
import re

import numpy as np
import pytest
from benchmark_folder import CATEGORIES, made_up_run, write_run
from rich.console import Console

from zsp_lite.benchmark import figures, tables
from zsp_lite.benchmark.compare import compare, comparison_table, split_rows, write_reports
from zsp_lite.benchmark.methods import GROUPS, resolve
from zsp_lite.benchmark.runs import export_run, read_run, read_runs
from zsp_lite.benchmark.statistics import bootstrap_ci, object_draws, paired_difference
from zsp_lite.benchmark.summary import draws_of
from zsp_lite.benchmark.tables import PUBLISHED, Cell, all_rows, as_latex, as_markdown, every_table, paper_tables
from zsp_lite.choices import METRICS, METRICS_SHOWN
from zsp_lite.cli.terminal import as_rich
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy

pytestmark = pytest.mark.slow

ROWS = [*GROUPS["table1"], *GROUPS["ablations"], *GROUPS["views"], "ours-bv", "rootsift", "verified"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return made_up_run(tmp_path_factory.mktemp("made-up"), ROWS)


def cell(table, row, column, group="this run"):
    return table.cells.loc[row, (group, column)]


def test_a_tables_figures_are_the_runs_and_the_published_ones_stand_apart(run):
    found = {table.name: table for table in paper_tables(run.summary)}
    assert [*found][:-1] == [one["name"] for one in tables.read_paper_tables() if not one["prefix"]]
    methods = run.summary["methods"]
    acc30 = cell(found["table_1"], "Ours (K=50)", "Acc30 (%)")
    assert (acc30.value, acc30.low, acc30.high) == (methods["ours"]["acc30"], *methods["ours"]["acc30_ci"])
    medians = [methods["ours"]["per_category"][category]["median"] for category in CATEGORIES]
    median = cell(found["table_1"], "Ours (K=50)", "Med. err. (°)")
    assert median.value == pytest.approx(np.mean(medians)) and median.low < median.value < median.high
    assert cell(found["table_1"], "ICP", "toaster Acc30").value == methods["icp"]["per_category"]["toaster"]["acc30"]
    assert cell(found["table_1"], "ICP", "toaster Acc30", PUBLISHED).value == 7.0
    assert cell(found["table_1"], "SWaV", "Acc30 (%)") is None
    assert cell(found["table_1"], "SWaV", "Acc30 (%)", PUBLISHED).value == 7.5
    acc15 = cell(found["table_a_correspondences"], "K = 70", "Acc15 (%)", "this run: without k-means")
    assert acc15.value == methods["ours-k70-nokmeans"]["acc15"]
    assert cell(found["table_a_targets"], "views = 20", "full: Acc30 (%)", PUBLISHED).value == 52.1
    assert list(found["beyond"].cells.index) == ["ours", "rootsift", "verified"]


def test_a_run_of_three_rows_has_the_tables_of_these_with_chosen_metrics_and_differences_to_ours(tmp_path):
    made = made_up_run(tmp_path, ["ours", "ours-bv", "rootsift"])
    names = [table.name for table in paper_tables(made.summary)]
    assert names == ["table_2", "table_a_targets", "table_a_depth", "beyond"]
    ours, other = made.row("ours"), made.row("rootsift")
    test = paired_difference(ours["error"], other["error"], weights=draws_of(ours))
    assert made.summary["against"]["rootsift"] == test
    table = all_rows(made.summary)
    titles = ["pairs", *(METRICS[name] for name in METRICS_SHOWN), "failed", "Acc30 − ours", "p"]
    assert list(table.cells.index) == ["ours", "ours-bv", "rootsift"] and [title for _, title in table.cells] == titles
    gain, p = cell(table, "rootsift", "Acc30 − ours", ""), cell(table, "rootsift", "p", "")
    acc30 = [made.summary["methods"][name]["acc30"] for name in ("ours", "rootsift")]
    assert gain.value == pytest.approx(acc30[1] - acc30[0]) and gain.low <= gain.value <= gain.high
    assert p.value == test["accuracy_gain_p"] and cell(table, "ours", "p", "") is None
    table, errors = all_rows(made.summary, ["above150", "median"]), other["error"]
    assert [title for _, title in table.cells][1:3] == ["above 150° (%)", "pooled med. err. (°)"]
    found = [cell(table, "rootsift", title, "").value for _, title in list(table.cells)[1:3]]
    assert found == pytest.approx([100 * np.mean(errors > 150), np.median(errors)])
    assert every_table(made.summary, ["acc30"])[0].cells.shape[1] == 5
    with pytest.raises(InputError, match="metrics: name is 'speed', expected one of .*acc30"):
        all_rows(made.summary, ["speed"])


def test_the_verified_solver_stands_beside_the_papers_by_number_of_views(tmp_path):
    made = made_up_run(tmp_path, ["ours", "ours-n1", *GROUPS["verified-views"], "verified-mask-n1"])
    table = next(table for table in paper_tables(made.summary) if table.name == "verified_targets")
    assert list(table.cells.index) == [f"views = {n}" for n in (1, 3, 5, 10)]
    for n, name in ((1, "verified-mask-n1"), (5, "verified-mask")):
        found = cell(table, f"views = {n}", "Acc30 (%)", "verified, true mask")
        assert found.value == made.summary["methods"][name]["acc30"]
    assert cell(table, "views = 3", "Acc30 (%)", "the paper's") is None
    left, _ = figures.accuracy_against_views(made).axes
    assert list(next(line for line in left.get_lines() if line.get_label() == "verified").get_xdata()) == [1, 3, 5, 10]


def test_figures_by_category_are_those_of_the_summary(run):
    found = [*zip(tables.category_tables(run.summary), ("median", "acc30", "acc15"))]
    for table, figure in [*found, (tables.by_category(run.summary, ROWS[:2]), None)]:
        for category in CATEGORIES:
            for name in ROWS[:2]:
                at = (name, ("", category)) if figure else (category, ("", name))
                known = run.summary["methods"][name]["per_category"][category]
                assert table.cells.loc[at].value == known[figure or "acc30"]


def test_rows_of_ones_own_stand_below_the_papers_and_in_every_figure(run, tmp_path, monkeypatch):
    names = ["ours", "ours-n3", "verified", "a_b & 50%", "mine", "mine-n3"]
    made = made_up_run(tmp_path, names)
    assert tables.own_rows(made.summary) == names[3:] and not tables.own_rows(run.summary)
    (table,) = (table for table in paper_tables(made.summary) if table.name == "table_1")
    assert list(table.cells.index)[-4:] == ["Ours (K=50)", *names[3:]] and len(table.cells) == 10
    mine = made.summary["methods"]["mine"]
    assert cell(table, "mine", "Acc30 (%)").value == mine["acc30"]
    assert cell(table, "mine", "hydrant Acc30").value == mine["per_category"]["hydrant"]["acc30"]
    assert cell(table, "mine", "Acc30 (%)", PUBLISHED) is None
    left, _ = figures.accuracy_against_views(made).axes
    line = next(line for line in left.get_lines() if line.get_label() == "mine")
    assert list(line.get_xdata()) == [3, 5] and line.get_ydata()[1] == mine["acc30"]
    assert [line.get_label() for line in figures.error_curves(made).axes[0].get_lines()][:4] == [*names[3:], "ours"]
    assert '"mine"' in figures.reliability_diagram(made).get_suptitle()
    drawn, error_distribution = [], figures.error_distribution
    monkeypatch.setattr(
        figures, "error_distribution", lambda run, row: drawn.append(row) or error_distribution(run, row)
    )
    write_reports(tmp_path)
    assert drawn == ["a_b & 50%"]
    stems = ("accuracy_against_views", "error_curves", "error_distribution", "reliability")
    files = sorted((tmp_path / "figures").iterdir())
    assert [path.name for path in files] == [f"{stem}.{kind}" for stem in stems for kind in ("pdf", "png")]
    starts = {".pdf": b"%PDF", ".png": b"\x89PNG"}
    assert all(path.read_bytes().startswith(starts[path.suffix]) for path in files)


def test_a_latex_table_has_four_columns_and_the_best_of_each_in_bold(run, tmp_path):
    rows = {
        "a_b & 50%": [Cell(12.34, 10, 20), Cell(50.0), Cell(-3.21), Cell(1, decimals=0)],
        "low": [Cell(12.31), Cell(49.9), Cell(-4.0), Cell(2, decimals=0)],
        "none": [Cell(99.9), None, None, Cell(0.0002, decimals=3)],
        "empty": [None, None, None, Cell(1)],
    }
    titles = "Med. err. (°)", "Acc30 (%)", "B − A"
    columns = [*(("", title) for title in titles), ("", "pairs")]
    text = as_latex(tables.make_table("mine", "50% & more", columns, rows))
    assert r"\caption{50\% \& more}" in text and r"\label{tab:mine}" in text and r"\begin{tabular}{lrrr}" in text
    assert all(rule in text for rule in (r"\toprule", r"\midrule", r"\bottomrule")) and "empty" not in text
    lines = [[part.strip() for part in re.split(r"(?<!\\)&", line.removesuffix(r" \\"))]
             for line in text.splitlines() if "&" in line and "caption" not in line]  # fmt: skip
    assert lines == [
        ["", r"Med. err. ($^\circ$)", r"Acc30 (\%)", "B $-$ A"],
        [r"a\_b \& 50\%", r"\textbf{12.3}", r"\textbf{50.0}", "$-3.2$"],  # equal as far as they are shown
        ["low", r"\textbf{12.3}", "49.9", "$-4.0$"], ["none", "99.9", "--", "--"],
    ]  # fmt: skip
    made = made_up_run(tmp_path, ["ours", "ours-n3", "verified", "a_b & 50%"])
    for table in every_table(run.summary) + every_table(made.summary):
        text = as_latex(table)
        body = text[text.index(r"\toprule") : text.index(r"\bottomrule")]
        assert max(len(re.findall(r"(?<!\\)&", line)) for line in body.splitlines()) <= 3
        assert not re.search(r"[−°]|(?<![\d$.-])-\d", body) and f"\\label{{tab:{table.name}}}" in text


def test_all_formats_say_the_same(run, tmp_path):
    table = next(table for table in paper_tables(run.summary) if table.name == "table_3")
    ours = run.summary["methods"]["ours"]
    text = f"{ours['acc30']:.1f} [{ours['acc30_ci'][0]:.1f}, {ours['acc30_ci'][1]:.1f}]"
    lines = list(csv.DictReader(io.StringIO(tables.as_csv(table))))
    assert lines[3]["row"] == "CorrespondSim"
    assert float(lines[3]["this run Acc30 (%)"]) == ours["acc30"]
    assert float(lines[3]["this run Acc30 (%) low"]) == ours["acc30_ci"][0]
    assert f"{PUBLISHED} Acc30 (%) low" not in lines[0] and f"{PUBLISHED} Acc30 (%)" in lines[0]
    markdown = as_markdown(table).splitlines()
    assert text in markdown[-3] and markdown[2].count("|") == markdown[-3].count("|")
    console = Console(width=250, file=io.StringIO())
    console.print(as_rich(table))
    for other in (tables.as_html(table), console.file.getvalue()):
        assert all(part in other for part in (*text.split(" ", 1), "46.3", "CorrespondSim"))
    assert f"{ours['acc30']:.1f}" in as_latex(table)
    odd = tables.make_table("odd", "<b>", [("", "a|b")], {"c|d": [Cell(0.00001, decimals=3)], "<i>": [None]})
    heading, rule, *lines = as_markdown(odd).splitlines()[2:]
    assert {re.sub(r"\\\|", "", line).count("|") for line in (heading, rule, *lines)} == {3} and "< 0.001" in lines[0]
    assert not {"<b>", "<i>"} & set(re.findall("<.>", tables.as_html(odd)))
    written = tables.write_tables([table, odd], tmp_path)
    assert len(written) == 2 * 3 + 1 and all(path.stat().st_size for path in written)
    assert written[-1].read_text().count("<table") == 2


def test_a_document_gets_the_tables_that_it_has_marks_for(run, tmp_path):
    first, second = (f"<!-- table {name} -->\nold\n<!-- end of table -->\n" for name in ("table_1", "table_3"))
    text, path, made = f"before\n{first}between\n{second}", tmp_path / "page.md", every_table(run.summary)

    def updated(text):
        path.write_text(text)
        tables.update_document(path, made, 1234)
        return path.read_text()

    once = updated(text)
    assert "old" not in once and once.startswith("before\n<!-- table table_1 -->\n**Table 1.") and "between" in once
    assert f"{run.summary['methods']['ours']['acc30']:.1f}" in once
    assert "hydrant" not in once and "(1,234 pairs)" in once
    assert updated(once) == once and "old" not in updated(text.replace("\n", "\r\n"))
    lost = text.replace("<!-- end of table -->\nbetween", "between")
    for wrong, told in (
        ("no marks", "marks of no table"), (text.replace("table_3", "table_9"), "marks .*table_9"),
        (lost, "has the marks table table_1, table table_3, end of table, expected"),
        (text[: text.rindex("<!--")], "for each table"), (text[text.index("old") :], "for each table"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=told):
            updated(wrong)
        assert path.read_text() == wrong


def test_the_papers_figures_were_copied_right():
    ours = tables.read_paper_tables()[0]["rows"][-1]
    assert ours["rows"] == ["ours"] and ours["published"] == [53.8, 46.3, 31.1, 71.0, 26.0, 82.0, 39.0, 42.0]
    for table in tables.read_paper_tables():
        for line in table["rows"]:
            assert resolve(line["rows"]) and len(line["rows"]) == len(table["groups"])
            assert len(line["published"]) == len(table["published"]) and all(0 <= x <= 180 for x in line["published"])


def test_a_run_in_one_file_is_the_run_and_equal_runs_give_equal_files(tmp_path):
    made = [made_up_run(tmp_path / name, ["ours", "verified"]) for name in "ab"]
    first, second = (export_run(tmp_path / name) for name in "ab")
    assert first == tmp_path / "a" / "results.jsonl.gz" and first.read_bytes() == second.read_bytes()
    again = read_run(first)
    assert again.summary == made[0].summary and again.table.equals(made[0].table) and again.calls == made[0].calls
    assert again.settings == made[0].settings
    thirds = {"error": 100 / 3, "translation": 2 / 3, "unknown": 1, "note": ""}
    write_run(tmp_path / "c", {"ours": {"chair/a:0/b:0": thirds}})
    lines = gzip.decompress(export_run(tmp_path / "c").read_bytes()).splitlines()
    assert json.loads(lines[-1])["results"] == {"ours": {"error": 33.3333, "translation": 0.6667}}


def test_what_is_no_run_is_refused(tmp_path):
    path = tmp_path / "a.jsonl.gz"
    for content, told in (
        (b"no gzip", "gzip"), (gzip.compress(b"{}")[:15], "gzip|end"), (gzip.compress(b""), "line 1"),
        (gzip.compress(b'{"pairs": []}'), "line 1: .*missing required field `data`"),
    ):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"{path}.*({told})"):
            read_run(path)
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(InputError, match=str(path)):
            read_run(path)


def test_runs_are_compared_on_the_pairs_that_both_have(run, tmp_path):
    halves = {name: (run.row(name)[["error"]] / 2).to_dict(orient="index") for name in ("ours", "icp")}
    halves["ours"].popitem()
    other = write_run(tmp_path / "b", halves)
    found = compare(run, other)
    assert list(found) == ["icp", "ours"] and (found["ours"]["n"], found["icp"]["n"]) == (47, 48)
    a, b = (one.row("icp").sort_index() for one in (run, other))
    icp = found["icp"]
    assert icp.items() >= paired_difference(a["error"], b["error"], weights=draws_of(a)).items()
    assert icp["acc30"][1] - icp["acc30"][0] == pytest.approx(icp["accuracy_gain"]) and icp["accuracy_gain"] > 0
    assert icp["median"] == [np.median(a["error"]), np.median(b["error"])]
    table = comparison_table(compare(run, run, [("icp", "icp"), ("ours", "icp")]), "x", "y")
    assert table.title == "A = x, B = y" and list(table.cells.index) == ["icp", "ours:icp"]
    accuracies = table.cells.loc["ours:icp", "Acc30 (%)"]
    assert list(accuracies.index) == ["A", "B", "B − A", "p"] and 0 < accuracies["p"].value <= 1
    assert accuracies["B − A"].value == pytest.approx(accuracies["B"].value - accuracies["A"].value)
    assert table.cells.loc["icp", ("Acc30 (%)", "p")].value == 1 and "bootstrap over objects" in table.note
    drop = run.row("ours")["error"].mean() - run.row("icp")["error"].mean()
    assert table.cells.loc["ours:icp", ("error (°)", "mean of A − B")].value == pytest.approx(drop)
    with pytest.raises(InputError, match="rows ours-n1 and ours have no pair in common"):
        compare(run, other, [("ours-n1", "ours")])
    with pytest.raises(InputError, match="no row in common: icp, .* and nobody"):
        compare(run, write_run(tmp_path / "c", {"nobody": halves["icp"]}))


def test_rows_to_compare_may_have_colons_in_their_names(tmp_path):
    first, second = (made_up_run(tmp_path / name, ["ours", name]) for name in ("my:row", "a:b:c"))
    for one, other in (("my:row", "ours"), ("my:row", "a:b:c"), ("ours", "a:b:c")):
        assert split_rows(f"{one}:{other}", first, second) == (one, other)
    assert split_rows("ours", first, second) == ("ours", "ours")
    for text in ("my:row", "ours:", "", ":ours", "ours:my:row"):
        with pytest.raises(InputError, match="not in the runs, expected A:B or A with A one of ours, my:row and B"):
            split_rows(text, first, second)


def test_runs_on_different_objects_are_pooled(tmp_path):
    rows, paths = ["ours", "ours-bv", "icp"], [tmp_path / str(seed) for seed in (0, 1, 2)]
    runs = [made_up_run(path, rows[: 3 - (seed == 2)], seed, data=path.name) for seed, path in enumerate(paths)]
    export_run(paths[1])
    pooled = read_runs([paths[0], paths[1] / "results.jsonl.gz", paths[2]])
    row, summary = pooled.row("ours"), pooled.summary["methods"]["ours"]
    assert list(pooled.summary["methods"]) == ["ours", "ours-bv"] and pooled.settings["data"] == "0, 1, 2"
    assert summary["n"] == len(row) == 3 * 48 and row["error"].to_dict() == {
        key: error for run in runs for key, error in run.row("ours")["error"].items()}  # fmt: skip
    assert summary["acc30"] == pytest.approx(np.mean([run.summary["methods"]["ours"]["acc30"] for run in runs]))
    weights = object_draws(list(zip(row["reference"], row["target"])), row["category"].to_list())
    expected = bootstrap_ci(row["error"], lambda errors, weights: accuracy(errors, 30, weights), weights)
    assert summary["acc30_ci"] == pytest.approx(list(expected))
    assert np.ptp(summary["acc30_ci"]) < 0.8 * np.ptp(runs[0].summary["methods"]["ours"]["acc30_ci"])
    assert read_runs(paths[:1]).summary == runs[0].summary
    assert write_reports(paths[:2], tmp_path / "pooled").summary["methods"]["icp"]["n"] == 96
    assert (tmp_path / "pooled" / "tables" / "tables.html").is_file() and not (paths[0] / "tables").exists()


def test_runs_that_are_not_of_one_benchmark_are_not_pooled(tmp_path):
    made_up_run(tmp_path / "0", ["ours"])
    for number, (rows, settings, told) in enumerate((
        (["ours"], {}, "share 48 pairs"), (["ours"], {"backbone": "other"}, "differ in backbone: none 0, other"),
        (["ours"], {"targets": 3}, "differ in targets: 3, 5"), (["icp"], {}, "no row in common, found ours, icp"),
        (["ours"], {"methods": {"ours": "y"}}, "differ in row ours: x, y"),
    ), 1):  # fmt: skip
        made_up_run(tmp_path / str(number), rows, **settings)
        with pytest.raises(InputError, match=told):
            read_runs([tmp_path / "0", tmp_path / str(number)])


def test_figures_show_every_pair_every_number_of_views_and_every_row(run, tmp_path):
    (axis,) = figures.error_distribution(run).axes
    assert sum(len(points.get_offsets()) for points in axis.collections) == 48
    assert [label.get_text() for label in axis.get_yticklabels()] == sorted(CATEGORIES, reverse=True)
    left, right = figures.accuracy_against_views(run).axes
    line = left.get_lines()[0]
    assert list(line.get_xdata()) == [1, 3, 5, 10, 20]
    assert line.get_ydata()[2] == run.summary["methods"]["ours-n5"]["acc30"]
    assert list(right.get_lines()[-1].get_ydata()) == [13.4, 26.2, 31.1, 38.2, 38.3]
    (axis,) = figures.error_curves(run, ["ours", "icp"]).axes
    curve = axis.get_lines()[0]
    height = curve.get_ydata()[np.searchsorted(curve.get_xdata(), 30, side="right") - 1]
    assert height == pytest.approx(100 * np.mean(run.row("ours")["error"] <= 30))
    few = made_up_run(tmp_path / "few", ["icp"])
    assert {path.stem for path in figures.write_figures(few, tmp_path / "f")} == {"error_distribution", "error_curves"}
    with pytest.raises(InputError, match="reliability: no row has 20 confidences"):
        figures.reliability_diagram(few)


def test_confidences_are_kept_and_drawn_where_a_row_states_them(tmp_path):
    rng = np.random.default_rng(0)
    sure, key = rng.random(200).round(4), "chair/a:{}/b:0,1".format
    right = rng.random(200) < sure
    rows = {
        key(i): {"error": 90.0 - 85 * ok, "confidence": c}
        for i, (c, ok) in enumerate(zip(sure.tolist(), right.tolist()))
    }
    made = write_run(tmp_path, {"ours": {key(0): {"error": 1.0}}, "verified": rows}, ["chair"])
    assert made.row("ours")["confidence"].isna().all()
    assert made.row("verified")["confidence"][list(rows)].to_list() == sure.tolist()
    axis = figures.reliability_diagram(made).axes[0]
    line, order = axis.lines[1], np.argsort(sure)  # after the diagonal
    np.testing.assert_allclose(line.get_xdata(), sure[order].reshape(10, 20).mean(1), atol=1e-3)
    np.testing.assert_allclose(line.get_ydata(), right[order].reshape(10, 20).mean(1))
    assert axis.get_title() == "20 answers for each point"


def test_right_if_one_of_the_two_is_right_has_a_table_of_its_own(tmp_path):
    keys, second = [f"chair/a{i}:0/b{i}:0" for i in range(4)], ((10, 170, False), (175, 5, True), (120, 90, True))
    found = [{"error": one, "second_error": two, "one_of_two": flag} for one, two, flag in second]
    answers = dict(zip(keys, [*found, {"error": 180.0, "failed": "no depth"}]))
    rows = {"ours": {key: {"error": 40.0} for key in keys}, "verified": answers}
    made = write_run(tmp_path, rows, ["chair"], targets=1)
    verified = made.summary["methods"]["verified"]
    assert verified["acc30"] == 25 and verified["failed"] == 1  # Acc30 is what it was without alternatives
    best_two = dict(verified["best_two"])
    low, high = best_two.pop("acc30_ci")
    assert 0 <= low < 50 < high <= 100
    assert best_two == {"acc30": 50, "one_of_two": 2, "one_of_two_acc30": 50, "one_of_two_first_acc30": 0}
    (table,) = tables.best_two_tables(made.summary)
    assert list(table.text.index) == ["verified"] and "not comparable with Acc30" in table.note
    assert list(table.text.loc["verified"])[2:] == ["2", "50.0", "0.0"]
    assert table.name in [one.name for one in every_table(made.summary)]
    assert read_run(export_run(tmp_path)).summary == made.summary
