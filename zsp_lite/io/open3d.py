"""The one place that imports Open3D, lazily."""

import ctypes
import functools
import os
import sys


@functools.cache
def load_open3d():
    """Import and return the `open3d` module.

    Open3D's Linux wheels link against libusb-1.0, which a bare machine lacks. The wheel `libusb-package` carries that
    shared object; loading it with global symbols first satisfies the linker without root. In a notebook Open3D would
    start a web server for its own viewer, which nothing here uses, and print that it did: it is told not to, unless
    the environment says otherwise.
    """
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    if sys.platform.startswith("linux"):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
