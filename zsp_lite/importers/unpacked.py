"""Zips and videos of captures, unpacked to a temporary folder that lives as long as the process."""

import atexit
import os
import shutil
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from zsp_lite.data.frames import MAX_PIXELS
from zsp_lite.errors import InputError
from zsp_lite.io.files import file_size, path_inside

# Largest number of bytes of an unpacked zip. Above `_LARGE` bytes, it may also have at most
# `_RATIO` times those of the zip: more would be a zip bomb.
_MOST = 20e9
_LARGE = 1e9
_RATIO = 200
_MATROSKA = b"\x1aE\xdf\xa3"  # first bytes of a Matroska file
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # no messages


def new_folder() -> Path:
    """Make a folder that is removed at the end of the process."""
    folder = tempfile.mkdtemp(prefix="zsp-lite-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


@cache  # callers recognise a path more than once: its zip is unpacked once
def unpack(path: Path) -> Path:
    """Unpack a zip to a temporary folder; InputError if it is damaged, encrypted or too large."""
    size = file_size(path, "zip")
    folder = new_folder() / path.name  # messages name the zip
    try:
        with zipfile.ZipFile(path) as zipped:
            total = sum(member.file_size for member in zipped.infolist())
            if total > min(_MOST, max(_LARGE, _RATIO * size)):
                raise InputError(f"{size:,} bytes unpack to {total:,}")
            for member in zipped.infolist():
                path_inside(folder, member.filename)  # InputError if the path leads out
            zipped.extractall(folder)  # makes no links
    except Exception as error:  # a damaged zip may raise anything
        raise InputError(
            f"zip {path} cannot be unpacked: {error}, expected a capture as an app exports it"
        ) from error
    return folder


class Video:
    """Frames of an MP4 or Matroska file.

    Use one of `times`, `frame` and `at` per object: each moves the position in the file.
    """

    def __init__(self, path: Path, displayed: bool = False):
        """Open a file; `displayed` frames are turned as players show them, others lie as stored.

        InputError if the file is no such video.
        """
        file_size(path, "video")
        with open(path, "rb") as file:
            header = file.read(8)
        # Files of other formats, such as playlists, may name addresses, which must not be opened.
        is_video = header[4:] == b"ftyp" or header.startswith(_MATROSKA)
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG) if is_video else cv2.VideoCapture()
        pixels = video.get(cv2.CAP_PROP_FRAME_WIDTH) * video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if not video.isOpened() or pixels > MAX_PIXELS:
            raise InputError(
                f"video {path} cannot be decoded, expected an MP4 or Matroska file of at most "
                f"{MAX_PIXELS} pixels"
            )
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, int(displayed))
        self.path = path
        self.count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))  # number of frames by the header
        self._video = video
        self._position = -1  # number of the frame that was decoded last

    def times(self) -> list[float]:
        """Read the times of all frames in milliseconds, up to the end of the video."""
        times = []
        while self._video.grab():
            times.append(self._video.get(cv2.CAP_PROP_POS_MSEC))
        return times

    def frame(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        """Decode the frame with a number, from 0 on; the numbers may not decrease."""
        while self._position < number and self._video.grab():
            self._position += 1
        # Behind the end, OpenCV would print a message.
        image = self._video.retrieve()[1] if self._position == number else None
        if image is None:
            raise InputError(f"video {self.path} ends before frame {number}")
        return image[..., ::-1]

    def at(self, seconds: float) -> UInt8[np.ndarray, "h w 3"]:
        """Decode the frame at a time."""
        self._video.set(cv2.CAP_PROP_POS_MSEC, 1000 * seconds)
        decoded, image = self._video.read()
        if not decoded:
            raise InputError(f"video {self.path} ends before {seconds:.2f} s")
        return image[..., ::-1]
