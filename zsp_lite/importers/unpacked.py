"""Zips and videos of captures, unpacked to a temporary folder that lives as long as the process."""

import os
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from lzma import LZMAError
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from zsp_lite.data.frames import MAX_PIXELS
from zsp_lite.errors import InputError
from zsp_lite.io.files import file_size

_MOST, _LARGE, _RATIO = 20e9, 1e9, 200  # bytes of an unpacked zip; above the second at most 200 times those of the zip
_DAMAGE = (zipfile.BadZipFile, zlib.error, LZMAError, struct.error, OSError, EOFError, RuntimeError, ValueError)
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # silent


@cache
def _workplace() -> tempfile.TemporaryDirectory:
    """Make the temporary folder of this process."""
    return tempfile.TemporaryDirectory(prefix="zsp-lite-", ignore_cleanup_errors=True)


def new_folder() -> Path:
    """Make a folder that is removed at the end of the process."""
    return Path(tempfile.mkdtemp(dir=_workplace().name))


@cache
def unpack(path: Path) -> Path:
    """Unpack a zip to a temporary folder; InputError if it is damaged, encrypted, malicious or too large."""
    size, folder = file_size(path, "zip"), new_folder()
    try:
        with zipfile.ZipFile(path) as zipped:
            if not (problem := _problem(zipped.infolist(), size)):
                zipped.extractall(folder)
    except _DAMAGE as error:
        problem = f"is damaged: {error}"
    if problem:
        raise InputError(f"zip {path} {problem}, expected a capture as an app exports it")
    return folder


def _problem(members: Sequence[zipfile.ZipInfo], size: int) -> str:
    """Say why a zip of `size` bytes is not to be unpacked; "" if it is."""
    total = sum(one.file_size for one in members)
    if total > min(_MOST, max(_LARGE, _RATIO * size)):
        return f"of {size:,} bytes unpacks to {total:,}"
    for one in members:
        name = one.filename.replace("\\", "/")
        if name.startswith("/") or ":" in name or ".." in name.split("/"):
            return f"has a path that leads out of it, {name[:100]!r}"
        if one.flag_bits & 1 or stat.S_ISLNK(one.external_attr >> 16):
            return f"has an encrypted file or a link, {name[:100]!r}"
    return ""


def open_video(path: Path) -> Callable[[int], UInt8[np.ndarray, "h w 3"]]:
    """Return a function that decodes the frame with a number, as it is stored; the numbers may not decrease.

    InputError if the file is no video, and by the function if it has no such frame.
    """
    file_size(path, "video")
    with open(path, "rb") as file:
        is_video = file.read(8)[4:] == b"ftyp"  # other files may name addresses, which are not to be opened
    video, position = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG) if is_video else cv2.VideoCapture(), -1
    pixels = video.get(cv2.CAP_PROP_FRAME_WIDTH) * video.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if not video.isOpened() or pixels > MAX_PIXELS:
        raise InputError(f"video {path} cannot be decoded, expected an MP4 file of at most {MAX_PIXELS} pixels")
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)

    def read(number: int) -> UInt8[np.ndarray, "h w 3"]:
        nonlocal position
        while position < number and video.grab():
            position += 1
        decoded, image = video.retrieve() if position == number else (False, None)
        if not decoded:
            raise InputError(f"video {path} ends before frame {number}")
        return image[..., ::-1]

    return read
