"""Import of RGB-D captures into CO3D's layout.

capture: a frame of a capture
nerfstudio, lists: one reader per format
masks, geometry_masks: object masks by colours from a bounding box, from files, or from depth
mask_flags: what speaks against a mask
fusion: fused point cloud of the object
convert: the whole import
"""

from zsp_lite.importers.capture import CaptureFrame
from zsp_lite.importers.convert import READERS, import_capture

__all__ = ["READERS", "CaptureFrame", "import_capture"]
