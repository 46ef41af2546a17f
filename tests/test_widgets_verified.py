"""The widget of ranked hypotheses: it shows the hypothesis that its slider names, and says so."""

import pytest
from matplotlib import pyplot as plt

from zsp_lite.errors import InputError

pytest.importorskip("ipywidgets", reason="widgets are an optional extra: pip install 'zsp-lite[notebooks]'")

from zsp_lite.widgets.verified import _example_solution, example_ranked_hypotheses, ranked_hypotheses


@pytest.fixture(scope="module")
def widget():
    yield example_ranked_hypotheses()
    plt.close("all")


def test_each_rank_tells_its_score_and_confidence(widget):
    solution, _ = _example_solution()
    assert widget.controls["rank"].max == len(solution.hypotheses)
    for rank, one in enumerate(solution.hypotheses, 1):
        widget.controls["rank"].value = rank
        assert f"Hypothesis {rank} of {len(solution.hypotheses)}" in widget.sentence.value
        assert f"score {one.score:.1f}, confidence {one.confidence:.0%}" in widget.sentence.value
    widget.controls["rank"].value = 1
    assert "the best" in widget.sentence.value and "behind" not in widget.sentence.value.split("Points")[0]


def test_every_control_changes_the_picture(widget):
    for name, position in {"rank": 2, "view": 2, "turn": 30}.items():
        before, old = widget.picture.value, widget.controls[name].value
        widget.controls[name].value = position
        assert widget.picture.value != before
        widget.controls[name].value = old


def test_every_point_is_counted_once(widget):
    solution, _ = _example_solution()
    told = widget.sentence.value.split("target view 1: ")[1].rstrip(".")
    assert sum(int(part.split()[0]) for part in told.split(", ")) == len(solution.scene.reference_points)


def test_other_targets_than_the_solutions_are_refused():
    solution, targets = _example_solution()
    with pytest.raises(InputError, match="1 target views, expected all 3"):
        ranked_hypotheses(solution, targets[:1])
