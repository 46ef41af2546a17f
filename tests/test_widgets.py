"""The widgets: every control has an effect, and the captions agree with the library at the values of the controls."""

import ast
import sys
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from synthetic_views import level_camera

from zsp_lite.alignment import Sim3, ransac, umeyama
from zsp_lite.backbones.load import load_backbone
from zsp_lite.best_view import VIEW_SELECTORS
from zsp_lite.errors import InputError
from zsp_lite.matchers import MATCHERS
from zsp_lite.matching import cyclical_distances, match, similarity
from zsp_lite.metrics import rotation_error
from zsp_lite.synthetic.ground_truth import correct_matches

pytest.importorskip("ipywidgets", reason="widgets are optional: pip install ipywidgets anywidget")
matplotlib.use("agg")

from tools import widget_examples as examples  # noqa: E402
from zsp_lite.widgets import alignment, common, features, matching, metrics, verified, views  # noqa: E402

pytestmark = pytest.mark.slow

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def values_of(control) -> list:
    """Return some values of a control."""
    if hasattr(control, "options"):
        return [value[1] if isinstance(value, tuple) else value for value in control.options]
    return [True, False] if isinstance(control.value, bool) else [control.min, (control.min + control.max) // 2]


@pytest.mark.parametrize("name", [name for name in examples.WIDGETS if name != "label_poses"])
def test_every_control_changes_the_picture_and_going_back_restores_it(name):
    widget = examples.WIDGETS[name]()
    if name == "best_view":
        widget.controls["views"].value = 1  # of all views, the first does not matter
    before, caption = widget.picture.value, widget.caption.value
    assert before[:4] == b"\x89PNG" and caption
    for control in widget.controls.values():
        pictures, start = [], control.value
        for value in values_of(control):
            control.value = value
            pictures.append(widget.picture.value)
        assert any(picture != before for picture in pictures), control.description
        control.value = start
        assert (widget.picture.value, widget.caption.value) == (before, caption)


# building blocks


def test_no_module_imports_ipywidgets_before_a_widget_is_made():
    for path in Path(common.__file__).parent.glob("*.py"):
        # The body of the module excludes functions and `if TYPE_CHECKING`.
        for node in ast.parse(path.read_text()).body:
            names = [getattr(node, "module", "")]
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            assert "ipywidgets" not in names, path.name


def test_without_ipywidgets_the_error_has_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(InputError, match="pip install ipywidgets"):
        common.slider("x", 0, 1, 0)


# features and matches


@pytest.fixture(scope="module")
def sim():
    return similarity(*(view.features for view in examples.sample_views()))


def test_attention_names_the_patch_with_the_largest_weight():
    backbone, widget = load_backbone("zsp-tiny", "cpu"), examples.attention()
    facets = features.all_facets(backbone, [examples.sample_pair().reference.rgb])
    widget.controls["layer"].value, widget.controls["head"].value, widget.controls["row"].value = 4, 2, 20
    heads, col = backbone.model.num_heads, widget.controls["col"].value
    q, k = (facets[4, name][0].unflatten(1, (heads, -1))[:, 2] for name in ("query", "key"))
    top = divmod(int((k @ q[1 + 20 * 28 + col])[1:].argmax()), 28)
    assert f"patch ({top[0]}, {top[1]})" in widget.caption.value


def test_the_caption_has_the_nearest_neighbour_and_the_share_of_correct_ones(sim):
    truth = examples.sample_pair()
    kinds, cells = {"one": sim, "other": -sim}, np.stack(np.divmod(sim.argmax(1).numpy(), 28), -1)
    widget = features.similarities(truth.reference.rgb, truth.target.rgb, kinds, truth.cells, truth.valid, "other")
    widget.controls["kind"].value, widget.controls["row"].value, widget.controls["col"].value = "one", 15, 9
    row, col = cells[15 * 28 + 9]
    assert f"nearest neighbour ({row}, {col}), cosine {sim[15 * 28 + 9].max():.2f}" in widget.caption.value
    assert (
        f"{correct_matches(cells.reshape(28, 28, 2), truth.cells)[truth.valid].mean():.0%} have" in widget.caption.value
    )


def test_saliency_counts_the_patches_above_the_threshold_and_an_empty_box_has_no_mask():
    view, widget = examples.sample_views()[0], examples.saliency()
    widget.controls["threshold"].value = 0.5
    assert f"{int((view.features.saliency > 0.5).sum())} of 784 patches" in widget.caption.value
    widget = examples.box_to_mask()
    assert "IoU" in widget.caption.value
    widget.controls["bottom"].value = 4
    assert widget.caption.value == "mask of 0 pixels, IoU with the true mask 0.00"


def test_the_cycle_has_the_cyclical_distance_and_names_the_background(sim):
    pair = examples.sample_views()
    widget = matching.cycle(*pair, sim)
    distances = -cyclical_distances(sim, (28, 28), (28, 28)).numpy()
    valid = np.isfinite(cyclical_distances(sim, (28, 28), (28, 28), *(view.foreground for view in pair)).numpy())
    for row, col in ((14, 14), (20, 8), (3, 25), (0, 0)):
        widget.controls["row"].value, widget.controls["col"].value = row, col
        assert f"u ({row}, {col}) →" in widget.caption.value
        assert f"d(u, u') = {distances[row, col]:.1f} patches" in widget.caption.value
        assert ("not on the foreground" in widget.caption.value) == (not valid[row, col])


@pytest.mark.parametrize("matcher", ["cyclical", *MATCHERS])
def test_matches_are_compared_with_the_ground_truth(sim, matcher):
    truth, pair = examples.sample_pair(), examples.sample_views()
    widget = matching.matches(*pair, sim, truth.cells, truth.valid)
    widget.controls["matcher"].value, widget.controls["k"].value, widget.controls["kmeans"].value = matcher, 20, False
    expected = match(pair[0].features, pair[1].features, 20, False, sim=sim, matcher=matcher)
    at = tuple(expected.reference.T)
    correct = (correct_matches(expected.target, truth.cells[at]) & truth.valid[at]).sum()
    assert widget.caption.value.startswith(f"{matcher}: {len(expected)} matches, {correct} correct")
    assert f"{(~truth.valid[at]).sum()} without ground truth" in widget.caption.value


# best view


@pytest.mark.parametrize("score", VIEW_SELECTORS)
def test_the_caption_names_the_view_with_the_best_score_of_those_offered(score, monkeypatch):
    build = views.best_view
    monkeypatch.setattr(views, "best_view", lambda *passed: (build(*passed), passed))
    widget, (_, _, pairs, _, angles) = examples.best_view()
    values = np.array([VIEW_SELECTORS[score](one) for one in pairs])
    widget.controls["score"].value = score
    for count, first in ((4, 1), (2, 2), (1, 3)):
        widget.controls["views"].value, widget.controls["first"].value = count, first
        best = max([(first - 1 + i * 4 // count) % 4 for i in range(count)], key=lambda i: values[i])
        assert f"selects view {best + 1}, {angles[best]:.0f}°" in widget.caption.value


def test_cameras_on_a_circle_are_on_a_circle_from_above():
    cameras = [level_camera(degrees) for degrees in np.arange(0, 360, 45)]
    ring, other = views.viewpoints_from_above(cameras, level_camera(20, 40).centre[None])
    turns = np.degrees(np.unwrap(np.arctan2(*ring.T[::-1])))
    # Counter-clockwise in the world is counter-clockwise in the plot, for any axes of the plane.
    assert np.allclose(np.diff(turns), 45) and np.allclose(np.linalg.norm(ring, axis=1), 1)
    from_first = np.degrees(np.arctan2(*other[0][::-1])) - turns[0]
    assert np.isclose((from_first + 180) % 360 - 180, 20)


# alignment, hypotheses and metrics


def test_the_caption_agrees_with_ransac():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(40, 3))
    target = Sim3(1.3, TURN, np.ones(3)).apply(source) + 0.03 * rng.normal(size=(40, 3))
    target[:10] = 2 * rng.normal(size=(10, 3))
    images, pixels = np.zeros((2, 60, 60, 3)), rng.uniform(0, 60, (2, 40, 2))
    widget = alignment.ransac_settings(tuple(images), tuple(pixels), (source, target), TURN)
    for trials, threshold, seed in ((1000, 0.2, 0), (5, 0.1, 3), (100, 0.9, 7)):
        for name, value in (("trials", trials), ("threshold", threshold), ("seed", seed)):
            widget.controls[name].value = value
        sim3, inliers = ransac(source, target, threshold, trials, seed=seed, scale_range=(0.2, 5))
        assert f"{inliers.sum()} of 40 matches are inliers; scale {sim3.scale:.2f}" in widget.caption.value
        assert f"rotation error {rotation_error(sim3.R, TURN):.0f}°" in widget.caption.value
    line = np.outer(np.arange(40.0), [1, 2, 3])
    widget = alignment.ransac_settings(tuple(images), tuple(pixels), (line, line))
    assert widget.caption.value.startswith("No fit: ")


def test_the_caption_agrees_with_least_squares():
    source = np.random.default_rng(2).normal(size=(9, 3))
    widget = alignment.one_outlier(source, source)
    widget.controls["distance"].value = 3.0
    fit = umeyama(source, source + np.outer(np.arange(9) == 8, [3.0, 0, 0]))
    assert f"rotation changes by {rotation_error(fit.R, np.eye(3)):.1f}°" in widget.caption.value
    assert f"to {fit.scale:.2f}" in widget.caption.value


def test_hypotheses_have_their_score_and_probability_and_every_point_is_counted_once():
    solution, targets = examples.sample_solution()
    widget = verified.ranked_hypotheses(solution, targets)
    assert widget.controls["rank"].max == len(solution.hypotheses)
    for rank, one in enumerate(solution.hypotheses, 1):
        widget.controls["rank"].value = rank
        assert f"Hypothesis {rank} of {len(solution.hypotheses)}" in widget.caption.value
        assert f"score {one.score:.1f}, probability {one.confidence:.0%}" in widget.caption.value
    counts = widget.caption.value.split("target view 1: ")[1].rstrip(".")
    assert sum(int(part.split()[0]) for part in counts.split(", ")) == len(solution.scene.reference_points)


def test_order_probabilities_agree_with_a_simulation_and_stand_in_the_caption():
    rng = np.random.default_rng(0)
    a, b = rng.binomial(50, 0.4, 200_000), rng.binomial(50, 0.5, 200_000)
    assert np.allclose(metrics.order_probabilities(50, 0.4, 0.5), [np.mean(b > a), np.mean(b < a)], atol=0.004)
    widget = metrics.measured_accuracy()
    widget.controls["pairs"].value, widget.controls["gain"].value = 1000, 4
    above, below = (100 * share for share in metrics.order_probabilities(1000, 0.46, 0.5))
    assert f"above it in {above:.0f} % of all benchmarks, below it in {below:.0f} %" in widget.caption.value


def rectangle(width):
    """The outline of a rectangle 2 long, in the plane z = 0."""
    s = np.linspace(-1, 1, 201)
    sides = [(s, width + 0 * s), (s, -width + 0 * s), (1 + 0 * s, width * s), (-1 + 0 * s, width * s)]
    return np.vstack([np.column_stack([*side, 0 * s]) for side in sides])


def test_a_rectangle_coincides_after_a_half_turn_and_a_square_after_a_quarter():
    angles = np.array([0, 45, 90, 135, 180, 270])
    flat, square = (metrics.rotated_distance(rectangle(width), rectangle(width), angles) for width in (0.5, 1.0))
    assert np.allclose(flat[[0, 4]], 0, atol=1e-9) and (flat[[1, 2, 3, 5]] > 0.1).all()
    assert np.allclose(square[[0, 2, 4, 5]], 0, atol=1e-9) and (square[[1, 3]] > 0.1).all()
    # A point at +x, rotated by 90 degrees about z, is at +y.
    moved = metrics.rotated_distance(np.array([[1.0, 0, 5]]), np.array([[0.0, 1, 5]]), np.array([90]))
    assert np.isclose(moved[0], 0)
    widget = metrics.symmetry_rotation({"rectangle": rectangle(0.5), "square": rectangle(1.0)})
    widget.controls["angle"].value, widget.controls["cloud"].value = 90, "square"
    assert "rotation error 90°" in widget.caption.value and "distance 0.00" in widget.caption.value


def test_the_bars_are_the_shares_of_pairs_within_the_threshold():
    widget = metrics.accuracy_threshold({"first": np.array([5.0, 20, 40, 170]), "second": np.array([50.0, 60])})
    widget.controls["threshold"].value = 55
    assert [bar.get_width() for bar in widget.figure.axes[0].patches] == [75, 50]
    assert "Within 55°: first 75 %, second 50 %" in widget.caption.value
