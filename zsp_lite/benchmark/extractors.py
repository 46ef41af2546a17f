"""Feature extractors of the benchmark's rows by name."""

from collections.abc import Callable, Iterable
from typing import Any

import torch

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.baselines.posecontrast import load_posecontrast
from zsp_lite.baselines.rootsift import RootSift
from zsp_lite.baselines.sift import Sift
from zsp_lite.baselines.swav import load_swav
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureExtractor


def random_backbone(like: Backbone, seed: int = 0) -> Backbone:
    """Return a backbone of the same architecture with random weights."""
    if not isinstance(like, Backbone):
        raise InputError(f"method 'random' needs a Backbone whose architecture it copies, got {type(like).__name__}")
    model = like.model
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = VisionTransformer(model.image_size, model.patch_size, model.embed_dim, model.depth, model.num_heads)
    same = dict(facet=like.facet, image_size=like.image_size, mean=like.mean, std=like.std)
    return Backbone(fresh, f"random like {like.name}", like.layer, like.saliency_heads, like.device, **same)


# Functions of the backbone under test. An extractor is called on images, or its method `describe` on frames.
EXTRACTORS: dict[str, Callable[[Any], Any]] = {
    "none": lambda backbone: None,  # for rows that use depth only
    "backbone": lambda backbone: backbone,
    "random": random_backbone,
    "rootsift": lambda backbone: RootSift(),
    "sift": lambda backbone: Sift(),
    "swav": lambda backbone: load_swav(),
    "posecontrast": lambda backbone: load_posecontrast(),
}


def make_extractors(backbone: FeatureExtractor, names: Iterable[str]) -> dict[str, Any]:
    """Make extractors by name."""
    return {name: EXTRACTORS[name](backbone) for name in dict.fromkeys(names)}
