"""Decoding of JPEG and PNG files, with a limit on their size in pixels."""

import io
from contextlib import suppress

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from zsp_lite.errors import InputError

MAX_PIXELS = 1 << 26


def decode_image(data: bytes, flags: int, what: str) -> UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."]:
    """Decode the JPEG or PNG file `what` by OpenCV with its flags; InputError if it is damaged or too large."""
    is_jpeg = data[:2] == b"\xff\xd8"
    # OpenCV fills the missing part of a truncated file with grey. A complete file has an end marker after the last
    # start of image data (a JPEG's embedded thumbnail has an end marker of its own).
    start, end = (b"\xff\xda", b"\xff\xd9") if is_jpeg else (b"IDAT", b"IEND")
    image, expected = None, "a complete JPEG or PNG"
    with suppress(OSError, SyntaxError, cv2.error):  # SyntaxError: of Pillow, for another format
        width, height = (JpegImageFile if is_jpeg else PngImageFile)(io.BytesIO(data)).size  # reads the header only
        if width * height > MAX_PIXELS:
            expected = f"at most {MAX_PIXELS} pixels, not {height} x {width}"
        elif data.rfind(end) > data.rfind(start):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise InputError(f"{what} cannot be decoded ({len(data)} bytes), expected {expected}")
    return image
