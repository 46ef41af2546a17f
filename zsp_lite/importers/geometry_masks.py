"""Object masks without a box: what stands on the supporting plane where the cameras look; and flags of doubtful masks.

The plane of the table or floor is fitted to the points of all frames. What is above it falls into connected parts; the
object is the part at the point that the optical axes approach. Where depth is unknown, colours decide.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import ON_OBJECT, Frame, frame_defect, mask_to_bbox
from zsp_lite.data.geometry import fit_plane, largest_region
from zsp_lite.errors import InputError
from zsp_lite.importers.masks import separate_colours
from zsp_lite.points import standard_deviation

# All lengths are relative to the distance of the cameras from the point that they look at.
_REACH = 0.7  # points farther from that point are not part of the object
_PLANE_DISTANCE = 0.01  # largest distance of a point of the plane
_CLEARANCE = 0.02  # smallest height of a point of the object above the plane
_VOXEL = 0.07  # parts that are farther apart than this are separate
_PLANES = 3  # planes to try: the largest may be a wall or a side of the object
_MAX_BELOW = 0.05  # share of the points that may lie below the supporting plane
_MIN_ON_PLANE = 0.05  # share of the points that must lie on it
_MIN_SPREAD = 0.7  # least deviation of the points on it, relative to that of the others: sides of objects are smaller
_POINTS = 20_000
_MIN_PIXELS = 100
# The bounding box of the object in known depth grows by these shares of its sides, half of it on each side: pixels of
# unknown depth inside the first box may be on the object, and the colours of the background are those in the second.
_UNKNOWN_PADDING, _CONTEXT_PADDING = 0.1, 0.8
# A mask is flagged beyond these values, which were chosen on renderings.
_BORDERS = 2  # number of the image's borders that a mask may not touch at once
_MOST = 0.5  # share of the image
_PARTS = 0.25  # share of the mask outside its largest region
_COLOUR_IOU = 0.4  # least overlap with the mask that GrabCut finds in the padded bounding box
_LYING = 0.5  # share of the object's points that may lie in the plane around it

Plane = tuple[Float[np.ndarray, "3"], float]  # unit normal, to the side of the cameras, and offset: normal @ x = offset


def masks_from_depth(frames: Sequence[Frame]) -> list[Frame]:
    """Segment the object in frames of one world; a mask is empty where a frame does not show the object.

    InputError if no depth is known, or nothing stands out where the cameras look. A single camera looks at what is near
    the middle of its image.
    """
    if not any((frame.depth > 0).any() for frame in frames):
        raise InputError(f"no depth is known in any of {len(frames)} frames, expected some to find the object")
    points = [_world_points(frame) for frame in frames]
    focus, distance = _focus(frames, points)
    near = [np.linalg.norm(one - focus, axis=-1) < _REACH * distance for one in points]  # False for NaN
    plane = _supporting_plane(frames, [one[chosen] for one, chosen in zip(points, near)], distance)
    if plane is not None:
        near = [chosen & (one @ plane[0] - plane[1] > _CLEARANCE * distance) for one, chosen in zip(points, near)]
    parts = _part_at(focus, points, near, _VOXEL * distance)
    masked = [replace(frame, mask=_with_unknown(frame, part)) for frame, part in zip(frames, parts)]
    if not any(frame.mask.sum() >= _MIN_PIXELS for frame in masked):
        raise InputError(
            f"{frames[0].name or 'frame'}: nothing stands out from a plane where the camera looks, expected "
            "--box TOP,LEFT,HEIGHT,WIDTH around the object"
        )
    return masked


def mask_flags(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Say in one line what speaks against the masks of frames of one world; frames with empty masks do not count."""
    frames = [frame for frame in frames if (frame.mask > ON_OBJECT).any() and not frame_defect(frame)]
    if not frames:
        return ()
    plane, distance = _plane_around(frames)
    found = Counter(sign for frame in frames for sign in _signs(frame, plane, distance))
    signs = [f"{sign} ({count} of {len(frames)} frames)" for sign, count in found.items()]
    if plane is None:
        signs.append("no plane is found that the object stands on")
    return (f"the masks may be wrong: {', '.join(signs)}",) if signs else ()


def _world_points(frame: Frame) -> Float[np.ndarray, "h w 3"]:
    """World points of all pixels, NaN where the depth is unknown."""
    points = frame.camera.to_world(unproject_depth(frame.depth, frame.camera))
    points[frame.depth <= 0] = np.nan
    return points


