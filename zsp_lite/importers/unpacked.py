"""Zips and videos of captures, unpacked to a temporary folder that lives as long as the process."""

import atexit
import os
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from lzma import LZMAError
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from zsp_lite.data.frames import MAX_PIXELS
from zsp_lite.errors import InputError
from zsp_lite.io.files import file_size, path_inside

# Limits of an unpacked zip: bytes; bytes above which it may have at most so many times those of the
# zip.
_MOST = 20e9
_LARGE = 1e9
_RATIO = 200
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    LZMAError,
    struct.error,
    OSError,
    EOFError,
    RuntimeError,
    ValueError,
)
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # silent


def new_folder() -> Path:
    """Make a folder that is removed at the end of the process."""
    folder = tempfile.mkdtemp(prefix="zsp-lite-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


@cache
def unpack(path: Path) -> Path:
    """Unpack a zip to a temporary folder; InputError if it is damaged, encrypted or too large."""
    size = file_size(path, "zip")
    folder = new_folder()
    try:
        with zipfile.ZipFile(path) as zipped:
            total = sum(member.file_size for member in zipped.infolist())
            if total > min(_MOST, max(_LARGE, _RATIO * size)):
                raise InputError(f"{size:,} bytes unpack to {total:,}")
            for member in zipped.infolist():
                path_inside(folder, member.filename)
            zipped.extractall(folder)  # makes no links
    except _DAMAGE as error:
        raise InputError(
            f"zip {path} cannot be unpacked: {error}, expected a capture as an app exports it"
        ) from error
    return folder


def open_video(path: Path) -> Callable[[int], UInt8[np.ndarray, "h w 3"]]:
    """Return a function that decodes the frame with a number, as it is stored.

    The numbers may not decrease. InputError if the file is no video, and by the function if it has
    no such frame.
    """
    file_size(path, "video")
    with open(path, "rb") as file:
        # An MP4 file. Others may name addresses, which are not to be opened.
        is_video = file.read(8)[4:] == b"ftyp"
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG) if is_video else cv2.VideoCapture()
    position = -1
    pixels = video.get(cv2.CAP_PROP_FRAME_WIDTH) * video.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if not video.isOpened() or pixels > MAX_PIXELS:
        raise InputError(
            f"video {path} cannot be decoded, expected an MP4 file of at most {MAX_PIXELS} pixels"
        )
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)

    def read(number: int) -> UInt8[np.ndarray, "h w 3"]:
        """Decode the frame with a number."""
        nonlocal position
        while position < number and video.grab():
            position += 1
        decoded = False
        if position == number:
            decoded, image = video.retrieve()
        if not decoded:
            raise InputError(f"video {path} ends before frame {number}")
        return image[..., ::-1]

    return read
