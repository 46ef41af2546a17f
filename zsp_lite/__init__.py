"""Zero-shot category-level object pose estimation (Goodwin et al., ECCV 2022), as a small library.

    import zsp_lite
    method = zsp_lite.ZeroShotPose(zsp_lite.load_backbone())
    pose = method.estimate(reference_frame, target_frames).sim3

Read the files in this order:

    minimal      the whole method on one page
    pipeline     the method, composed of stages, each in a file of its own:
    views        object crop, features, foreground
    features     feature maps and log-binned descriptors
    matching     cyclical distances and correspondences
    matchers     the alternatives of the supplement
    best_view    selection of the target view to align with
    alignment    Umeyama's method in RANSAC
    points       points of the object
    estimates    the results, and the protocol of solvers
    metrics      rotation errors, medians and accuracies

    data, backbones, viz, io, benchmark, baselines, importers, cli
    course       what the notebooks need besides

Beyond the paper:

    verified     a solver that tests many poses in all target views
    scans        what several frames, whole shapes or all objects of a category tell together
    objects      objects of your own, from files to files
"""

import ast
import ctypes
import importlib.util
import os
from pathlib import Path

__version__ = "0.3.0"

# Public names, and the modules that hold them, stand in `__init__.pyi`, for editors too. They are
# imported on first use: torch takes seconds to import, which `zsp-lite --help` does not need.
_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOME_OF = {}
for _node in _STUB.body:
    if isinstance(_node, ast.ImportFrom):
        for _alias in _node.names:
            _HOME_OF[_alias.name] = _node.module

__all__ = ["__version__", *_HOME_OF]

# Without this variable, Open3D starts a server in a notebook.
os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
# Open3D's Linux wheels link against libusb-1.0, which is often not installed. A package of Python
# carries it; importing that package takes longer than all else here.
_found = importlib.util.find_spec("libusb_package")
if _found and (_library := Path(_found.origin).with_name("libusb-1.0.so")).is_file():
    ctypes.CDLL(str(_library), mode=ctypes.RTLD_GLOBAL)


def __getattr__(name: str):
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = importlib.import_module(_HOME_OF[name])
    if name in vars(home):
        return vars(home)[name]
    # A public module, such as `co3d`, is an attribute of its package only after its import.
    return importlib.import_module(f"{home.__name__}.{name}")


def __dir__() -> list[str]:
    return sorted(__all__)
