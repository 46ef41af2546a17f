"""The figures of the pages are those of the stored runs, the code and the fitted constants."""

import re
from dataclasses import asdict

import pytest
from sklearn.metrics import roc_auc_score

from tools import results_page
from zsp_lite.benchmark.runs import read_run
from zsp_lite.benchmark.statistics import object_draws
from zsp_lite.io.files import REPOSITORY
from zsp_lite.metrics import accuracy
from zsp_lite.verified.verification import ScoreCoefficients
from zsp_lite.viz.reliability import reliability

# Figures have one decimal: a rounded one is less than this off.
ROUNDED = 0.051
README_ROWS = ("ours", "ours-bv-n1", "ours-bv", "rootsift", "oracle-view", "verified", "scans-4")


@pytest.fixture(scope="module")
def runs():
    return {name: read_run(results_page.RUNS / name) for name in ("procedural", "artists")}


def page(name: str) -> str:
    """The text of a page, with hyphens for minus signs."""
    return (REPOSITORY / name).read_text("utf-8").replace("−", "-")


def numbers(text: str) -> list[float]:
    """All numbers in a text."""
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


def rows(text: str, start: str) -> list[str]:
    """The lines of the table whose head begins with `start`."""
    table = rf"^{re.escape(start)}.*\n\|[-:|]+\|\n((?:\|.*\n)+)"
    return re.search(table, text, re.MULTILINE)[1].splitlines()


def test_the_readme_has_the_figures_of_both_runs(runs):
    for line, row in zip(rows(page("README.md"), "| | procedural"), README_ROWS, strict=True):
        found = [run.summary["methods"][row] for run in runs.values()]
        expected = [
            value for one in found for value in (one["acc30"], *one["acc30_ci"], one["above150"])
        ]
        assert numbers(line.split("|", 2)[2]) == pytest.approx(expected, abs=ROUNDED), row


def test_the_page_says_how_much_objects_and_seeds_change_the_accuracy(runs):
    """Standard deviations of Acc30 of `ours`, by objects and by seeds."""
    text = page("docs/results.md").replace("\n  ", " ")
    stated = re.search(r"standard deviation of Acc30 of `ours` by (.*?) models\.", text)[1]
    expected = []
    for run in runs.values():
        row = run.row("ours")
        drawn = object_draws(row[["reference", "target"]].to_numpy(), row["category"].to_numpy())
        by_seed = run.summary["methods"]["ours"]["acc30_sd_of_seeds"]
        expected += [accuracy(row["error"].to_numpy(), 30, drawn).std(), by_seed]
    assert numbers(stated) == pytest.approx(expected, abs=ROUNDED)


def test_the_table_of_artist_made_models_has_the_figures(runs):
    methods = runs["artists"].summary["methods"]
    lines = rows(page("docs/results.md"), "| row | median error")
    names = [re.match(r"\| `([\w-]+)`", line)[1] for line in lines]
    assert len(names) == 6
    for name, line in zip(names, lines):
        one = methods[name]
        figures = ("median", "acc30", "acc15")
        expected = [value for figure in figures for value in (one[figure], *one[f"{figure}_ci"])]
        assert numbers(line.split("|", 2)[2]) == pytest.approx(
            [*expected, one["above150"]], abs=ROUNDED
        ), name


def test_the_marked_tables_are_those_of_the_runs(runs, monkeypatch):
    monkeypatch.setattr(results_page, "read_run", lambda path: runs[path.name])
    text = results_page.PAGE.read_text("utf-8")
    assert results_page.updated(text) == text, "run python -m tools.results_page"
    # A page that lacks a row gets it back.
    old = re.sub(r"^\| Ours \(K=50\).*\n", "", text, flags=re.MULTILINE)
    assert old != text
    assert results_page.updated(old) == text


def test_the_page_on_solvers_has_the_confidences(runs):
    for line, run in zip(
        rows(page("docs/solvers.md"), "| objects | mean confidence"), runs.values(), strict=True
    ):
        row = run.row("verified")
        confidence, right = row["confidence"].to_numpy(), row["error"].to_numpy() < 30
        measured = reliability(confidence, right)
        expected = [100 * confidence.mean(), 100 * right.mean(), 100 * measured.calibration_error]
        assert numbers(line)[:3] == pytest.approx(expected, abs=ROUNDED)
        # This one has two decimals.
        assert numbers(line)[3] == pytest.approx(roc_auc_score(right, confidence), abs=0.0051)


def test_the_page_on_solvers_has_the_weights_of_the_code():
    text, weights = page("docs/solvers.md"), asdict(ScoreCoefficients())
    stated = {}
    for line in rows(text, "| term |"):
        term, forward, reverse = re.match(r"\| `(\w+)` \|[^|]*\| (\S+) \| (\S*) ?\|", line).groups()
        if reverse:
            stated |= {f"forward_{term}": forward, f"reverse_{term}": reverse}
        else:
            stated[term] = forward
    assert {name: float(value) for name, value in stated.items()} == weights
