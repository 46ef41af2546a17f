"""Zero-shot category-level object pose estimation (Goodwin et al., ECCV 2022): the method on a small library.

    import zsp_lite
    method = zsp_lite.ZeroShotPose(zsp_lite.load_backbone())
    pose = method.estimate(reference_frame, target_frames).sim3
"""

import importlib

__version__ = "0.1.0"

# Where each name lives. Names and modules come when first asked for: torch takes seconds, `zsp-lite --help` need not.
_HOMES = {
    "Camera": "cameras",
    "Co3D": "co3d",
    "FeatureMap": "features",
    "Frame": "frames",
    "InputError": "errors",
    "Matches": "matching",
    "PoseEstimate": "pipeline",
    "Sim3": "alignment",
    "ZeroShotPose": "pipeline",
    "load_backbone": "backbones",
}

_MODULES = (
    "alignment", "backbones", "best_view", "cameras", "co3d", "depth", "features", "frames", "labels", "matching",
    "metrics", "pairs", "pipeline", "plots", "scene3d", "vit",
)  # fmt: skip

__all__ = ["__version__", *_HOMES, *_MODULES]


def __getattr__(name: str):
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
