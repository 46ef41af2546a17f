"""Figures of the notebooks on features and cyclical distances: what is drawn where, and in which colour."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch

from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.features import FeatureMap
from zsp_lite.matching import Matches
from zsp_lite.synthetic.ground_truth import GroundTruthPair
from zsp_lite.viz import feature_plots as figures
from zsp_lite.viz import plots

IMAGE = np.full((60, 80, 3), 128, np.uint8)
GRID = (3, 4)  # patches of 20 x 20 pixels
CAMERA = Camera(np.eye(3), np.zeros(3), np.array([100.0, 100.0]), np.array([40.0, 30.0]), (60, 80))
FRAME = Frame(IMAGE, None, None, CAMERA, "object/1")


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def markers(axis, shape="o"):
    return [tuple(line.get_xydata()[0]) for line in axis.lines if line.get_marker() == shape]


def test_the_chosen_view_is_marked_and_no_other():
    figure = figures.views_with_choice(FRAME, [FRAME] * 5, chosen=2)
    assert [bool(axis.patches) for axis in figure.axes] == [False] * 3 + [True] + [False] * 2
    assert figure.axes[3].get_title() == "target 3"


def test_patches_are_pulled_apart_in_their_order():
    patches = np.arange(3 * 4)[:, None, None, None].repeat(2 * 2 * 3).reshape(3, 4, 2, 2, 3).astype(np.uint8)
    figure = figures.image_in_patches(np.zeros((6, 8, 3), np.uint8), patches, corner=(1, 2), count=2)
    shown = figure.axes[1].images[1:]
    assert [int(image.get_array()[0, 0, 0]) for image in shown] == [6, 7, 10, 11]
    assert shown[1].get_extent()[0] > shown[0].get_extent()[1]


def test_a_position_is_marked_at_its_patch():
    figure = figures.maps_of_positions({(1, 2): np.eye(4)}, "cosine")
    assert markers(figure.axes[0]) == [(2.5, 1.5)]


def test_attention_is_shown_relative_to_its_largest_weight():
    weights = np.linspace(0, 0.5, 12).reshape(GRID)
    figure = figures.attention_of_patch(IMAGE, (0, 3), {"head 0": weights}, columns=1)
    assert figure.axes[0].images[-1].get_array().max() == 1
    assert figure.axes[0].get_title() == "head 0\nat most 50%" and markers(figure.axes[0]) == [(70, 10)]


def test_the_most_similar_patch_has_a_circle_and_the_true_one_a_star():
    similar = np.zeros(GRID)
    similar[2, 1] = 0.9
    figure = figures.similarities_of_patch(IMAGE, (0, 0), [IMAGE], {"key": similar}, np.array([1, 3]))
    first, second = (axis for axis in figure.axes if axis.get_title())
    assert markers(first) == [(10, 10)]
    assert markers(second) == [(30, 50)] and markers(second, "*") == [(70, 30)]


def test_true_partners_connects_patches_that_have_one():
    cells, valid = np.zeros((*GRID, 2), int), np.zeros(GRID, bool)
    valid[1, 2], cells[1, 2] = True, (2, 0)
    (line,) = figures.true_partners(GroundTruthPair("car", FRAME, FRAME, cells, valid), count=5).artists
    assert tuple(line.xy1) == (50, 30) and tuple(line.xy2) == (10, 50)


def test_scores_are_drawn_in_per_cent_with_a_line_for_guessing():
    scores = pd.DataFrame({"query": [0.1, 0.2], "key": [0.3, 0.4]}, index=[1, 6])
    axis = figures.scores_by_layer(scores, used=6, guessing=0.03).axes[0]
    lines = {line.get_label(): line for line in axis.lines}
    np.testing.assert_allclose(lines["key"].get_xydata(), [[1, 30], [6, 40]])
    np.testing.assert_allclose(lines["guessing"].get_ydata(), 3)


def test_each_row_of_pictures_has_its_title():
    axes = figures.rows_of_pictures({"a": [IMAGE] * 2, "b": [IMAGE] * 2}).axes
    assert [axis.get_title() for axis in axes] == ["a", "a", "b", "b"]


def test_every_head_and_the_saliency_have_a_panel():
    attention = np.stack([np.full(GRID, 0.2), np.full(GRID, 0.01)])
    figure = figures.cls_attention_and_saliency(IMAGE, attention, np.full(GRID, 0.5))
    titles = [axis.get_title() for axis in figure.axes if axis.get_title()]
    assert titles == ["CLS, head 0", "CLS, head 1", "saliency"]
    assert [axis.images[-1].get_array().max() for axis in figure.axes[:3]] == [1, 1, 0.5]


def test_patches_below_the_threshold_are_transparent():
    saliency = np.linspace(0, 1, 12).reshape(GRID)
    figure = figures.foreground_above(IMAGE, saliency, (0.01, 0.5))
    assert [int((~axis.images[-1].get_array().mask).sum()) for axis in figure.axes] == [11, 6]


def test_the_bold_curve_is_the_mean_of_the_others():
    overlap = np.array([[0.2, 0.4], [0.6, 0.8]])
    axis = figures.overlap_by_threshold(np.array([0, 0.5]), overlap, used=0.05).axes[0]
    bold = max(axis.lines[:-1], key=lambda line: line.get_linewidth())
    np.testing.assert_allclose(bold.get_ydata(), [0.4, 0.6])


def test_bins_are_nine_patches_and_eight_blocks_inside_the_image():
    figure = figures.bins_of_patches(np.zeros((90, 90, 3), np.uint8), {"a": (4, 4), "corner": (0, 0)}, (9, 9))
    boxes = [[patch.get_bbox().bounds for patch in axis.patches] for axis in figure.axes]
    assert [len(found) for found in boxes] == [17, 17]
    assert sum(bounds[2:] == (30, 30) for bounds in boxes[0]) == 8 and (40, 40, 10, 10) in boxes[0]
    assert (0, 0, 20, 20) in boxes[1]  # a block that the corner cuts


def test_every_backbone_has_its_own_column():
    def features(value):
        return FeatureMap(torch.ones(*GRID, 2), torch.full(GRID, value), torch.ones(2))

    maps = {"a": [features(0.1), features(0.2)], "b": [features(0.3), features(0.4)]}
    axes = figures.saliency_of_backbones({"cat": IMAGE, "cup": IMAGE}, maps).axes
    assert [axis.get_title() for axis in axes] == ["cat", "a", "b", "cup", "a", "b"]
    shown = [float(axis.images[-1].get_array().max()) for axis in (axes[1], axes[2], axes[4], axes[5])]
    np.testing.assert_allclose(shown, [0.1, 0.3, 0.2, 0.4])


def test_similarities_within_an_image_stand_in_its_row():
    similar = {name: {"cat": np.full(GRID, x), "cup": np.full(GRID, x / 2)} for name, x in (("a", 0.8), ("b", 0.4))}
    axes = figures.similarities_within_images(
        {"cat": IMAGE, "cup": IMAGE}, {"cat": (0, 0), "cup": (2, 3)}, similar
    ).axes
    assert markers(axes[0]) == [(10, 10)] and markers(axes[3]) == [(70, 50)]
    shown = [axes[place].images[-1].get_array().max() for place in (1, 2, 4, 5)]
    np.testing.assert_allclose(shown, [0.8, 0.4, 0.4, 0.2])


def test_the_wrong_cycle_of_the_toy_is_red_and_goes_back_dashed():
    values = np.arange(4).reshape(2, 2), np.arange(4).reshape(2, 2)
    figure = figures.toy_cycles(values, [((0, 0), (0, 1), (0, 0)), ((1, 0), (1, 1), (1, 0))], wrong=[1])
    colours = [artist.get_edgecolor() for artist in figure.artists]
    assert colours[0] == colours[1] != colours[2] == colours[3] and colours[2][0] > 0.8 > colours[2][1] + 0.7
    assert [artist.get_linestyle() for artist in figure.artists] == ["-", "--"] * 2
    assert tuple(figure.artists[2].xy1) == (0, 1) and tuple(figure.artists[3].xy2) == (0, 1)


def test_a_wrong_cycle_between_images_has_another_colour():
    cycles = {"right": np.array([(0, 0), (0, 1), (0, 0)]), "wrong": np.array([(2, 0), (1, 1), (2, 0)])}
    figure = figures.cycles_between(IMAGE, IMAGE, cycles, GRID, wrong=["wrong"])
    colours = [{line.get_color() for line in axis.lines} for axis in figure.axes]
    assert colours[0] == {"white"} and "white" not in colours[1]
    np.testing.assert_allclose(figure.axes[1].lines[0].get_xydata(), [[10, 50], [80 + 10 + 30, 30]])


def test_maps_of_cyclical_distances_leave_out_the_background():
    distances = np.full(GRID, -np.inf)
    distances[0, 0] = -1
    shown = [
        figures.cyclical_map(IMAGE, distances, IMAGE).axes[1],
        figures.cyclical_maps([IMAGE] * 2, {"a": distances, "b": distances}).axes[1],
    ]
    assert [int((~axis.images[-1].get_array().mask).sum()) for axis in shown] == [1, 1]


def test_counts_are_drawn_for_each_rule_in_its_row():
    table = pd.DataFrame({"mutual": [40, 60], "any": [200, 300]})
    axis = figures.counts_of_matches({"car": table, "chair": table + 1}, wanted=50).axes[0]
    labels = [tick.get_text() for tick in axis.get_yticklabels()]
    drawn = [points.get_offsets() for points in axis.collections]
    assert labels == ["any", "mutual"] and len(drawn) == 4
    assert drawn[0][:, 0].tolist() == [200, 300] and drawn[1][:, 0].tolist() == [40, 60]
    assert (np.round(drawn[1][:, 1]) == 1).all()


def test_bars_have_their_share_and_number():
    table = pd.DataFrame({"correct": [0.5, 0.25], "matches": [10, 8]}, index=["0", "longer"])
    axis = figures.correct_by_length(table).axes[0]
    assert [bar.get_height() for bar in axis.patches] == [50, 25]
    assert [text.get_text() for text in axis.texts] == ["50 % of 10", "25 % of 8"]


def test_dots_are_at_the_matches_of_the_reference():
    cells = np.array([[0, 0], [2, 3]])
    matches = Matches(cells, cells, np.array([0.0, 1.0]), np.ones(2))
    figure = figures.spread_of_matches(IMAGE, {"a": matches}, GRID)
    np.testing.assert_allclose(figure.axes[0].collections[0].get_offsets(), [[10, 10], [70, 50]])
    assert figure.get_size_inches()[0] >= 4  # 400 pixels


def test_accuracy_is_drawn_in_per_cent():
    curves = pd.DataFrame({"cyclical": [0.5, 0.4], "mutual": [0.3, 0.2]}, index=[10, 20])
    axis = figures.accuracy_by_number(curves).axes[0]
    np.testing.assert_allclose(axis.lines[1].get_xydata(), [[10, 30], [20, 20]])


def test_matches_that_are_not_good_are_dashed():
    cells = np.array([[0, 0], [1, 1]])
    good = np.array([True, False])
    figure = figures.judged_matches((IMAGE, IMAGE), (cells, cells), good, GRID, ("left", "right"))
    styles = [artist.get_linestyle() for artist in figure.artists]
    assert sum(style in ("-", "solid") for style in styles) == 1
    assert {artist.get_edgecolor() for artist in figure.artists if artist.get_linestyle() in ("-", "solid")}
    assert plots.patch_centres(cells[:1], GRID, IMAGE.shape[:2])[0].tolist() == [10, 10]
