"""Import of Open3D. All other modules call `load_open3d` instead of importing it."""

import ctypes
import functools
import os
import sys


@functools.cache
def load_open3d():
    """Import and return the `open3d` module."""
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # it would start a server in a notebook
    # Open3D's Linux wheels link against libusb-1.0, which is often not installed: it is loaded from a package.
    if sys.platform.startswith("linux"):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
