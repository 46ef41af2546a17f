"""Import of RGB-D captures into CO3D's layout: a reader per format, object masks, the fused point cloud."""

from zsp_lite.importers.capture import READERS, CaptureFrame
from zsp_lite.importers.convert import import_capture

__all__ = ["READERS", "CaptureFrame", "import_capture"]
