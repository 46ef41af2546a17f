"""What speaks against an automatic mask: its shape, the depth around it, and the colours."""

from collections import Counter
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.data.frames import ON_OBJECT, Frame, frame_defect
from zsp_lite.data.geometry import largest_region
from zsp_lite.importers.geometry_masks import (
    CONTEXT_PADDING,
    PLANE_DISTANCE,
    REACH,
    UNKNOWN_PADDING,
    padded_box,
    supporting_plane,
    world_points,
)
from zsp_lite.importers.masks import separate_colours

_BORDERS = 2  # of the image that a mask may not touch at once
_MOST = 0.5  # share of the image
_PARTS = 0.25  # share of the mask outside its largest region
_COLOUR_IOU = 0.4  # least overlap with the mask that GrabCut finds in the padded bounding box
_LYING = 0.5  # share of the object's points that may lie in the plane around it


Plane = tuple[Float[np.ndarray, "3"], float]


def mask_flags(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Say in one line what speaks against the masks of frames of one world; frames with empty masks do not count.

    The thresholds were chosen on renderings.
    """
    frames = [frame for frame in frames if (frame.mask > ON_OBJECT).any() and not frame_defect(frame)]
    if not frames:
        return ()
    plane, distance = _plane_around(frames)
    found = Counter(sign for frame in frames for sign in _signs(frame, plane, distance))
    signs = [f"{sign} ({count} of {len(frames)} frames)" for sign, count in found.items()]
    if plane is None:
        signs.append("no plane is found that the object stands on")
    return (f"the masks may be wrong: {', '.join(signs)}",) if signs else ()


def _signs(frame: Frame, plane: Plane | None, distance: float) -> Iterator[str]:
    """Name what speaks against the mask of a frame."""
    mask = frame.mask > ON_OBJECT
    width = max(mask.shape) // 100 + 1  # of the border, pixels
    if sum(edge.any() for edge in (mask[:width], mask[-width:], mask[:, :width], mask[:, -width:])) >= _BORDERS:
        yield "several borders of the image are touched"
    if mask.mean() > _MOST:
        yield "most of the image is covered"
    if largest_region(mask).sum() < (1 - _PARTS) * mask.sum():
        yield "several separate parts"
    if _colour_overlap(frame.rgb, mask) < _COLOUR_IOU:
        yield "colours disagree"
    if plane is not None:
        normal, offset = plane
        height = world_points(frame)[mask & (frame.depth > 0)] @ normal - offset
        if (height < PLANE_DISTANCE * distance).sum() > _LYING * len(height):
            yield "much of it lies in the plane around it"


def _plane_around(frames: Sequence[Frame]) -> tuple[Plane | None, float]:
    """Fit the plane that an object stands on to points outside of its masks; return also the cameras' distance."""
    points, masks = [world_points(frame) for frame in frames], [frame.mask > ON_OBJECT for frame in frames]
    centre = np.nanmedian(np.concatenate([one[mask] for one, mask in zip(points, masks)]), axis=0)
    distance = float(np.mean([np.linalg.norm(frame.camera.centre - centre) for frame in frames]))
    widened = [cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for mask in masks]
    near = [np.linalg.norm(one - centre, axis=-1) < REACH * distance for one in points]  # False for NaN
    around = [one[chosen & ~mask] for one, chosen, mask in zip(points, near, widened)]
    return supporting_plane(frames, around, distance), distance


def _colour_overlap(rgb: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> float:
    """Compute the IoU of a mask and the region that GrabCut finds in its padded bounding box."""
    context = padded_box(mask.astype(np.uint8), CONTEXT_PADDING)
    labels = np.full(mask.shape, cv2.GC_BGD, np.uint8)
    labels[padded_box(mask.astype(np.uint8), UNKNOWN_PADDING)] = cv2.GC_PR_FGD
    found, mask = largest_region(separate_colours(rgb[context], labels[context])), mask[context]
    return float((found & mask).sum() / (found | mask).sum())
