"""Directions in which cameras stand around an object."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera

# A camera stands above or below a point if the sine of its angle to the vertical is at most this,
# which is that of 24 degrees.
_STEEP = 0.4


def ground_axes(cameras: Sequence[Camera]) -> Float[np.ndarray, "2 3"]:
    """Return the world's axes to the right and up in a drawing of the scene from above."""
    # Images may be turned by 90 degrees: the vertical is the image axis, y or x, on which the
    # cameras agree better, which is the one with the longer mean. If both are equal after rounding,
    # it is y.
    axes = np.mean([camera.R[[1, 0]] for camera in cameras], axis=0)
    down = axes[np.linalg.norm(axes, axis=1).round(6).argmax()]
    # The second and the third right singular vector of (1, 3) are normal to the vertical.
    right, up = np.linalg.svd(down[None])[2][1:]
    return np.stack([right, up if np.cross(right, up) @ down < 0 else -up])


def azimuths(cameras: Sequence[Camera], centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, " n"]:
    """Return the directions in degrees of cameras around a point; NaN for those above or below."""
    directions = np.stack([camera.centre for camera in cameras]) - centre
    x, y = ground_axes(cameras) @ directions.T
    steep = np.hypot(x, y) <= _STEEP * np.linalg.norm(directions, axis=1)
    return np.where(steep, np.nan, np.degrees(np.arctan2(y, x)))


def view_span(cameras: Sequence[Camera], centre: Float[np.ndarray, "3"]) -> float:
    """Return the angle in degrees that cameras span around a point: 360 minus the largest gap."""
    angles = azimuths(cameras, centre)
    angles = np.sort(angles[~np.isnan(angles)])
    if len(angles) > 1:
        gaps = np.diff(angles, append=angles[0] + 360)
    else:
        # At most one camera has a direction: the span is the largest angle between two cameras.
        directions = np.stack([camera.centre for camera in cameras]) - centre
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        span = np.degrees(np.arccos((directions @ directions.T).clip(-1, 1).min()))
        gaps = np.array([span, 360 - span])
    return float(360 - gaps.max())
