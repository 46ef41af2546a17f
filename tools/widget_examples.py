"""Every widget on sample data, for the tests."""

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

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

GRID = (28, 28)  # patches of zsp-tiny


@cache
def sample_pair() -> GroundTruthPair:
    """Load a sample pair with its ground-truth matches."""
    dataset = Co3D(sample_data())
    return ground_truth_pair(dataset, demo_pairs(dataset)[-1])


@cache
def sample_views() -> tuple[View, View]:
    """Return the views of `sample_pair`."""
    reference, target = extract_views(_backbone(), [sample_pair().reference, sample_pair().target])
    return reference, target


def attention() -> Widget:
    """`patches.attention` on a sample object."""
    image, backbone = sample_pair().reference.rgb, _backbone()
    facets = patches.all_facets(backbone, [image])
    queries, keys = (
        torch.cat([facets[layer, facet] for layer in range(backbone.model.depth)])
        for facet in ("query", "key")
    )
    return patches.attention(image, queries, keys, GRID, backbone.model.num_heads)


def patch_similarities() -> Widget:
    """`patches.patch_similarities` on a sample pair: the keys of two layers, and those of the last
    with context."""
    pair, (first, second) = sample_pair(), sample_views()
    tokens = patches.all_facets(_backbone(), [pair.reference.rgb, pair.target.rgb])
    sims = {
        f"layer {n}, key": similarity(*tokens[n, "key"][:, 1:].unflatten(1, GRID)) for n in (3, 11)
    }
    sims["bare key"] = key_similarities(first.features.keys, [second.features.keys])[0]
    return patches.patch_similarities(
        pair.reference.rgb, pair.target.rgb, sims, pair.cells, pair.valid
    )


def saliency() -> Widget:
    """`patches.saliency` on a sample object."""
    return patches.saliency(sample_views()[0])


def cycle() -> Widget:
    """`cycles.cycle` on a sample pair."""
    return cycles.cycle(*sample_views(), similarity(*(view.features for view in sample_views())))


def ransac_settings() -> Widget:
    """`outliers.ransac_settings` on a sample pair."""
    pair = sample_views()
    found = match(pair[0].features, pair[1].features)
    images = tuple(view.frame.rgb for view in pair)
    return outliers.ransac_settings(
        images, tuple(match_pixels(pair, found)), match_points(*pair, found)
    )


def one_outlier() -> Widget:
    """`outliers.one_outlier` on random points."""
    points = np.random.default_rng(0).normal(size=(12, 3))
    return outliers.one_outlier(points, points)


def box_to_mask() -> Widget:
    """`mask_box.box_to_mask` on a sample frame."""
    dataset = Co3D(sample_data())
    category = dataset.categories()[0]
    frame = dataset.load(dataset.frames(category, dataset.sequences(category)[0].sequence_name)[0])
    return mask_box.box_to_mask(frame, mask_to_bbox(frame.mask))


def label_poses() -> Widget:
    """`labelling.label_poses` on a temporary copy of a sample category, with four keypoints on two
    objects."""
    folder = TemporaryDirectory(prefix="zsp-lite-")
    category = Co3D(sample_data()).categories()[0]
    shutil.copytree(sample_data() / category, Path(folder.name) / category)
    session = Labelling(folder.name, category)
    for sequence in session.sequences[:2]:
        points = session.cloud(sequence)[0]
        for point in points[:: len(points) // 4][:4]:
            session.pick(sequence, point)
    box = labelling.label_poses(session)
    box.controls["sequence"].value = session.sequences[1]
    box.folder = folder  # deleted with the widget
    return box


WIDGETS: dict[str, Callable[[], Widget]] = {
    build.__name__: build
    for build in (
        attention,
        patch_similarities,
        saliency,
        cycle,
        ransac_settings,
        one_outlier,
        box_to_mask,
        label_poses,
    )
}


@cache
def _backbone() -> Backbone:
    return load_backbone("zsp-tiny", "cpu")
