"""The widgets on features agree with the library at the values of their controls."""

import matplotlib
import numpy as np
import pytest
import torch

from zsp_lite.backbones.load import load_backbone
from zsp_lite.matching import similarity
from zsp_lite.synthetic.ground_truth import correct_matches

pytest.importorskip("ipywidgets", reason="widgets need ipywidgets: pip install 'zsp-lite[notebooks]'")
matplotlib.use("agg")

from tools import widget_examples as examples
from zsp_lite.widgets import features  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def truth():
    return examples.sample_pair()


def picture_changes(widget, control, value) -> bool:
    before = widget.picture.value
    widget.controls[control].value = value
    return widget.picture.value != before


def test_attention_names_the_patch_with_the_largest_weight(truth):
    backbone = load_backbone("zsp-tiny", "cpu")
    image, model = truth.reference.rgb, backbone.model
    facets = features.all_facets(backbone, [image])
    widget = examples.attention()
    assert picture_changes(widget, "layer", 4)
    widget.controls["head"].value, widget.controls["row"].value = 2, 20
    col, d = widget.controls["col"].value, model.embed_dim // model.num_heads
    q, k = (facets[4, name][0].unflatten(1, (model.num_heads, d))[:, 2] for name in ("query", "key"))
    logits = k @ q[1 + 20 * 28 + col] / d**0.5
    top = divmod(int(logits[1:].argmax()), 28)
    assert f"patch ({top[0]}, {top[1]})" in widget.caption.value


def test_all_facets_equal_the_features_of_the_backbone_for_each_layer(truth):
    image = truth.reference.rgb
    facets = features.all_facets(load_backbone("zsp-tiny", "cpu"), [image])
    for layer, facet in ((9, "key"), (3, "value"), (11, "token")):
        keys = load_backbone("zsp-tiny", "cpu", layer=layer, facet=facet)([image])[0].keys
        assert torch.allclose(facets[layer, facet][0, 1:], keys.flatten(0, 1), atol=1e-3)


def test_facets_report_the_fraction_of_correct_nearest_neighbours(truth):
    widget = examples.facets()
    widget.controls["layer"].value = 9
    assert picture_changes(widget, "facet", "token")
    keys = load_backbone("zsp-tiny", "cpu", facet="token")([truth.reference.rgb, truth.target.rgb])
    nearest = similarity(*(one.keys for one in keys)).argmax(1).numpy()
    cells = np.stack(np.divmod(nearest, 28), -1).reshape(28, 28, 2)
    share = correct_matches(cells, truth.cells)[truth.valid].mean()
    assert f"{share:.0%} have" in widget.caption.value


def test_context_follows_both_sliders(truth):
    widget = examples.context()
    assert picture_changes(widget, "row", 5) and picture_changes(widget, "col", 3)
    row_col = (5, 3)
    assert ("not visible" in widget.caption.value) == (not truth.valid[row_col])


def test_saliency_counts_the_patches_above_the_threshold():
    view = examples.sample_views()[0]
    widget = examples.saliency()
    assert picture_changes(widget, "threshold", 0.5)
    assert f"{int((view.features.saliency > 0.5).sum())} of 784 patches" in widget.caption.value
