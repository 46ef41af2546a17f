"""Import of RGB-D captures into CO3D's layout.

capture: a frame of a capture
nerfstudio, lists: one reader per format
masks: object masks by colours, from a bounding box
geometry_masks: object masks by depth and colours, and what speaks against a mask
convert: the whole import, with the fused point cloud of the object
"""

from zsp_lite.importers.capture import CaptureFrame
from zsp_lite.importers.convert import READERS, import_capture

__all__ = ["READERS", "CaptureFrame", "import_capture"]