def _supporting_plane(
    frames: Sequence[Frame], points: Sequence[Float[np.ndarray, "_ 3"]], distance: float
) -> Plane | None:
    """Fit the plane that an object stands on to the points around it; None if there is none."""
    centres = np.stack([frame.camera.centre for frame in frames])
    cloud = np.concatenate(points)
    cloud = cloud[:: max(1, -(-len(cloud) // _POINTS))]
    rest = cloud
    for _ in range(_PLANES):
        if len(rest) < _MIN_PIXELS:
            break
        normal, offset = fit_plane(rest, _PLANE_DISTANCE * distance)
        if np.median(centres @ normal - offset) < 0:
            normal, offset = -normal, -offset
        height = cloud @ normal - offset
        on = np.abs(height) < _PLANE_DISTANCE * distance
        below = (height < -3 * _PLANE_DISTANCE * distance).mean()
        spread, other_spread = (standard_deviation(cloud[some]) if some.any() else 0.0 for some in (on, ~on))
        if spread >= _MIN_SPREAD * other_spread and on.mean() >= _MIN_ON_PLANE and below <= _MAX_BELOW:
            return normal, offset
        rest = rest[np.abs(rest @ normal - offset) >= _PLANE_DISTANCE * distance]
    return None


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
    """Select the pixels `near` in the connected part with the most points, which count less far from the focus."""
    cloud = np.concatenate([one[chosen] for one, chosen in zip(points, near)])
    selected = [chosen.copy() for chosen in near]
    if len(cloud):
        cells = np.floor((cloud - cloud.min(axis=0)) / voxel).astype(int)
        grid = np.zeros(cells.max(axis=0) + 1, bool)
        grid[tuple(cells.T)] = True
        part = ndimage.label(grid, np.ones((3, 3, 3)))[0][tuple(cells.T)]
        weight = np.exp(-np.square(np.linalg.norm(cloud - focus, axis=1) / (8 * voxel)))
        ends = np.cumsum([mask.sum() for mask in selected])[:-1]
        for mask, on_part in zip(selected, np.split(part == np.bincount(part, weight).argmax(), ends)):
            mask[mask] = on_part
    return selected


def _with_unknown(frame: Frame, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Remove single pixels of a mask, and add the pixels of unknown depth around it that have the object's colours."""
    mask = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if mask.any():
        mask |= _colours_around(frame, mask > 0, certain=True) & (frame.depth == 0)
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(np.float32)


def _colours_around(frame: Frame, mask: Bool[np.ndarray, "h w"], certain: bool) -> Bool[np.ndarray, "h w"]:
    """Separate the colours in the bounding box of a mask from those around it by GrabCut.

    If the mask is `certain`, it is foreground, and of the other pixels only those of unknown depth may be.
    """
    boxes = [mask_to_bbox(mask.astype(np.uint8), padding=padding) for padding in (_UNKNOWN_PADDING, _CONTEXT_PADDING)]
    inner, context = (np.s_[top : top + height, left : left + width] for top, left, height, width in boxes)
    possible, found = np.zeros_like(mask), np.zeros_like(mask)
    possible[inner] = (frame.depth[inner] == 0) | (not certain)
    found[context] = separate_colours(frame.rgb[context], possible[context], mask[context] & certain)
    return found


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
    found = largest_region(_colours_around(frame, mask, certain=False))
    if (found & mask).sum() / (found | mask).sum() < _COLOUR_IOU:
        yield "colours disagree"
    if plane is not None:
        height = _world_points(frame)[mask & (frame.depth > 0)] @ plane[0] - plane[1]
        if (height < _PLANE_DISTANCE * distance).sum() > _LYING * len(height):
            yield "much of it lies in the plane around it"


def _plane_around(frames: Sequence[Frame]) -> tuple[Plane | None, float]:
    """Fit the plane that an object stands on to points outside of its masks; return also the cameras' distance."""
    points, masks = [_world_points(frame) for frame in frames], [frame.mask > ON_OBJECT for frame in frames]
    centre = np.nanmedian(np.concatenate([one[mask] for one, mask in zip(points, masks)]), axis=0)
    distance = float(np.mean([np.linalg.norm(frame.camera.centre - centre) for frame in frames]))
    widened = [cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for mask in masks]
    near = [np.linalg.norm(one - centre, axis=-1) < _REACH * distance for one in points]  # False for NaN
    around = [one[chosen & ~mask] for one, chosen, mask in zip(points, near, widened)]
    return _supporting_plane(frames, around, distance), distance
