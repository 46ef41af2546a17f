"""Pictures of the evidence: points lie where they project, their marks say what the terms say."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from synthetic_views import AT_HOME, CoordinateBackbone, look_at, render

from zsp_lite.alignment import Sim3
from zsp_lite.errors import InputError
from zsp_lite.verified.confidence import reliability
from zsp_lite.verified.maps import Projection, ViewMaps
from zsp_lite.verified.poses import Poses
from zsp_lite.verified.verification import MAX_VIOLATION, SURFACE_SIGMA, TERM_NAMES, PointTerms, ScoreWeights
from zsp_lite.views import extract_views, object_crop
from zsp_lite.viz import plots
from zsp_lite.viz import verified as verified_plots

IMAGE = np.zeros((60, 80, 3), np.uint8)
# One view; points: on the surface, far behind it, far before it, outside the silhouette, over a hole in the depth.
BEHIND = torch.tensor([0.0, 1.0, -1.0, 0.0, 0.0])
WEIGHT = torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0])
OFF = torch.tensor([0.0, 0.0, 0.0, 0.4, 0.0])
PIXELS = torch.tensor([[10.0, 5.0], [20, 5], [30, 5], [55, 5], [20, 20]])


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture
def maps():
    """Maps of half the image's size: what they call pixel 10 is pixel 20 of the image."""
    return ViewMaps(
        torch.eye(3)[None], torch.zeros(1, 3), torch.ones(1), torch.zeros(1, 2), torch.tensor([[40.0, 30.0]]),
        torch.zeros(1, dtype=torch.long), torch.zeros(1200, 4), torch.tensor([[2.0, 2.0]]),
    )  # fmt: skip


@pytest.fixture
def evidence():
    touch = WEIGHT * torch.exp(-(BEHIND**2) / (2 * SURFACE_SIGMA**2))
    front = WEIGHT * (-(BEHIND + SURFACE_SIGMA) / MAX_VIOLATION).clamp(0, 1)
    projection = Projection(
        *(x[None, None] for x in (3 + BEHIND, torch.full((5,), 3.0), WEIGHT, OFF, torch.arange(5), PIXELS))
    )
    parts = (touch, OFF / MAX_VIOLATION, front, torch.linspace(-0.2, 0.2, 5))
    return PointTerms(projection, *(part[None, None] for part in parts))


def test_each_kind_of_point_is_told_from_the_others(evidence):
    assert verified_plots.classify_points(evidence).tolist() == [[0, 1, 2, 3, 4]]
    assert list(verified_plots.POINT_CLASSES)[2] == "in free space"


def test_points_are_drawn_where_they_project_in_the_image_itself(evidence, maps):
    figure, axes = plots.show_images([IMAGE])
    counts = verified_plots.draw_point_classes(axes, evidence, maps)
    assert counts.tolist() == [[1, 1, 1, 1, 1]]
    drawn = np.concatenate([collection.get_offsets() for collection in axes[0].collections])
    # Twice the map's pixels; the one beyond the border (110) stands at it (80).
    np.testing.assert_allclose(sorted(map(tuple, drawn)), [(20, 10), (40, 10), (40, 40), (60, 10), (80, 10)])
    assert len({marker for _, marker in verified_plots.POINT_CLASSES.values()}) == len(verified_plots.POINT_CLASSES)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == list(verified_plots.POINT_CLASSES)


@pytest.mark.parametrize("term", ["silhouette", "free_space", "surface", "similarity"])
def test_a_terms_values_are_the_colours(evidence, maps, term):
    _, axes = plots.show_images([IMAGE])
    verified_plots.draw_point_term(axes, evidence, maps, term)
    drawn = axes[0].collections[0].get_array()
    np.testing.assert_allclose(sorted(drawn), sorted(getattr(evidence, term)[0, 0].tolist()), atol=1e-6)


