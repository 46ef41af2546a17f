"""Object masks without a box: what stands on the supporting plane where the cameras look.

The plane of the table or floor is fitted to the points of all frames. What is above it falls into connected parts; the
object is the part at the point that the optical axes approach. Where depth is unknown, colours decide.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import Frame, mask_to_bbox
from zsp_lite.data.geometry import fit_plane
from zsp_lite.errors import InputError
from zsp_lite.importers.masks import separate_colours

# All lengths are relative to the distance of the cameras from the point that they look at.
REACH = 0.7  # points farther from that point are not part of the object
PLANE_DISTANCE = 0.01  # largest distance of a point of the plane
_CLEARANCE = 0.02  # smallest height of a point of the object above the plane
_VOXEL = 0.07  # parts that are farther apart than this are separate
_PLANES = 3  # planes to try: the largest may be a wall or a side of the object
_MAX_BELOW = 0.05  # share of the points that may lie below the supporting plane
_MIN_ON_PLANE = 0.05  # share of the points that must lie on it
_MIN_SPREAD = (
    0.7  # least deviation of the points on it, relative to that of the others: a side of the object is smaller
)
_POINTS = 20_000
_MIN_PIXELS = 100
# The bounding box of the object in known depth grows by these shares of its sides, half of it on each side: pixels of
# unknown depth inside the first box may be on the object, and the colours of the background are those in the second.
UNKNOWN_PADDING, CONTEXT_PADDING = 0.1, 0.8


def masks_from_depth(frames: Sequence[Frame]) -> list[Frame]:
    """Segment the object in frames of one world; a mask is empty where a frame does not show the object.

    InputError if no depth is known, or nothing stands out where the cameras look. A single camera looks at what is near
    the middle of its image.
    """
    if not any((frame.depth > 0).any() for frame in frames):
        raise InputError(f"no depth is known in any of {len(frames)} frames, expected some to find the object")
    points = [world_points(frame) for frame in frames]
    focus, distance = _focus(frames, points)
    near = [np.linalg.norm(one - focus, axis=-1) < REACH * distance for one in points]  # False for NaN
    plane = supporting_plane(frames, [one[chosen] for one, chosen in zip(points, near)], distance)
    if plane is not None:
        normal, offset = plane
        near = [chosen & (one @ normal - offset > _CLEARANCE * distance) for one, chosen in zip(points, near)]
    parts = _part_at(focus, points, near, _VOXEL * distance)
    masked = [replace(frame, mask=_with_unknown(frame, part)) for frame, part in zip(frames, parts)]
    if not any(frame.mask.sum() >= _MIN_PIXELS for frame in masked):
        raise InputError(
            f"{frames[0].name or 'frame'}: nothing stands out from a plane where the camera looks, expected "
            "--box TOP,LEFT,HEIGHT,WIDTH around the object"
        )
    return masked


def world_points(frame: Frame) -> Float[np.ndarray, "h w 3"]:
    """World points of all pixels, NaN where the depth is unknown."""
    points = frame.camera.to_world(unproject_depth(frame.depth, frame.camera))
    points[frame.depth <= 0] = np.nan
    return points


def supporting_plane(
    frames: Sequence[Frame], points: Sequence[Float[np.ndarray, "_ 3"]], distance: float
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """Fit the plane `normal @ x = offset` that an object stands on to the points around it; None if there is none.

    The normal has length 1 and points to the side of the cameras.
    """
    centres = np.stack([frame.camera.centre for frame in frames])
    cloud = np.concatenate(points)
    cloud = cloud[:: max(1, -(-len(cloud) // _POINTS))]
    rest = cloud
    for _ in range(_PLANES):
        if len(rest) < _MIN_PIXELS:
            break
        normal, offset = fit_plane(rest, PLANE_DISTANCE * distance)
        if np.median(centres @ normal - offset) < 0:
            normal, offset = -normal, -offset
        height = cloud @ normal - offset
        on = np.abs(height) < PLANE_DISTANCE * distance
        below = (height < -3 * PLANE_DISTANCE * distance).mean()
        if (
            on.mean() >= _MIN_ON_PLANE
            and below <= _MAX_BELOW
            and _extent(cloud[on]) >= _MIN_SPREAD * _extent(cloud[~on])
        ):
            return normal, offset
        rest = rest[np.abs(rest @ normal - offset) >= PLANE_DISTANCE * distance]
    return None


def _extent(points: Float[np.ndarray, "n 3"]) -> float:
    """Compute the root mean square distance of points from their centre."""
    return float(np.sqrt(points.var(axis=0).sum())) if len(points) else 0.0


def _focus(frames: Sequence[Frame], points: Sequence[np.ndarray]) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the point nearest to the optical axes of the cameras, and their mean distance from it.

    With one camera, or parallel axes, it is the median of the nearest quarter of the points in the central part.
    """
    centres = np.stack([frame.camera.centre for frame in frames])
    axes = np.stack([frame.camera.R[2] for frame in frames])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.sum(axis=0) / len(frames)
    if np.linalg.eigvalsh(system)[0] > 0.01:  # the axes differ by several degrees
        focus = np.linalg.solve(system, np.einsum("nij,nj->i", across, centres) / len(frames))
        if (np.einsum("nj,nj->n", focus - centres, axes) > 0).all():
            return focus, float(np.linalg.norm(focus - centres, axis=1).mean())
    first = next(k for k, frame in enumerate(frames) if (frame.depth > 0).any())
    known, (height, width) = frames[first].depth > 0, frames[first].camera.size
    middle = np.zeros_like(known)
    middle[height // 3 : height - height // 3, width // 3 : width - width // 3] = True
    chosen = points[first][known & middle if (known & middle).any() else known]
    depth = frames[first].camera.to_camera(chosen)[:, 2]
    focus = np.median(chosen[depth <= np.quantile(depth, 0.25)], axis=0)
    return focus, float(np.linalg.norm(focus - centres[first]))


def _part_at(
    focus: Float[np.ndarray, "3"], points: Sequence[np.ndarray], near: Sequence[np.ndarray], voxel: float
) -> list[Bool[np.ndarray, "_ _"]]:
    """Select, among the pixels `near`, those of the connected part at the focus.

    The part has the most points, each weighted by its distance from the focus.
    """
    cloud = np.concatenate([one[chosen] for one, chosen in zip(points, near)])
    selected = [np.zeros_like(chosen) for chosen in near]
    if len(cloud):
        cells = np.floor((cloud - cloud.min(axis=0)) / voxel).astype(int)
        grid = np.zeros(cells.max(axis=0) + 1, bool)
        grid[tuple(cells.T)] = True
        part = ndimage.label(grid, np.ones((3, 3, 3)))[0][tuple(cells.T)]
        weight = np.exp(-np.square(np.linalg.norm(cloud - focus, axis=1) / (8 * voxel)))
        ends = np.cumsum([chosen.sum() for chosen in near])[:-1]
        for mask, chosen, on_part in zip(selected, near, np.split(part == np.bincount(part, weight).argmax(), ends)):
            mask[chosen] = on_part
    return selected


def _with_unknown(frame: Frame, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Remove single pixels of a mask, and add the pixels of unknown depth around it that have the object's colours."""
    mask = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if mask.any():
        labels, unknown = np.full(mask.shape, cv2.GC_BGD, np.uint8), frame.depth == 0
        inner, context = padded_box(mask, UNKNOWN_PADDING), padded_box(mask, CONTEXT_PADDING)
        labels[inner][unknown[inner]] = cv2.GC_PR_FGD
        labels[mask > 0] = cv2.GC_FGD
        mask[context] |= separate_colours(frame.rgb[context], labels[context]) & unknown[context]
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(np.float32)


def padded_box(mask: np.ndarray, padding: float) -> tuple[slice, slice]:
    """Return the rows and columns of the bounding box of a mask, which grows by a share of its sides."""
    top, left, height, width = mask_to_bbox(mask, padding=padding)
    return slice(top, top + height), slice(left, left + width)
