"""The figures on artist-made models in README.md and docs/results.md are those of the stored run."""

import re

import numpy as np
import pytest

from tools.models import read_catalogue
from zsp_lite.benchmark.results import read_results
from zsp_lite.benchmark.summary import weights_of_pairs
from zsp_lite.data.samples import REPOSITORY
from zsp_lite.metrics import accuracy, bootstrap_ci, median, pair_weights

FIGURES = (median, lambda errors, weights=None: accuracy(errors, 30, weights),
           lambda errors, weights=None: accuracy(errors, 15, weights))  # fmt: skip


@pytest.fixture(scope="module")
def run():
    return read_results(REPOSITORY / "notebooks" / "results" / "artists_run" / "results.json.gz")


def section() -> str:
    text = (REPOSITORY / "docs" / "results.md").read_text()
    return text[text.index("\n## Artist-made models") :].split("\n## ")[1]


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text.replace("N = 5", ""))]


def test_the_table_of_rows_has_the_figures_with_intervals_over_objects_and_over_pairs(run):
    lines = re.findall(r"^\| `([\w-]+)`[^|]*\|(.+\[.+)$", section(), re.MULTILINE)
    assert [name for name, _ in lines] and {name for name, _ in lines} == run.rows.keys()
    for name, line in lines:
        errors = np.array(list(run.errors(name).values()))
        expected = []
        for figure in FIGURES:
            expected.append(figure(errors))
            for weights in (weights_of_pairs(run.rows[name]), pair_weights(len(errors))):
                expected += bootstrap_ci(errors, figure, weights)
        expected.append(100 * (errors > 150).mean())
        assert numbers(line) == pytest.approx(expected, abs=0.051), name


def test_the_table_by_category_has_the_figures(run):
    head = re.search(r"^\| Acc30 \(%\) by category \|(.+)\| saliency IoU \|$", section(), re.MULTILINE)
    rows = re.findall(r"`([\w-]+)`", head.group(1))
    methods, overlap = run.summary["methods"], run.summary["saliency_iou"]
    for category in run.summary["data"]["categories"]:
        line = re.search(rf"^\| {category} \|(.+)$", section(), re.MULTILINE).group(1)
        expected = [methods[row]["per_category"][category]["acc30"] for row in rows]
        assert numbers(line)[:-1] == pytest.approx(expected, abs=0.51), category
        assert numbers(line)[-1] == pytest.approx(overlap[category], abs=0.0051), category


def test_the_readme_has_the_same_figures(run):
    text = (REPOSITORY / "README.md").read_text()
    table = re.search(r"artist-made: Acc30.*\n\|[-|]+\|\n((?:\|.*\n)+)", text).group(1).splitlines()
    assert len(table) == 5
    for line, row in zip(table, ("ours", "ours-bv", "rootsift", "oracle-view", "verified")):
        found = run.summary["methods"][row]
        expected = [found["acc30"], *found["acc30_ci"], found["above150"]]
        assert numbers("|".join(line.split("|")[-3:])) == pytest.approx(expected, abs=0.051), row


def test_the_run_has_30_pairs_of_each_category_of_the_catalogue(run):
    models = read_catalogue(REPOSITORY / "tools" / "artists.json").models
    assert run.summary["data"]["categories"] == sorted(models)
    assert {one["n"] for row in run.summary["methods"].values() for one in row["per_category"].values()} == {30}
    keys = [re.fullmatch(r"(\w+)/(\w+):\d+/(\w+):[\d,]+", key).groups() for key in run.errors("ours")]
    assert {(key[0], name) for key in keys for name in key[1:]} <= {
        (category, name) for category, entries in models.items() for name in entries
    }


def test_the_gain_over_rootsift_is_the_stated_one(run):
    gain = run.summary["against_ours"]["rootsift"]
    low, high = gain["accuracy_gain_ci"]
    stated = f"{gain['accuracy_gain']:.1f} points"
    for text in (section(), (REPOSITORY / "README.md").read_text()):
        assert stated in text and f"[{low:.1f}, {high:.1f}]" in text
    verified = run.summary["against_ours"]["verified"]
    low, high = (-end for end in verified["accuracy_gain_ci"])
    assert f"gains {-verified['accuracy_gain']:.1f} points over `ours` [{high:.1f}, {low:.1f}]" in section()
