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

__version__ = "0.3.0"

# Public names by the module that holds them, "" for modules; `__init__.pyi` has them for editors. They are imported on
# first use: torch takes seconds to import, which `zsp-lite --help` does not need.
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