def test_the_largest_violation_is_the_largest_point(evidence, maps):
    _, axes = plots.show_images([IMAGE])
    verified_plots.draw_point_term(axes, evidence, maps, "free_space")
    drawn = axes[0].collections[0]
    np.testing.assert_allclose(drawn.get_offsets()[np.argmax(drawn.get_sizes())], [60, 10])


def test_unknown_terms_and_too_few_axes_are_refused(evidence, maps):
    _, axes = plots.show_images([IMAGE] * 2)
    with pytest.raises(InputError, match="expected one of silhouette, free_space"):
        verified_plots.draw_point_term(axes[:1], evidence, maps, "colour")
    for draw in (lambda: verified_plots.draw_point_classes(axes, evidence, maps),
                 lambda: verified_plots.draw_point_term(axes, evidence, maps, "silhouette")):  # fmt: skip
        with pytest.raises(InputError, match="2 axes, expected one for each of the 1 views"):
            draw()


def test_contributions_add_up_to_the_score():
    rng = np.random.default_rng(0)
    terms, weights = dict(zip(TERM_NAMES, rng.random(len(TERM_NAMES)))), ScoreWeights(*rng.normal(size=len(TERM_NAMES)))
    parts = verified_plots.score_contributions(terms, weights)
    assert sum(parts.values()) == pytest.approx(sum(getattr(weights, name) * terms[name] for name in TERM_NAMES))
    _, axis = plt.subplots()
    verified_plots.draw_score_contributions(axis, {"first": terms, "second": dict.fromkeys(TERM_NAMES, 0.0)}, weights)
    bars, flat = axis.containers
    np.testing.assert_allclose([bar.get_width() for bar in bars], list(parts.values()))
    assert all(bar.get_width() == 0 for bar in flat)
    assert {bar.get_hatch() for bar in bars} != {bar.get_hatch() for bar in flat}


def test_a_term_without_weight_has_no_bar_and_five_hypotheses_are_too_many():
    terms = dict.fromkeys(TERM_NAMES, 1.0)
    weights = ScoreWeights(**(dict.fromkeys(TERM_NAMES, 0.0) | {"forward_similarity": 2.0}))
    _, axis = plt.subplots()
    verified_plots.draw_score_contributions(axis, {"one": terms}, weights)
    assert [label.get_text() for label in axis.get_yticklabels()] == ["forward similarity"]
    with pytest.raises(InputError, match="5 hypotheses to draw, expected 1 to 4"):
        verified_plots.draw_score_contributions(axis, {str(i): terms for i in range(5)}, weights)


def test_reliability_points_lie_at_confidence_and_frequency():
    confidence = np.repeat([0.2, 0.9], 10)
    right = np.tile(np.arange(10) < 3, 2)
    _, axis = plt.subplots()
    verified_plots.draw_reliability(axis, reliability(confidence, right, bins=2))
    points = axis.containers[0][0].get_xydata()
    np.testing.assert_allclose(points, [[0.2, 0.3], [0.9, 0.3]])
    # Wilson's interval for 3 of 10, from a table: 10.8 % to 60.3 %.
    low, high = axis.containers[0][2][0].get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((0.108, 0.603), abs=1e-3)
    assert axis.get_title() == "10 answers for each point" and not axis.texts


def test_counts_that_differ_stand_beside_their_points():
    _, axis = plt.subplots()
    verified_plots.draw_reliability(axis, reliability(np.linspace(0.1, 0.9, 5), np.arange(5) > 1, bins=2))
    assert sorted(text.get_text() for text in axis.texts) == ["2", "3"] and not axis.get_title()


def test_some_of_the_views_can_be_drawn(evidence, maps):
    figure = verified_plots.show_point_classes([IMAGE], evidence, maps, [0], ["target 1"], ["right"])
    assert figure.axes[0].get_title() == "right: target 1" and len(figure.axes[0].collections) == 5
    _, axes = plots.show_images([IMAGE] * 2)
    with pytest.raises(InputError, match="2 axes, expected one for each of the 1 views"):
        verified_plots.draw_point_classes(axes, evidence, maps, views=[0])


