"""Import of RGB-D captures into CO3D's layout.

capture: a frame of a capture, and helpers of the readers
tum, nerfstudio, open3d_folder, lists: one reader per format
masks: object masks by GrabCut from a bounding box, or from files
fusion: fused point cloud of the object, and its scale
convert: the whole import
"""

from zsp_lite.importers.capture import CaptureFrame
from zsp_lite.importers.convert import READERS, import_capture

__all__ = ["READERS", "CaptureFrame", "import_capture"]
