"""The one place that imports Open3D, lazily."""

import ctypes
import functools
import sys


@functools.cache
def load_open3d():
    """Import and return the `open3d` module.

    Open3D's Linux wheels link against libusb-1.0, which a bare machine lacks. The wheel `libusb-package` carries that
    shared object; loading it with global symbols first satisfies the linker without root.
    """
    if sys.platform.startswith("linux"):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
