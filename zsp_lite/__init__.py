"""Zero-shot category-level object pose estimation (Goodwin et al., ECCV 2022), as a small library.

    import zsp_lite
    method = zsp_lite.ZeroShotPose(zsp_lite.load_backbone())
    pose = method.estimate(reference_frame, target_frames).sim3

Read the files in this order:

    minimal      the whole method on one page
    pipeline     the method, composed of stages, each in a file of its own:
    views        object crop, features, foreground
    features     feature maps and log-binned descriptors
    matching     cyclical distances and correspondences; matchers: the alternatives of the supplement
    best_view    selection of the target view to align with
    alignment    Umeyama's method in RANSAC
    points       points of the object
    estimates    the results, and the protocol of solvers
    metrics      rotation errors and their statistics
    demo         one pair of each category, from data folder to pose error
    own_objects  one pair of your own, from files to files

    data         CO3D folders, frames, cameras, depth, labels, pairs
    backbones    vision transformers and how to load them
    viz          plots, 3D scenes, the HTML report
    io           files, downloads, PLY, Open3D
    verified     a solver beyond the paper that tests many poses in all target views
    benchmark    the paper's tables
    baselines, labelling, importers, synthetic, training, widgets, cli
"""

import importlib
from typing import TYPE_CHECKING

__version__ = "0.3.0"

if TYPE_CHECKING:  # for editors and type checkers; a test compares it with `_HOMES`
    from zsp_lite import (
        alignment,
        backbones,
        baselines,
        benchmark,
        best_view,
        choices,
        cli,
        data,
        demo,
        errors,
        estimates,
        features,
        importers,
        io,
        labelling,
        matchers,
        matching,
        metrics,
        minimal,
        own_objects,
        pipeline,
        points,
        samples,
        synthetic,
        training,
        verified,
        views,
        viz,
        widgets,
    )
    from zsp_lite.alignment import Sim3
    from zsp_lite.backbones import checkpoints, facets, huggingface, vit
    from zsp_lite.backbones.backbone import Backbone
    from zsp_lite.backbones.load import load_backbone
    from zsp_lite.data import annotations, cameras, check, co3d, depth, frames, labels, pairs
    from zsp_lite.data.cameras import Camera
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.frames import Frame
    from zsp_lite.errors import InputError
    from zsp_lite.estimates import PoseEstimate
    from zsp_lite.features import FeatureMap
    from zsp_lite.io import download, files, ply
    from zsp_lite.matching import Matches
    from zsp_lite.own_objects import estimate_pose, open_source
    from zsp_lite.pipeline import ZeroShotPose
    from zsp_lite.viz import plots, report, scene3d

# Public names by the module or package that holds them. They are imported on first use: torch takes seconds to import,
# which `zsp-lite --help` does not need.
_HOMES = {
    "": "alignment best_view choices demo errors estimates features matchers matching metrics minimal own_objects "
    "pipeline points samples views backbones baselines benchmark cli data importers io labelling synthetic training "
    "verified viz widgets",
    "alignment": "Sim3",
    "backbones": "checkpoints facets huggingface vit",
    "backbones.backbone": "Backbone",
    "backbones.load": "load_backbone",
    "data": "annotations cameras check co3d depth frames labels pairs",
    "data.cameras": "Camera",
    "data.co3d": "Co3D",
    "data.frames": "Frame",
    "errors": "InputError",
    "estimates": "PoseEstimate",
    "features": "FeatureMap",
    "io": "download files ply",
    "matching": "Matches",
    "own_objects": "estimate_pose open_source",
    "pipeline": "ZeroShotPose",
    "viz": "plots report scene3d",
}
_FUNCTIONS = ("load_backbone", "estimate_pose", "open_source")
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}

__all__ = ["__version__", *_HOME_OF]


def __getattr__(name: str):
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = ".".join(filter(None, (__name__, _HOME_OF[name])))
    if name[0].isupper() or name in _FUNCTIONS:
        return getattr(importlib.import_module(home), name)
    return importlib.import_module(f"{home}.{name}")


def __dir__() -> list[str]:
    return sorted(__all__)
