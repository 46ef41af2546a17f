"""What widgets are made of, and those on features: each answers a control, and says what the numbers say."""

import ast
import importlib
import sys
import time
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch

from zsp_lite.backbones.load import load_backbone
from zsp_lite.errors import InputError
from zsp_lite.matching import similarity
from zsp_lite.synthetic.ground_truth import correct_matches

pytest.importorskip("ipywidgets", reason="widgets need ipywidgets: pip install 'zsp-lite[notebooks]'")
matplotlib.use("agg")

from zsp_lite.widgets import WIDGETS, common, features, latency  # noqa: E402

GRID = (28, 28)
build = cache(latency.build_example)


@pytest.fixture(scope="module")
def truth():
    return common.example_truth()


def picture_changes(widget, control, value) -> bool:
    before = widget.picture.value
    widget.controls[control].value = value
    return widget.picture.value != before


def test_no_module_imports_ipywidgets_before_a_widget_is_made():
    for path in Path(common.__file__).parent.glob("*.py"):
        for node in ast.parse(
            path.read_text()
        ).body:  # what is inside functions and TYPE_CHECKING is no statement of body
            names = (
                [alias.name for alias in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", "")]
            )
            assert "ipywidgets" not in names, path.name


def test_without_ipywidgets_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(InputError, match="pip install ipywidgets"):
        common.slider("x", 0, 1, 0)


def test_every_registered_widget_has_its_example():
    for place in WIDGETS.values():
        module, function = place.split(":")
        assert callable(getattr(importlib.import_module(f"zsp_lite.widgets.{module}"), function)), place


def test_an_unknown_widget_is_refused_by_name():
    with pytest.raises(InputError, match="expected one of"):
        latency.build_example("nothing")


def test_a_control_calls_update_with_all_values_and_the_sentence_is_shown():
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(1, 1))
    line = axis.axvline(0)
    calls = []

    def update(x, name):
        calls.append((x, name))
        line.set_xdata([x, x])
        return f"x is {x}, {name}"

    controls = {"x": common.slider("x", 0.0, 1.0, 0.0, 0.25), "name": common.choice("name", ["a", "b"])}
    widget = common.explorer(figure, controls, update, "a line")
    assert picture_changes(widget, "x", 0.5)
    widget.controls["name"].value = "b"
    assert calls[-2:] == [(0.5, "a"), (0.5, "b")] and widget.sentence.value == "x is 0.5, b"
    assert widget.picture.value[:4] == b"\x89PNG" and not plt.fignum_exists(figure.number)


def test_positions_for_timing_always_move_the_control():
    for control in (
        common.slider("x", 0, 9, 3),
        common.slider("y", 0.0, 1.0, 0.0, 0.1),
        common.choice("z", ["a", "b"]),
    ):
        positions = latency.moves(control, 7)
        assert len(positions) >= 5
        assert all(a != b for a, b in zip([control.value, *positions], positions))


def test_attention_names_the_patch_with_the_largest_weight(truth):
    backbone = load_backbone("zsp-tiny", "cpu")
    image, model = truth.reference.rgb, backbone.model
    found = features.all_facets(backbone, [image])
    queries, keys = (torch.cat([found[n, name] for n in range(model.depth)]) for name in ("query", "key"))
    widget = features.attention(image, queries, keys, GRID, model.num_heads)
    assert picture_changes(widget, "layer", 4)
    widget.controls["head"].value, widget.controls["row"].value = 2, 20
    col, d = widget.controls["col"].value, model.embed_dim // model.num_heads
    q, k = (found[4, name][0].unflatten(1, (model.num_heads, d))[:, 2] for name in ("query", "key"))
    logits = k @ q[1 + 20 * 28 + col] / d**0.5
    top = divmod(int(logits[1:].argmax()), 28)
    assert f"patch ({top[0]}, {top[1]})" in widget.sentence.value


def test_all_facets_are_what_the_backbone_gives_layer_by_layer(truth):
    image = truth.reference.rgb
    found = features.all_facets(load_backbone("zsp-tiny", "cpu"), [image])
    for layer, facet in ((9, "key"), (3, "value"), (11, "token")):
        keys = load_backbone("zsp-tiny", "cpu", layer=layer, facet=facet)([image])[0].keys
        assert torch.allclose(found[layer, facet][0, 1:], keys.flatten(0, 1), atol=1e-3)


def test_facets_report_the_share_of_right_neighbours(truth):
    widget = build("facets")
    widget.controls["layer"].value = 9
    assert picture_changes(widget, "facet", "token")
    keys = load_backbone("zsp-tiny", "cpu", facet="token")([truth.reference.rgb, truth.target.rgb])
    nearest = similarity(*(one.keys for one in keys)).argmax(1).numpy()
    cells = np.stack(np.divmod(nearest, 28), -1).reshape(28, 28, 2)
    share = correct_matches(cells, truth.cells)[truth.valid].mean()
    assert f"{share:.0%} have" in widget.sentence.value


def test_context_follows_both_sliders(truth):
    widget = build("context")
    assert picture_changes(widget, "row", 5) and picture_changes(widget, "col", 3)
    row_col = (5, 3)
    assert ("not in sight" in widget.sentence.value) == (not truth.valid[row_col])


def test_saliency_counts_the_patches_above_the_threshold():
    view = common.example_pair()[0]
    widget = features.saliency(view)
    assert picture_changes(widget, "threshold", 0.5)
    assert f"{int((view.features.saliency > 0.5).sum())} of 784 patches" in widget.sentence.value


@pytest.mark.parametrize("name", ["attention", "facets", "context", "saliency"])
def test_an_answer_costs_less_than_the_limit(name):
    # This process's own work: the machine may be busy with other things.
    for control, milliseconds in latency.measure(build(name), 3, time.process_time).items():
        assert milliseconds < latency.LIMIT, control
