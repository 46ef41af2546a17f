"""The figures of the verified solver in docs/results.md are those of its stored runs."""

import re

import numpy as np
import pytest

from zsp_lite.benchmark.results import read_results
from zsp_lite.data.samples import REPOSITORY
from zsp_lite.verified.confidence import reliability

RESULTS = REPOSITORY / "notebooks" / "results"
SECTIONS = {
    "verified_run": "The verified solver with all weights fitted again",
    "matches_run": "The verified solver with matches without k-means",
    "around_run": "The verified solver with proposals around the object",
    "agreement_run": "The verified solver with agreement of photo features",
    "position_head_run": "The verified solver with a position head",
}


@pytest.fixture(scope="module", params=[(run, name) for run in SECTIONS for name in ("artists", "procedural")], ids=str)
def run(request):
    """The data's name, the stored results, and the section about them."""
    folder, name = request.param
    text = (REPOSITORY / "docs" / "results.md").read_text()
    section = text[text.index(f"\n## {SECTIONS[folder]}\n") :].split("\n## ")[1]
    return name, read_results(RESULTS / folder / f"{name}.json.gz"), section


def test_the_table_has_the_figures(run):
    name, found, section = run
    lines = re.findall(r"^\| `([\w-]+)`[^|]*\|(.+)\|$", section, re.MULTILINE)
    seen = set()
    for row, line in lines:
        cells = line.split("|")[:3] if name == "artists" else line.split("|")[3:]
        if cells[0].strip() == "–":
            continue
        one = found.summary["methods"][row]
        expected = [one["acc30"], *one["acc30_ci"], one["acc15"], *one["acc15_ci"], one["above150"]]
        assert [float(x) for x in re.findall(r"\d+\.\d", "|".join(cells))] == pytest.approx(expected, abs=0.051), row
        seen.add(row)
    assert seen == found.summary["methods"].keys()


def test_the_confidences_are_as_stated(run):
    name, found, section = run
    confidence = np.array(list(found.confidences("verified").values()))
    error = np.array(list(found.errors("verified").values()))
    measured = reliability(confidence, error < 30)
    text = " ".join(section.split())
    part = text[text.index("Confidence of `verified`") : text.index("The aims were")].split("On procedural pairs")
    stated = part[0 if name == "artists" else 1]
    assert f"mean {100 * confidence.mean():.0f} %, right {100 * (error < 30).mean():.0f} %" in stated
    assert f"{100 * measured.calibration_error:.1f} points" in stated and f"AUROC {measured.auroc:.2f}" in stated
    wrong = error >= 30
    count = f"{(wrong & (confidence > 0.8)).sum()}"
    assert (f"the {wrong.sum()} failures {count} have" if name == "artists" else f"{count} of {wrong.sum()}") in stated