def test_a_term_is_shown_for_each_pose_in_a_row_of_its_own(evidence, maps):
    parts = (evidence.surface, evidence.silhouette, evidence.free_space, evidence.similarity)
    fields = vars(evidence.projection).values()
    both = PointTerms(Projection(*(torch.cat([x, x]) for x in fields)), *(torch.cat([x, 0 * x]) for x in parts))
    figure = verified_plots.show_point_term([IMAGE], both, maps, "silhouette", [0], ["target 1"], ["right", "wrong"])
    first, second = (axis.collections[0].get_array() for axis in figure.axes[:2])
    assert first.max() > 0 and second.max() == 0


def test_the_reference_lies_on_itself_under_the_identity():
    frame = object_crop(render(look_at((1, 0.6, 0.4)), AT_HOME, "reference"))
    (view,) = extract_views(CoordinateBackbone(), [frame])
    identity = Sim3(1.0, np.eye(3), np.zeros(3))
    figure = verified_plots.show_moved_reference(view, [view], [identity], {0: ("itself", plots.BLUE)}, most=200)
    x, y = figure.axes[1].collections[0].get_offsets().T.astype(int)
    assert len(x) == 200 and (frame.mask[y, x] > 0.5).mean() > 0.95
    assert any(text.get_text() == "itself" for text in figure.axes[1].texts)


def test_proposals_stand_in_the_row_of_their_source():
    figure = verified_plots.show_proposal_errors(np.array([10.0, 170.0, 20.0]), ["a", "b", "a"])
    (axis,) = figure.axes
    np.testing.assert_allclose(axis.collections[-1].get_offsets(), [[10, 0], [170, 1], [20, 0]])
    assert [label.get_text() for label in axis.get_yticklabels()] == ["a", "b"]


def test_from_above_x_and_z_of_the_moved_points_are_drawn():
    points = torch.tensor([[1.0, 2.0, 3.0]])
    poses = Poses(torch.tensor([2.0, 1.0]), torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3))
    figure = verified_plots.show_from_above(points, points, poses, ["twice", "once"])
    drawn = [[np.asarray(part.get_offsets())[0].tolist() for part in axis.collections] for axis in figure.axes]
    assert drawn == [[[1, 3], [2, 6]], [[1, 3], [1, 3]]]


def test_the_star_of_a_stage_is_its_highest_score():
    figure = verified_plots.show_stages({"first": (np.array([170.0, 5.0]), np.array([1.0, 3.0]))})
    np.testing.assert_allclose(figure.axes[0].collections[1].get_offsets(), [[5, 3]])
    assert figure.axes[0].get_title() == "first (2)"


def test_forward_and_reverse_curves_of_a_term_share_a_panel():
    degrees = np.array([0.0, 180.0, 360.0])
    figure = verified_plots.show_term_curves(degrees, {"free_space": degrees}, {"free_space": 2 * degrees})
    forward, reverse = figure.axes[0].lines
    np.testing.assert_allclose(reverse.get_ydata(), 2 * forward.get_ydata())
    assert figure.axes[0].get_title() == "free space"


def test_intervals_are_drawn_with_their_values():
    figure = verified_plots.show_accuracy_intervals({"paper": (50.0, 40.0, 60.0), "verified": (70.0, 65.0, 75.0)})
    (axis,) = figure.axes
    assert [list(line.get_xdata()) for line in axis.lines[:4]] == [[40, 60], [50], [65, 75], [70]]
    assert axis.lines[4].get_xdata()[0] == 70  # the line marks the first method that is no baseline


def test_the_accuracy_of_all_answers_is_where_the_curve_ends():
    confidence, correct = np.linspace(0, 1, 40), np.arange(40) >= 10
    right = verified_plots.show_calibration(confidence, correct).axes[1]
    assert right.lines[0].get_ydata()[0] == 100 and right.lines[0].get_ydata()[-1] == pytest.approx(75)
