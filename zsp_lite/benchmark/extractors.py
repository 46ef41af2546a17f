"""Who describes images for the benchmark's rows, by name, and how to tell two of them apart."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.baselines.posecontrast import load_posecontrast, load_posecontrast_tiny
from zsp_lite.baselines.rootsift import RootSift
from zsp_lite.baselines.sift import Sift
from zsp_lite.baselines.swav import load_swav, load_swav_tiny
from zsp_lite.benchmark.identity import backbone_digest, digest_of
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap

Extractor = Callable[[list[np.ndarray]], list[FeatureMap]]

# Makers from the backbone under test. What one makes is called on a list of images, or, where it has `describe`, on
# a list of frames.
EXTRACTORS: dict[str, Callable[[Any], Any]] = {
    "none": lambda backbone: None,  # for rows that look at depth alone
    "backbone": lambda backbone: backbone,
    "random": lambda backbone: random_backbone(backbone),
    "rootsift": lambda backbone: RootSift(),
    "sift": lambda backbone: Sift(),
    "swav": lambda backbone: load_swav(),
    "swav-tiny": lambda backbone: load_swav_tiny(),
    "posecontrast": lambda backbone: load_posecontrast(),
    "posecontrast-tiny": lambda backbone: load_posecontrast_tiny(),
}


def make_extractors(backbone: Extractor, names: Iterable[str]) -> dict[str, Any]:
    """The named extractors. Raises InputError for unknown names, and where a row's weights are not at hand."""
    names = list(dict.fromkeys(names))
    if unknown := [name for name in names if name not in EXTRACTORS]:
        raise InputError(f"features {unknown}: expected some of {', '.join(EXTRACTORS)}")
    return {name: EXTRACTORS[name](backbone) for name in names}


def random_backbone(like: Backbone, seed: int = 0) -> Backbone:
    """A backbone of the same shape with random weights: what the architecture alone is worth."""
    if not isinstance(like, Backbone):
        raise InputError(f"method 'random' needs a Backbone to copy the shape of, got {type(like).__name__}")
    model = like.model
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = VisionTransformer(model.image_size, model.patch_size, model.embed_dim, model.depth, model.num_heads)
    same = dict(facet=like.facet, image_size=like.image_size, mean=like.mean, std=like.std)
    return Backbone(fresh, f"random like {like.name}", like.layer, like.saliency_heads, like.device, **same)


def fingerprint(extractor: Any) -> str:
    """An extractor's name and a hash of its weights and of what it does with them, or of what someone's own is.

    Retrained weights of the same name are another extractor, and so are another block or facet, another size of the
    input and another mean or standard deviation to normalise it by.
    """
    name = getattr(extractor, "name", type(extractor).__name__)
    if extractor is None:
        return name
    return f"{name} {backbone_digest(extractor) if isinstance(extractor, Backbone) else digest_of(extractor)}"
