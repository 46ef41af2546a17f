"""Points of the object: the pixels on it, their 3D points, outliers and standard deviation."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import ON_OBJECT, Frame, frame_defect

# Points farther from their median than this multiple of the median distance are outliers; chosen.
_FAR = 4.0
_SAMPLE = 1 << 21  # points of many frames that are in memory at once: 50 MB


def object_pixels(frame: Frame) -> Bool[np.ndarray, "height width"]:
    """Select the pixels on the object that have known depth; a frame without a mask is all
    object."""
    known = frame.depth > 0
    return known if frame.mask is None else known & (frame.mask > ON_OBJECT)


def object_points(frame: Frame) -> Float[np.ndarray, "n 3"]:
    """Unproject the pixels of `object_pixels` to camera-frame points; N may be 0."""
    return unproject_depth(frame.depth, frame.camera)[object_pixels(frame)]


def world_points(
    frame: Frame, pixels: Bool[np.ndarray, "height width"], step: int = 1
) -> Float[np.ndarray, "n 3"]:
    """Unproject every `step`-th of some pixels of known depth, row by row, to world points."""
    rows, columns = np.divmod(np.flatnonzero(pixels)[::step], pixels.shape[1])
    return frame.camera.unproject(
        np.stack([columns, rows], axis=-1) + 0.5, frame.depth[rows, columns]
    )


def sampling_step(frame: Frame, count: int) -> int:
    """Return the step by which the `world_points` of `count` frames of this size fit into memory
    together."""
    return max(1, count * frame.depth.size // _SAMPLE)


def near_median(points: Float[np.ndarray, "n 3"], factor: float = _FAR) -> Bool[np.ndarray, " n"]:
    """Select the points that are at most `factor` times the median distance from the median point.

    A mask that is too wide by a pixel includes points of the background, far behind the object.
    """
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return distance <= factor * np.median(distance)


def standard_deviation(points: Float[np.ndarray, "n 3"]) -> float:
    """Compute the standard deviation of points: the root of the mean variance of the three axes."""
    return float(np.sqrt(np.square(points - points.mean(axis=0)).sum(axis=1).mean() / 3))


def axis_deviation(points: Float[np.ndarray, "n 3"]) -> float:
    """Compute the mean of the standard deviations of the three axes; it is 1 in scenes of CO3D
    (supplement)."""
    return float(points.std(axis=0).mean())


def world_cloud(
    frames: Sequence[Frame],
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Gather the world points and colours of the object in the usable frames, without each frame's
    outliers."""
    clouds = [np.zeros((0, 3))]
    colours = [np.zeros((0, 3), np.uint8)]
    for frame in frames:
        if frame_defect(frame):
            continue
        inside = object_pixels(frame)
        if inside.any():
            points = world_points(frame, inside)
            near = near_median(points)
            clouds.append(points[near])
            colours.append(frame.rgb[inside][near])
    return np.concatenate(clouds), np.concatenate(colours)
