"""Object masks of a capture by colours, from one bounding box (GrabCut)."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.data.cameras import Box
from zsp_lite.data.frames import Frame, frame_defect
from zsp_lite.data.geometry import largest_region
from zsp_lite.errors import InputError
from zsp_lite.points import object_pixels, object_points

_ITERATIONS = 4  # of GrabCut
_LONGEST_SIDE = 320  # pixels of an image in GrabCut, whose time is proportional to the area
_PADDING = 0.1  # of the projected bounding box, relative to its longer side
_SMALLEST_BOX = 4  # pixels
_BALL_OFFSET = 0.6  # distance of the ball's centre behind the visible surface, relative to its radius
_POINTS = 4000


def masks_from_box(frames: Sequence[Frame], box: Box) -> list[Frame]:
    """Segment the object in the frames of a capture, given its box (top, left, height, width) in the first one.

    OpenCV's GrabCut (Rother, Kolmogorov and Blake 2004) separates the colours inside and outside of a box. The box of
    a further frame is the projection of the object points of the frames before it and of a ball as wide as the first
    box, which stands for what is not visible there. A mask is empty where a further frame does not show the object.
    """
    height, width = frames[0].camera.size
    top, left, box_height, box_width = box
    inside = min(top, left) >= 0 and top + box_height <= height and left + box_width <= width
    if not inside or min(box_height, box_width) < _SMALLEST_BOX:
        raise InputError(f"box (top, left, height, width) is {tuple(box)}, expected one inside {(height, width)}")
    first = replace(frames[0], mask=grab_cut(frames[0].rgb, box))
    points = _inner_points(first)
    if not len(points):
        raise InputError(f"frame {first.name}: no object with known depth in the box {tuple(box)}, expected another")
    depth = float(np.median(first.depth[object_pixels(first)]))
    radius = depth * (np.array([box_width, box_height]) / first.camera.focal_length).max() / 2
    middle = np.array([left + box_width / 2, top + box_height / 2])
    directions = np.random.default_rng(0).normal(size=(_POINTS // 4, 3))
    ball = radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    ball += first.camera.unproject(middle, depth + _BALL_OFFSET * radius)
    masked = [first]
    for frame in frames[1:]:
        found = _project_box(frame, np.concatenate([points, ball]))
        seen = min(found[2:]) >= _SMALLEST_BOX and not frame_defect(frame)
        mask = grab_cut(frame.rgb, found) if seen else np.zeros(frame.camera.size, np.float32)
        masked.append(replace(frame, mask=mask))
        points = np.concatenate([points, _inner_points(masked[-1])])
        points = points[np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(int)]
    return masked


def grab_cut(rgb: UInt8[np.ndarray, "h w 3"], box: Box) -> Float[np.ndarray, "h w"]:
    """Return the mask of the largest region in a box (top, left, height, width) with other colours than around it."""
    top, left, height, width = box
    inside = np.zeros(rgb.shape[:2], bool)
    inside[top : top + height, left : left + width] = True
    return largest_region(separate_colours(rgb, inside)).astype(np.float32)


def separate_colours(
    rgb: UInt8[np.ndarray, "h w 3"], possible: Bool[np.ndarray, "h w"], certain: Bool[np.ndarray, "h w"] | bool = False
) -> Bool[np.ndarray, "h w"]:
    """Select the foreground by GrabCut on the image or a smaller copy: `certain` pixels, and some `possible` ones."""
    height, width = possible.shape
    labels = np.where(certain, cv2.GC_FGD, np.where(possible, cv2.GC_PR_FGD, cv2.GC_BGD)).astype(np.uint8)
    shrink = max(1, max(height, width) / _LONGEST_SIDE)
    size = max(1, round(width / shrink)), max(1, round(height / shrink))
    bgr = cv2.resize(rgb[..., ::-1], size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    foreground = (cv2.GC_FGD, cv2.GC_PR_FGD)
    if 0 < np.isin(small, foreground).mean() < 1:  # GrabCut needs pixels of both kinds
        cv2.setRNGSeed(0)  # GrabCut initialises its clusters at random
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(bgr, small, None, *models, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    found = np.isin(small, foreground).astype(np.float32)
    return cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5


def _inner_points(frame: Frame) -> Float[np.ndarray, "n 3"]:
    """World points inside the mask, without its border, where depth may be that of the background."""
    inner = replace(frame, mask=cv2.erode(frame.mask, np.ones((5, 5), np.uint8)))
    return frame.camera.to_world(object_points(inner))


def _project_box(frame: Frame, points: Float[np.ndarray, "n 3"]) -> Box:
    """Compute the padded bounding box of projected world points, of size 0 if they are not in the image."""
    height, width = frame.camera.size
    pixels, depth = frame.camera.project(points)
    pixels = pixels[depth > 0]
    if not len(pixels):
        return 0, 0, 0, 0
    low, high = np.percentile(pixels, [1, 99], axis=0)
    margin = _PADDING / 2 * (high - low).max()
    left, top = np.floor(low - margin).clip(0, (width - 1, height - 1)).astype(int)
    right, bottom = np.ceil(high + margin).clip(1, (width, height)).astype(int)
    return int(top), int(left), int(bottom - top), int(right - left)
