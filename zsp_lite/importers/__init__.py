"""One's own RGB-D captures brought into CO3D's layout.

capture     a capture as all formats give it: images, depth, cameras in one world
tum, nerfstudio, open3d_folder, lists    a reader for each format
masks       the object in every frame: from a box by GrabCut, or given
fusion      one point cloud of the object, and the scale that CO3D has
convert     all of it in one call
"""

from zsp_lite.importers.capture import Capture, CaptureFrame
from zsp_lite.importers.convert import READERS, import_capture

__all__ = ["READERS", "Capture", "CaptureFrame", "import_capture"]
