"""Feature extractors of the benchmark's rows by name."""

from collections.abc import Callable, Iterable
from typing import Any

from zsp_lite.baselines.posecontrast import load_posecontrast
from zsp_lite.baselines.rootsift import RootSift
from zsp_lite.baselines.sift import Sift
from zsp_lite.baselines.swav import load_swav
from zsp_lite.features import FeatureExtractor

# Functions of the backbone under test. An extractor is called on images, or its method `describe` on frames.
EXTRACTORS: dict[str, Callable[[Any], Any]] = {
    "none": lambda backbone: None,  # for rows that use depth only
    "backbone": lambda backbone: backbone,
    "rootsift": lambda backbone: RootSift(),
    "sift": lambda backbone: Sift(),
    "swav": lambda backbone: load_swav(),
    "posecontrast": lambda backbone: load_posecontrast(),
}


def make_extractors(backbone: FeatureExtractor, names: Iterable[str]) -> dict[str, Any]:
    """Make extractors by name."""
    return {name: EXTRACTORS[name](backbone) for name in dict.fromkeys(names)}
