"""Decoding of JPEG and PNG files, with a limit on their size in pixels; damaged files are refused."""

import os
import struct
import threading

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from zsp_lite.errors import InputError

MAX_PIXELS = 1 << 26  # the environment variable overrides it
PIXELS_VARIABLE = "ZSP_LITE_MAX_PIXELS"
_NO_SIZE = (0xC4, 0xC8, 0xCC)  # the JPEG markers from 0xC0 to 0xCF that do not start a frame
_DAMAGE = b"Corrupt JPEG data", b"Premature end of JPEG", b"Inconsistent progression"  # warnings of libjpeg
_capturing = threading.Lock()


def max_pixels() -> int:
    """Return the largest number of pixels of an image: $ZSP_LITE_MAX_PIXELS, or `MAX_PIXELS`.

    Raises:
        InputError: The variable is not a positive whole number.
    """
    text = os.environ.get(PIXELS_VARIABLE) or str(MAX_PIXELS)
    if not (text.isascii() and text.isdigit() and len(text) < 19 and int(text) > 0):
        raise InputError(f"environment variable {PIXELS_VARIABLE} is {text!r}, expected a positive whole number")
    return int(text)


def decode_image(data: bytes, flags: int) -> UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."]:
    """Decode a JPEG or PNG file.

    Args:
        data: Content of the file.
        flags: OpenCV's flags for `imdecode`.

    Returns:
        The image as OpenCV returns it.

    Raises:
        InputError: The file is of another format, incomplete or damaged, or has more than `max_pixels()` pixels.
    """
    height, width = _size(data)
    most = max_pixels()
    if not 0 < height * width <= most:
        raise InputError(f"{height} x {width} pixels, expected 1 to {most} pixels ({PIXELS_VARIABLE})")
    # OpenCV fills the missing part of a truncated file with grey. A complete file has an end marker after the last
    # start of image data (a JPEG's embedded thumbnail has an end marker of its own).
    is_jpeg = data[:2] == b"\xff\xd8"
    start, end = (b"\xff\xda", b"\xff\xd9") if is_jpeg else (b"IDAT", b"IEND")
    image, warning = None, b""
    if data.rfind(end) > data.rfind(start):
        try:
            if is_jpeg:
                image, warning = _decode_jpeg(data, flags)
            else:
                image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:  # beyond a limit of OpenCV
            image = None
    if image is None:
        raise InputError("expected a complete JPEG or PNG")
    if warning.startswith(_DAMAGE):
        raise InputError(f"{warning.decode(errors='replace').strip()}, expected an undamaged JPEG")
    return image


def _size(data: bytes) -> tuple[int, int]:
    """Read (height, width) from the header."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR" and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return height, width
    at = 2 if data[:2] == b"\xff\xd8" else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in _NO_SIZE:
            return struct.unpack(">HH", data[at + 5 : at + 9])
        at += 1 if marker == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")  # 0xFF: a fill byte
    raise InputError("expected a complete JPEG or PNG")


def _decode_jpeg(data: bytes, flags: int) -> tuple[np.ndarray | None, bytes]:
    """Decode a JPEG file. Returns the image and libjpeg's first warning.

    OpenCV does not report that libjpeg replaced damaged data by grey; libjpeg prints it. The standard error stream is
    therefore a pipe during the call. Lines that are not of libjpeg are passed on.
    """
    with _capturing:
        try:
            kept = os.dup(2)
        except OSError:  # a process without a standard error stream
            return cv2.imdecode(np.frombuffer(data, np.uint8), flags), b""
        reading, writing = os.pipe()
        for end in (reading, writing):
            os.set_blocking(end, False)
        try:
            os.dup2(writing, 2)
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(writing)
            try:
                printed = os.read(reading, 1 << 16)
            except BlockingIOError:
                printed = b""
            os.close(reading)
    damage = b""
    for line in printed.splitlines(keepends=True):
        if line.startswith(_DAMAGE):
            damage = line
        else:
            os.write(2, line)
    return image, damage
