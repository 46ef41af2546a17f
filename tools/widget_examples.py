"""Every widget on sample data, for the tests.

How to write a widget:

- Write one function that takes computed data (views, matrices, errors), draws a matplotlib figure
  once, and returns `interactive_figure(...)`.
- Its `update` callback is called when a control moves. It changes existing artists (`set_data`,
  `set_offsets`, `set_text`), or draws a primitive of `viz.plots` anew (`redrawing`). Expensive
  results are computed before.
- `update` returns a caption with the numbers that the figure shows, also for readers who cannot see
  it or its colours.
- The latency of a control should be at most 150 ms. Keep figures below about 9 by 4 inches.
- The figure is a PNG in an image widget, which every frontend shows. Patches are chosen by
  sliders, which work by keyboard.
- The notebook shows a static figure as well (`show`), because widgets need a running kernel.
- Add an example here.
"""

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.load import load_backbone
from zsp_lite.course.demo import demo_pairs
from zsp_lite.course.labelling.session import Labelling
from zsp_lite.course.samples import sample_data
from zsp_lite.course.true_matches import GroundTruthPair, ground_truth_pair
from zsp_lite.course.widgets import cycles, labelling, mask_box, outliers, patches
from zsp_lite.course.widgets.common import Widget
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import mask_to_bbox
from zsp_lite.estimates import match_points
from zsp_lite.matching import key_similarities, match, similarity
from zsp_lite.views import View, extract_views
from zsp_lite.viz.plots import match_pixels


@cache
def sample_pair() -> GroundTruthPair:
    """Load a sample pair, the last of the demo, with its ground-truth matches."""
    dataset = Co3D(sample_data())
    return ground_truth_pair(dataset, demo_pairs(dataset)[-1])


@cache
def sample_views() -> tuple[View, View]:
    """Return the views of `sample_pair`."""
    reference, target = extract_views(_backbone(), [sample_pair().reference, sample_pair().target])
    return reference, target


def patch_similarities() -> Widget:
    """`patches.patch_similarities` on a sample pair: keys with and without their context."""
    pair = sample_pair()
    keys, other = (view.features.keys for view in sample_views())
    sims = {"17 bins": similarity(keys, other), "bare key": key_similarities(keys, [other])[0]}
    return patches.patch_similarities(
        pair.reference.rgb, pair.target.rgb, sims, pair.cells, pair.valid
    )


def cycle() -> Widget:
    """`cycles.cycle` on a sample pair."""
    reference, target = sample_views()
    return cycles.cycle(reference, target, similarity(reference.features, target.features))


def ransac_settings() -> Widget:
    """`outliers.ransac_settings` on a sample pair."""
    reference, target = sample_views()
    matches = match(reference.features, target.features)
    return outliers.ransac_settings(
        (reference.frame.rgb, target.frame.rgb),
        tuple(match_pixels(sample_views(), matches)),
        match_points(reference, target, matches),
    )


def box_to_mask() -> Widget:
    """`mask_box.box_to_mask` on a sample frame, whose object, unlike in a crop, has much around
    it."""
    dataset = Co3D(sample_data())
    category = dataset.categories()[0]
    sequence = dataset.sequences(category)[0].sequence_name
    frame = dataset.load(dataset.frames(category, sequence)[0])
    return mask_box.box_to_mask(frame, mask_to_bbox(frame.mask))


def label_poses() -> Widget:
    """`labelling.label_poses` on a copy of a sample category, with four keypoints on two
    objects."""
    folder = TemporaryDirectory(prefix="zsp-lite-")
    category = Co3D(sample_data()).categories()[0]
    shutil.copytree(sample_data() / category, Path(folder.name) / category)
    session = Labelling(folder.name, category)
    for sequence in session.sequences[:2]:
        points = session.cloud(sequence)[0]
        # Four points at equal steps of the cloud.
        for point in points[:: len(points) // 4][:4]:
            session.pick(sequence, point)
    box = labelling.label_poses(session)
    box.controls["sequence"].value = session.sequences[1]
    box.folder = folder  # The folder is deleted with the widget.
    return box


WIDGETS: dict[str, Callable[[], Widget]] = {
    build.__name__: build
    for build in (
        patch_similarities,
        cycle,
        ransac_settings,
        outliers.drag_match,
        box_to_mask,
        label_poses,
    )
}


@cache
def _backbone() -> Backbone:
    """Load the backbone once."""
    return load_backbone("zsp-tiny", "cpu")
