"""Errors of depth cameras and of masks, for renderings on which confidences are calibrated.

The noise is that of a structured-light camera (Nguyen, Izadi and Lovell 2012), the smeared silhouettes of a phone,
whose depth has a quarter of the image's resolution.
"""

from dataclasses import replace

import cv2
import numpy as np

from zsp_lite.data.frames import ON_OBJECT, Frame

_DISTANCE = 0.7  # metres from the camera to the object
_COARSE = 4  # pixels of the image per measured pixel
_MOST_PIXELS = 3  # by which a mask is too wide or too narrow


def as_measured(frame: Frame, rng: np.random.Generator) -> Frame:
    """Smear the depth of a rendered frame over silhouettes, add noise, and move the border of its mask."""
    mask = (frame.mask > ON_OBJECT).astype(np.uint8)
    on_object = frame.depth[(mask > 0) & (frame.depth > 0)]
    if not len(on_object):
        return frame
    unit = _DISTANCE / float(np.median(on_object))  # metres per length of the rendering
    size = frame.depth.shape[1] // _COARSE, frame.depth.shape[0] // _COARSE
    known = cv2.resize((frame.depth > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(frame.depth, size, interpolation=cv2.INTER_AREA) / known.clip(0.01)
    metres = unit * coarse
    coarse = coarse + (0.0012 + 0.0019 * (metres - 0.4) ** 2) / unit * rng.standard_normal(coarse.shape)
    depth = cv2.resize(coarse.astype(np.float32), frame.depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    moved = int(rng.integers(-_MOST_PIXELS, _MOST_PIXELS + 1))
    if moved:
        change = cv2.dilate if moved > 0 else cv2.erode
        mask = change(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(moved) + 1,) * 2))
    return replace(frame, depth=np.where(frame.depth > 0, depth, np.float32(0)), mask=mask.astype(np.float32))
