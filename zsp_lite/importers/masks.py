"""Object masks of a capture: by colours from a box (GrabCut), or by depth; flags of doubtful ones.

By depth, the plane of the table or floor is fitted to the points of all frames. What is above it
falls into connected parts; the object is the part at the point that the optical axes approach.
Where depth is unknown, colours decide.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from zsp_lite.data.cameras import Box, Camera
from zsp_lite.data.frames import ON_OBJECT, Frame, frame_defect, mask_to_bbox
from zsp_lite.errors import Contradiction, Doubt, InputError
from zsp_lite.importers.files import WINDOW_5
from zsp_lite.importers.segments import WINDOW_3, fit_plane, largest_region
from zsp_lite.points import object_pixels, sampling_step, standard_deviation, world_points

# Masks by colours.
_PADDING = 0.1  # of the projected bounding box, relative to its longer side
_SMALLEST_BOX = 4  # least side of a box, pixels
# Distance of the ball's centre behind the visible surface, relative to the ball's radius.
_BALL_OFFSET = 0.6
_POINTS = 4000  # largest number of the object's points that are projected into a frame
# Masks by depth. All lengths are relative to the distance of the cameras from the point they look
# at, the focus.
_REACH = 0.7  # points farther from the focus are not part of the object
_PLANE_DISTANCE = 0.01  # largest distance of a point of the plane
_OFF_PLANE = 3  # points farther than so many times this distance are clearly above or below it
_CLEARANCE = 0.02  # smallest height of a point of the object above the plane
_VOXEL = 0.07  # parts that are farther apart than this are separate
_PLANES = 3  # planes to try: the largest may be a wall or a side of the object
_MAX_BELOW = 0.05  # share of the points that may lie below the supporting plane
_MIN_ON_PLANE = 0.05  # share of the points that must lie on the supporting plane
# Least deviation of the points on the supporting plane, relative to the deviation of all others:
# a side of an object is smaller.
_MIN_SPREAD = 0.7
# Two objects are alike if the ratio of their numbers of points exceeds the first value, and the
# ratio of their extents the second. Points count less the farther they are from the focus.
_COMPARABLE = 0.5
_ALIKE = 0.7
# From this number of views on, parts are separate if they are farther apart than `_VOXEL` divided
# by the factor below. Fewer views of an object that hides parts of itself have gaps of this size.
_MANY = 8
_FINER = 4
_CLOUD_POINTS = 20_000  # largest number of points by which a plane is judged
_MIN_PIXELS = 100  # least number of pixels of a mask, and of points of a plane
# The bounding box of the object in known depth grows by these shares of its sides, half of it on
# each side. Pixels of unknown depth inside the first box may be on the object. The second box shows
# the colours of the background.
_UNKNOWN_PADDING = 0.1
_CONTEXT_PADDING = 0.8
# A mask is flagged beyond the values below, which were chosen on renderings.
_BORDERS = 2  # a mask that touches so many borders of the image is doubtful
_MOST = 0.5  # largest share of the image, or of its border, that a mask covers
_PARTS = 0.25  # largest share of a mask outside its largest region
_COLOUR_IOU = 0.5  # least overlap with the mask that GrabCut finds in the padded bounding box
_LEAST_SIGNS = 0.5  # masks are flagged from this number of signs per frame on
_LYING = 0.5  # largest share of the object's points that lies in the plane around it
# A part of the mask is a table if these shares of the points lie in one plane and above it.
_CARRYING = 0.4
_CARRIED = 0.05

PLAUSIBLE = (0.05, 20.0)  # least and largest distance of an object, metres
_LEAST_KNOWN = 0.4  # least share of the object's pixels that have depth
# Depth that deviates less, relative to the distance, is constant, as where it is filled in.
_FLAT = 0.005
DOUBTFUL = "the masks may be wrong"

# Unit normal, which points to the side of the cameras, and offset: normal @ x = offset.
Plane = tuple[Float[np.ndarray, "3"], float]


def masks_from_box(frames: Iterable[Frame], box: Box) -> Iterator[Frame]:
    """Segment the object in frames, given its box (top, left, height, width) in the first one.

    OpenCV's GrabCut (Rother, Kolmogorov and Blake 2004) separates the colours inside and outside of
    a box. The box in a later frame is the projection of the object points of the frames before it,
    and of a ball as wide as the first box. The ball stands for what is not visible in the first
    frame. The mask of a later frame that does not show the object is empty. Each frame is read when
    its mask is asked for. InputError if there is no object in the box.
    """
    frames = iter(frames)
    first = next(frames)
    height, width = first.camera.size
    top, left, box_height, box_width = box
    inside = min(top, left) >= 0 and top + box_height <= height and left + box_width <= width
    if not inside or min(box_height, box_width) < _SMALLEST_BOX:
        raise InputError(
            f"box (top, left, height, width) is {tuple(box)}, expected one inside {(height, width)}"
        )

    first = replace(first, mask=grab_cut(first.rgb, box))
    points = _inner_points(first)
    if not len(points):
        raise InputError(
            f"frame {first.name}: no object with known depth in the box {tuple(box)}, "
            "expected another"
        )

    # Points of a ball behind the visible surface, as wide as the box.
    depth = float(np.median(first.depth[object_pixels(first)]))
    radius = depth * (np.array([box_width, box_height]) / first.camera.focal_length).max() / 2
    middle = np.array([left + box_width / 2, top + box_height / 2])
    directions = np.random.default_rng(0).normal(size=(_POINTS // 4, 3))
    ball = radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    ball += first.camera.unproject(middle, depth + _BALL_OFFSET * radius)
    return chain([first], _masks_from_points(frames, points, ball))


def _masks_from_points(
    frames: Iterator[Frame], points: Float[np.ndarray, "n 3"], ball: Float[np.ndarray, "m 3"]
) -> Iterator[Frame]:
    """Segment the object in frames, given world points on it and on the ball."""
    for frame in frames:
        box = _project_box(frame, np.concatenate([points, ball]))
        mask = np.zeros(frame.camera.size, np.float32)
        if min(box[2:]) >= _SMALLEST_BOX and not frame_defect(replace(frame, mask=None)):
            mask = grab_cut(frame.rgb, box)
        masked = replace(frame, mask=mask)
        # Of all points known so far, at most `_POINTS` evenly spaced ones are kept.
        points = np.concatenate([points, _inner_points(masked)])
        points = points[np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(int)]
        yield masked


def grab_cut(rgb: UInt8[np.ndarray, "h w 3"], box: Box) -> Float[np.ndarray, "h w"]:
    """Return the mask of the largest region in a box whose colours differ from those around it."""
    top, left, height, width = box
    inside = np.zeros(rgb.shape[:2], bool)
    inside[top : top + height, left : left + width] = True
    return largest_region(separate_colours(rgb, inside)).astype(np.float32)


def separate_colours(
    rgb: UInt8[np.ndarray, "h w 3"],
    possible: Bool[np.ndarray, "h w"],
    certain: Bool[np.ndarray, "h w"] | bool = False,
    longest: int = 320,
    iterations: int = 4,
) -> Bool[np.ndarray, "h w"]:
    """Select the foreground by GrabCut: the `certain` pixels, and some of the `possible` ones.

    It works on a copy whose longer side has at most `longest` pixels: its time is proportional to
    the area and to the number of iterations.
    """
    height, width = possible.shape
    labels = np.where(possible, cv2.GC_PR_FGD, cv2.GC_BGD)
    labels = np.where(certain, cv2.GC_FGD, labels).astype(np.uint8)
    shrink = max(1, max(height, width) / longest)
    size = max(1, round(width / shrink)), max(1, round(height / shrink))
    bgr = cv2.resize(rgb[..., ::-1], size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT)
    foreground = cv2.GC_FGD, cv2.GC_PR_FGD
    if 0 < np.isin(small, foreground).mean() < 1:  # GrabCut needs pixels of both kinds
        cv2.setRNGSeed(0)  # GrabCut initialises its clusters at random
        # GrabCut keeps five Gaussians of 13 numbers each, for background and foreground.
        models = np.zeros((2, 1, 65))
        cv2.grabCut(bgr, small, None, *models, iterations, cv2.GC_INIT_WITH_MASK)
    selected = np.isin(small, foreground).astype(np.float32)
    return cv2.resize(selected, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5


def _inner_points(frame: Frame) -> Float[np.ndarray, "n 3"]:
    """Return world points inside the mask, without its border."""
    # At the border, depth may be that of the background.
    inner = replace(frame, mask=cv2.erode(frame.mask, WINDOW_5))
    return world_points(inner, object_pixels(inner))


def _project_box(frame: Frame, points: Float[np.ndarray, "n 3"]) -> Box:
    """Compute the padded bounding box of projected world points, of size 0 if none is in front."""
    height, width = frame.camera.size
    pixels, depth = frame.camera.project(points)
    pixels = pixels[depth > 0]
    if not len(pixels):
        return 0, 0, 0, 0
    # Single points may be off the object.
    low, high = np.percentile(pixels, [1, 99], axis=0)
    margin = _PADDING / 2 * (high - low).max()
    left, top = np.floor(low - margin).clip(0, (width - 1, height - 1)).astype(int)
    right, bottom = np.ceil(high + margin).clip(1, (width, height)).astype(int)
    return int(top), int(left), int(bottom - top), int(right - left)


def masks_from_depth(frames: Sequence[Frame]) -> list[Frame]:
    """Segment the object in frames of one world, where the cameras look.

    InputError if nothing stands there, or if two objects of like size do.
    """
    if not any((frame.depth > 0).any() for frame in frames):
        raise InputError(
            f"no depth is known in any of {len(frames)} frames, expected some to find the object"
        )

    # Select the pixels of known depth near the focus in each frame; gather some of their points.
    focus, distance = _focus(frames)
    selections = []
    cloud = []
    for frame in frames:
        selected = frame.depth > 0
        selected[selected] = _within(world_points(frame, selected), focus, distance)
        selections.append(selected)
        cloud.append(world_points(frame, selected, sampling_step(frame, len(frames))))

    # Keep the pixels above the plane that the object stands on.
    centres = [frame.camera.centre for frame in frames]
    plane = _supporting_plane(centres, np.concatenate(cloud), distance)
    if plane is not None:
        normal, offset = plane
        for frame, selected in zip(frames, selections):
            height = world_points(frame, selected) @ normal - offset
            selected[selected] = height > _CLEARANCE * distance

    # Keep the pixels that are connected where the cameras look.
    parts = _part_at(focus, frames, selections, _VOXEL * distance)
    if len(frames) >= _MANY:
        # This raises InputError if the part is two objects close together.
        _part_at(focus, frames, parts, _VOXEL / _FINER * distance)
    masked = [replace(frame, mask=_with_unknown(frame, part)) for frame, part in zip(frames, parts)]
    if not any(frame.mask.sum() >= _MIN_PIXELS for frame in masked):
        raise InputError(
            f"{frames[0].name or 'frame'}: nothing stands out from a plane where the camera "
            "looks, expected --box TOP,LEFT,HEIGHT,WIDTH around the object"
        )
    return masked


def mask_flags(frames: Collection[Frame]) -> tuple[str, ...]:
    """Say in one line why the masks of frames of one world are doubtful; () if they are not.

    Frames with a defect do not count.
    """
    usable = [frame for frame in frames if not frame_defect(frame)]
    plane, distance = _plane_around(usable)
    counts = Counter(sign for frame in usable for sign in _signs(frame, plane, distance))
    if counts.total() < _LEAST_SIGNS * len(usable):
        return ()
    signs = [f"{sign} ({count} of {len(usable)} frames)" for sign, count in counts.items()]
    # A missing plane alone is no sign: objects may fill the image, or stand on a dark turntable.
    if signs and plane is None:
        signs.append("no plane is found that the object stands on")
    return (Doubt(f"{DOUBTFUL}: {', '.join(signs)}"),) if signs else ()


def depth_flags(frames: Iterable[Frame], metric: bool) -> Iterator[str]:
    """Say that the object's distance, if `metric`, or its depth's extent is doubtful."""
    distances = []
    # Numbers of pixels on the object: all, and those of known depth.
    seen = 0
    known = 0
    flat = 0  # number of frames in which the object's depth is constant
    for frame in frames:
        pixels = object_pixels(frame)
        depth = frame.depth[pixels]
        seen += (frame.mask > ON_OBJECT).sum()
        known += len(depth)
        distances.append(np.quantile(depth, 0.25) if len(depth) else np.nan)
        flat += len(depth) > _MIN_PIXELS and np.std(depth) < _FLAT * distances[-1]
    # An unknown distance is not flagged.
    distance = float(np.nanmedian(distances)) if known else PLAUSIBLE[0]
    if metric and not PLAUSIBLE[0] <= distance <= PLAUSIBLE[1]:
        yield (
            f"the object is {distance:.3g} m from the camera, expected {PLAUSIBLE[0]:g} to "
            f"{PLAUSIBLE[1]:g} m; the unit of its depth is given by --depth-unit or depth_unit "
            "(0.001: millimetres, 1: metres); disparity is no depth"
        )
    if known < _LEAST_KNOWN * seen:
        yield Doubt(f"depth is known on {known / seen:.0%} of the object only")
    if flat > len(distances) / 2:
        yield Contradiction(f"the object's depth is constant in {flat} of {len(distances)} frames")


def given_mask_flags(frames: Collection[Frame], missing: Collection[str]) -> Iterator[str]:
    """Name the frames without a given mask, and say how many masks cover most of the border."""
    if missing:
        yield f"no mask is given for {', '.join(missing)}: found by depth"
    count = 0
    for frame in frames:
        mask = frame.mask > ON_OBJECT
        border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
        count += border.mean() > _MOST
    if count:
        yield Doubt(
            f"{DOUBTFUL}: those of {count} of {len(frames)} frames cover most of the border: "
            "inverted?"
        )


def _plane_around(frames: Collection[Frame]) -> tuple[Plane | None, float]:
    """Fit the plane that an object stands on, outside its masks.

    Also returns the mean distance of the cameras from the object.
    """
    on_object = []
    around = []
    centres = []
    for frame in frames:
        known = frame.depth > 0
        mask = frame.mask > ON_OBJECT
        widened = cv2.dilate(mask.astype(np.uint8), WINDOW_5) > 0
        step = sampling_step(frame, len(frames))
        on_object.append(world_points(frame, known & mask, step))
        around.append(world_points(frame, known & ~widened, step))
        centres.append(frame.camera.centre)
    if not centres:
        return None, 0.0
    centre = np.median(np.concatenate(on_object), axis=0)
    distance = float(np.linalg.norm(centres - centre, axis=1).mean())
    cloud = np.concatenate(around)
    cloud = cloud[_within(cloud, centre, distance)]
    return _supporting_plane(centres, cloud, distance), distance


def _within(
    points: Float[np.ndarray, "n 3"], focus: Float[np.ndarray, "3"], distance: float
) -> Bool[np.ndarray, " n"]:
    """Select the points that may be part of the object: near the focus, for cameras this far."""
    return np.linalg.norm(points - focus, axis=1) < _REACH * distance


def _supporting_plane(
    centres: Sequence[Float[np.ndarray, "3"]], cloud: Float[np.ndarray, "n 3"], distance: float
) -> Plane | None:
    """Fit the plane that an object stands on to the points around it; None if there is none."""
    # The step is rounded up.
    cloud = cloud[:: max(1, -(-len(cloud) // _CLOUD_POINTS))]
    tolerance = _PLANE_DISTANCE * distance
    rest = cloud
    for _ in range(_PLANES):
        if len(rest) < _MIN_PIXELS:
            break
        normal, offset = fit_plane(rest, tolerance)
        # The normal points to the side of the cameras.
        if np.median(np.stack(centres) @ normal - offset) < 0:
            normal = -normal
            offset = -offset

        # The supporting plane is wide, has many points, and nearly none below.
        height = cloud @ normal - offset
        on = np.abs(height) < tolerance
        below = (height < -_OFF_PLANE * tolerance).mean()
        spread = standard_deviation(cloud[on]) if on.any() else 0.0
        other_spread = 0.0 if on.all() else standard_deviation(cloud[~on])
        if (
            spread >= _MIN_SPREAD * other_spread
            and on.mean() >= _MIN_ON_PLANE
            and below <= _MAX_BELOW
        ):
            return normal, offset
        rest = rest[np.abs(rest @ normal - offset) >= tolerance]
    return None


def _focus(frames: Sequence[Frame]) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the point nearest to the cameras' optical axes, and their mean distance from it."""
    centres = np.stack([frame.camera.centre for frame in frames])
    matrix, right_side = axes_equation([frame.camera for frame in frames])
    mean_matrix = matrix / len(frames)
    # Parallel axes have no nearest point. Above this eigenvalue, they differ by several degrees.
    if np.linalg.eigvalsh(mean_matrix)[0] > 0.01:
        focus = np.linalg.solve(mean_matrix, right_side / len(frames))
        if all(frame.camera.to_camera(focus)[2] > 0 for frame in frames):
            return focus, float(np.linalg.norm(focus - centres, axis=1).mean())
    # With one camera or parallel axes, the focus is the median of the nearest quarter of the points
    # in the central third of an image, along each side.
    first = next(k for k, frame in enumerate(frames) if (frame.depth > 0).any())
    known = frames[first].depth > 0
    height, width = known.shape
    middle = np.zeros_like(known)
    middle[height // 3 : height - height // 3, width // 3 : width - width // 3] = True
    chosen = known & middle if (known & middle).any() else known
    points = world_points(frames[first], chosen)
    depth = frames[first].depth[chosen]
    focus = np.median(points[depth <= np.quantile(depth, 0.25)], axis=0)
    return focus, float(np.linalg.norm(focus - centres[first]))


def axes_equation(
    cameras: Sequence[Camera],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return A and b of the equation A x = b of the point x nearest to the optical axes."""
    centres = np.stack([camera.centre for camera in cameras])
    axes = np.stack([camera.R[2] for camera in cameras])
    # The matrices P, (n, 3, 3), project across the axes. For the point x nearest to the axes, the
    # sum of P (x - c) over the camera centres c is 0.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    return across.sum(axis=0), np.einsum("nij,nj->i", across, centres)


def _part_at(
    focus: Float[np.ndarray, "3"],
    frames: Sequence[Frame],
    pixels: Sequence[np.ndarray],
    voxel: float,
) -> list[Bool[np.ndarray, "_ _"]]:
    """Keep the pixels in the connected part with the most points.

    Points far from the focus count less. InputError if there is a second part of like size.
    """
    # The box of all points. Clouds are large: they are computed twice, not kept in memory.
    corners = []
    for frame, selected in zip(frames, pixels):
        points = world_points(frame, selected)
        if len(points):
            corners += [points.min(axis=0), points.max(axis=0)]
    if not corners:
        return list(pixels)
    low = np.min(corners, axis=0)
    high = np.max(corners, axis=0)

    # The weight of each voxel, which is the sum over its points, and the voxel of each pixel.
    shape = np.floor((high - low) / voxel).astype(int) + 1
    weight = np.zeros(shape.prod())
    cells = []
    for frame, selected in zip(frames, pixels):
        points = world_points(frame, selected)
        indices = np.floor((points - low) / voxel).astype(int)
        # The voxel of each pixel, as an index of the flattened grid.
        cells.append(np.ravel_multi_index(indices.T, shape).astype(np.int32))
        # The weight of a point falls to 1 / e at a distance of 8 voxels from the focus.
        weights = np.exp(-np.square(np.linalg.norm(points - focus, axis=1) / (8 * voxel)))
        weight += np.bincount(cells[-1], weights, len(weight))

    # Label the connected parts of voxels. The part with the most weight is the object.
    part = ndimage.label(weight.reshape(shape) > 0, np.ones((3, 3, 3)))[0].ravel()
    sizes = np.bincount(part, weight)
    first = sizes.argmax()
    large = np.flatnonzero(sizes > _COMPARABLE * sizes[first])
    # Only a part of like extent may be the object, too: a far larger part is a table or a wall.
    extents = np.array(
        [np.argwhere((part == number).reshape(shape)).std(axis=0).mean() for number in large]
    )
    likeness = extents / extents[large == first]
    if ((likeness > _ALIKE) & (likeness < 1 / _ALIKE)).sum() > 1:
        raise InputError(
            f"{frames[0].name or 'frame'}: two objects of like size stand where the camera "
            "looks, expected --box TOP,LEFT,HEIGHT,WIDTH around one of them"
        )

    # Keep the selected pixels whose voxel is in that part.
    chosen = part == first
    masks = [selected.copy() for selected in pixels]
    for mask, cell in zip(masks, cells):
        mask[mask] = chosen[cell]
    return masks


def _with_unknown(frame: Frame, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Remove single pixels of a mask, and add pixels of unknown depth that have its colours."""
    mask = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, WINDOW_3)
    if mask.any():
        mask |= _colours_around(frame, mask > 0, certain=True) & (frame.depth == 0)
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, WINDOW_3).astype(np.float32)


