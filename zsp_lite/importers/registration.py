"""Check that depth is registered to the colours: it must rise at the outlines of the masks.

The steps of depth across the outlines of all frames are compared with those across outlines that
are scaled and shifted. Only masks that do not come from depth can tell.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.data.frames import ON_OBJECT, Frame
from zsp_lite.errors import Doubt

_FRAMES = 8  # largest number of frames, about
_LEAST = 3  # fewer frames do not tell flat objects from a shift
_SIDE = 160  # longest side of the images that are compared, pixels
_SHIFT = 20  # largest shift along either axis, pixels of these images
_BORDER = ((_SHIFT, _SHIFT), (_SHIFT, _SHIFT), (0, 0))
_AROUND = 0.1  # least share of the image where depth around the object is known
# Masks that are a little too wide or narrow look like depth at one of the middle scales.
_SCALES = (0.8, 0.9, 1.0, 1.1, 1.25)
# Positions of the scales 0.9 to 1.1, and of the shifts -1 to 1 among those from -`_SHIFT` on.
_REGISTERED = np.s_[1:4, 19:22, 19:22]
# Steps are between pixels this far on both sides: right at an outline, depth is often unknown.
_APART = 3
_HIGHEST = 0.15  # higher steps, of the logarithm of depth, count as this one
# Least share of the highest steps at the outlines. Of 34 registered scans, all have more, also with
# noise and inexact masks; all have less if depth is shifted by 5 % of the image, or has a field of
# view of 80 %.
_SHARE = 0.75


def misregistration(frames: Sequence[Frame]) -> str:
    """Say how depth must be moved and scaled to fit given masks, or return ""."""
    # Steps across the outlines by scale, and by shift down and right.
    steps = np.zeros((len(_SCALES), 2 * _SHIFT + 1, 2 * _SHIFT + 1))
    for position in range(0, len(frames), len(frames) // _FRAMES + 1):
        frame = frames[position]
        step = -(-max(frame.depth.shape) // _SIDE)  # rounded up
        depth = frame.depth[::step, ::step]
        mask = (frame.mask[::step, ::step] > ON_OBJECT).astype(np.float32)
        if (depth[mask == 0] > 0).sum() < _AROUND * depth.size:
            continue
        around = np.pad(_steps(np.log(np.where(depth > 0, depth, np.nan))), _BORDER)
        for of_scale, scale in zip(steps, _SCALES):
            matrix = cv2.getRotationMatrix2D(frame.camera.principal_point / step, 0, scale)
            outline = _steps(cv2.warpAffine(mask, matrix, mask.shape[::-1]))
            outline /= np.linalg.norm(outline) + 1e-9  # an empty mask has no outline
            # Inside a mask, depth is less.
            of_scale -= cv2.matchTemplate(around, outline, cv2.TM_CCORR)

    if len(frames) < _LEAST or steps[_REGISTERED].max() >= _SHARE * steps.max():
        return ""
    scale, down, right = np.unravel_index(steps.argmax(), steps.shape)
    # The step is that of the last frame: sizes are taken to be equal.
    x = step * (_SHIFT - right)
    y = step * (_SHIFT - down)
    return Doubt(
        "depth is not registered to the colours, or the masks are wrong: it fits if moved by about "
        f"{x}, {y} pixels and scaled by {1 / _SCALES[scale]:.2f}"
    )


def _steps(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """Return the steps of an image to the right and down; 0 where unknown."""
    both = [np.roll(image, -_APART, axis) - np.roll(image, _APART, axis) for axis in (1, 0)]
    return np.nan_to_num(np.clip(np.dstack(both), -_HIGHEST, _HIGHEST))
