"""The widget of ranked hypotheses shows the hypothesis of its slider."""

import pytest
from matplotlib import pyplot as plt

from zsp_lite.errors import InputError

pytest.importorskip("ipywidgets", reason="widgets are an optional extra: pip install 'zsp-lite[notebooks]'")

from tools.widget_examples import ranked_hypotheses as example
from tools.widget_examples import sample_solution
from zsp_lite.widgets.verified import ranked_hypotheses

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def widget():
    yield example()
    plt.close("all")


def test_the_caption_has_score_and_probability_of_each_rank(widget):
    solution, _ = sample_solution()
    assert widget.controls["rank"].max == len(solution.hypotheses)
    for rank, one in enumerate(solution.hypotheses, 1):
        widget.controls["rank"].value = rank
        assert f"Hypothesis {rank} of {len(solution.hypotheses)}" in widget.caption.value
        assert f"score {one.score:.1f}, probability {one.confidence:.0%}" in widget.caption.value
    widget.controls["rank"].value = 1
    assert "the best" in widget.caption.value and "below the best" not in widget.caption.value.split("Points")[0]


def test_every_control_changes_the_picture(widget):
    for name, position in {"rank": 2, "view": 2, "azimuth": 30}.items():
        before, old = widget.picture.value, widget.controls[name].value
        widget.controls[name].value = position
        assert widget.picture.value != before
        widget.controls[name].value = old


def test_every_point_is_counted_once(widget):
    solution, _ = sample_solution()
    counts = widget.caption.value.split("target view 1: ")[1].rstrip(".")
    assert sum(int(part.split()[0]) for part in counts.split(", ")) == len(solution.scene.reference_points)


def test_other_targets_than_those_of_the_solution_are_an_input_error():
    solution, targets = sample_solution()
    with pytest.raises(InputError, match="1 target views, expected all 3"):
        ranked_hypotheses(solution, targets[:1])