def _colours_around(
    frame: Frame, mask: Bool[np.ndarray, "h w"], certain: bool
) -> Bool[np.ndarray, "h w"]:
    """Select the foreground in the box of a mask by GrabCut.

    A `certain` mask is foreground, and beside it only pixels of unknown depth can be. Otherwise,
    each pixel of the box can be foreground.
    """
    windows = []
    for padding in (_UNKNOWN_PADDING, _CONTEXT_PADDING):
        top, left, height, width = mask_to_bbox(mask.astype(np.uint8), padding=padding)
        windows.append(np.s_[top : top + height, left : left + width])
    inner, context = windows
    possible = np.zeros_like(mask)
    possible[inner] = frame.depth[inner] == 0 if certain else True
    separated = np.zeros_like(mask)
    # Coarser, and with fewer iterations, than from a box alone: depth tells most of it.
    separated[context] = separate_colours(
        frame.rgb[context], possible[context], mask[context] & certain, longest=160, iterations=2
    )
    return separated


def _signs(frame: Frame, plane: Plane | None, distance: float) -> Iterator[str]:
    """Yield the signs that the mask of a frame is wrong."""
    mask = frame.mask > ON_OBJECT
    width = max(mask.shape) // 100 + 1  # width of the border: 1 % of the image, pixels
    borders = (mask[:width], mask[-width:], mask[:, :width], mask[:, -width:])
    if sum(border.any() for border in borders) >= _BORDERS:
        yield "several borders of the image are touched"
    if mask.mean() > _MOST:
        yield "most of the image is covered"
    if largest_region(mask).sum() < (1 - _PARTS) * mask.sum():
        yield "several separate parts"
    by_colours = largest_region(_colours_around(frame, mask, certain=False))
    if (by_colours & mask).sum() / (by_colours | mask).sum() < _COLOUR_IOU:
        yield "colours disagree"
    points = world_points(frame, mask & (frame.depth > 0))
    if plane is not None:
        height = points @ plane[0] - plane[1]
        if (height < _PLANE_DISTANCE * distance).sum() > _LYING * len(height):
            yield "much of it lies in the plane around it"
    own_plane = _supporting_plane([frame.camera.centre], points, distance)
    if own_plane is not None:
        # Heights in units of the tolerance of a plane.
        height = (points @ own_plane[0] - own_plane[1]) / (_PLANE_DISTANCE * distance)
        if (np.abs(height) < 1).mean() > _CARRYING and (height > _OFF_PLANE).mean() > _CARRIED:
            yield "part of it is a surface that the rest stands on"
