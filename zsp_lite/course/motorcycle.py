"""A photograph of a motorcycle with measured depth, and the object mask that is derived from it."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32, UInt8

from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import Frame
from zsp_lite.importers.segments import fit_plane, largest_region
from zsp_lite.points import axis_deviation, object_points

# The synthetic object whose directions are known.
CATEGORY = "motorcycle"
TARGET = "scooter"
# Directions of the photographed motorcycle in camera coordinates. There is no measured ground
# truth. The front was judged by eye from the rear wheel, since the front wheel is turned, and may
# be wrong by 10 degrees. Up is the normal of the floor; the motorcycle leans on its side stand by a
# few degrees.
FRONT = np.array([0.97, 0.06, -0.24])
UP = np.array([0.01, -0.97, -0.26])

# Calibration at the size in scikit-image, from its documentation. The values in pixels are those of
# the original photograph divided by 4. They therefore count from the corner of the image, as
# `Camera` does, to within 1/8 pixel.
_FOCAL_LENGTH = 994.978  # pixels
_PRINCIPAL_POINT = (311.193, 254.877)  # pixels
_PRINCIPAL_DIFFERENCE = 31.086  # pixels between the principal points of both cameras, along x
_BASELINE = 0.193001  # metres between both cameras
_FLOOR_ROWS = slice(300, None)  # lower part of the photograph, which shows mostly floor
_FLOOR_DISTANCE = 0.01  # metres; largest distance of a floor point from the plane
_CLEARANCE = 0.02  # metres; smallest height of an object point above the floor
_FARTHEST = 2.75  # metres; the motorcycle is nearer, the bench and the shelf behind it are not


def load_photograph() -> Frame:
    """Load a photograph of a motorcycle with dense depth and an object mask.

    Photograph and disparities, measured with structured light, are scikit-image's
    `stereo_motorcycle`, of Middlebury's 2014 stereo data (Scharstein et al., GCPR 2014). The world
    is the camera's frame. Lengths are scaled as in CO3D, so that the points of the object have unit
    standard deviation; one unit is about 0.22 m.
    """
    import skimage.data  # only the photograph needs it

    rgb, _, disparity = skimage.data.stereo_motorcycle()  # second: the image of the right camera
    frame = motorcycle_frame(rgb, disparity)
    unit = np.float32(axis_deviation(object_points(frame)))  # metres
    return replace(frame, depth=frame.depth / unit)


def motorcycle_frame(
    rgb: UInt8[np.ndarray, "h w 3"], disparity: Float32[np.ndarray, "h w"]
) -> Frame:
    """Convert the left image and its disparities in pixels to a frame with depth in metres and an
    object mask."""
    known = np.isfinite(disparity)
    depth = _BASELINE * _FOCAL_LENGTH / (disparity + _PRINCIPAL_DIFFERENCE)
    depth = np.where(known, depth, np.float32(0))
    camera = Camera(
        np.eye(3), np.zeros(3), np.full(2, _FOCAL_LENGTH), np.array(_PRINCIPAL_POINT), depth.shape
    )
    points = unproject_depth(depth, camera)
    floor = points[_FLOOR_ROWS][known[_FLOOR_ROWS]]
    normal, offset = fit_plane(floor, _FLOOR_DISTANCE)
    # Above the floor, whichever way the normal points: +y is down.
    height = (points @ normal - offset) * -np.sign(normal[1])
    # This mask lacks thin parts, such as the brake cables and a mirror, and the lowest 2 cm of the
    # tyres.
    mask = largest_region(known & (depth < _FARTHEST) & (height > _CLEARANCE))
    return Frame(rgb, depth, mask.astype(np.float32), camera, "motorcycle photograph")
