r"""Points marked on one object, found on all other objects of an aligned category.

A point goes to the common frame of the category. There its place on another object is the nearest
point of that object's surface, after a local and smooth correction by features:

1. A patch p of a source view, at the point x_p, is compared with the patches q of three views of
   the target object from similar sides. With c_pq the cosine of their log-binned descriptors and
   d_pq the distance of their points in sizes of the target object, its displacement is the mean of
   x_q - x_p over the patches in a ball around x_p, weighted by exp(c_pq / 0.05 - d_pq^2 / (2 *
   0.05^2)).
2. The correction of a marked point is the mean displacement of the source patches around it,
   weighted by a Gaussian of their distance, and by how similar the most similar patch is.

The confidence is a logistic function of that similarity, and of the distance of the marked point to
the surface before the correction. A part that the other object does not have is far from its
surface or looks unlike it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.special import expit, softmax

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.named import BackboneLike, as_backbone
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.evaluation import spread
from zsp_lite.data.frames import Frame, frame_defect
from zsp_lite.errors import InputError, check_magnitude, real_array
from zsp_lite.features import bin_indices, descriptors
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import near_median, object_pixels
from zsp_lite.scans.category import CategoryAlignment
from zsp_lite.views import View

# All but the coefficients of the confidence is chosen, not fitted.
VIEWS = 12  # frames of an object whose patches are its surface
_TARGET_VIEWS = 3  # views of the target that a source view is compared with
# Lengths in sizes of the target object.
_BALL = 0.15  # radius in which corresponding patches are sought
_PRIOR = 0.05  # standard deviation of the distance of corresponding patches
_SMOOTHING = 0.06  # standard deviation of the Gaussian around a marked point
_TEMPERATURE = 0.05  # of cosines, for the patches of the target
_SOURCE_TEMPERATURE = 0.1  # of cosines, for the patches around a marked point
# Coefficients of the confidence: constant, cosine, and distance to the surface in sizes of the
# object. Fitted on validation categories (docs/rebuild.md).
_CONFIDENCE = (-10.4, 18.4, -22.7)
FOUND = 0.5  # least confidence of a point that is found


@dataclass(frozen=True, eq=False)
class TransferredPoints:
    """The places of marked points on another object."""

    world: Float[np.ndarray, "n 3"]  # points of the object's surface, in its world
    # of the patches around each marked point, weighted mean of the highest cosine with a patch of
    # this object; 0 or less where no patch is near
    cosine: Float[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]  # of the marked point to the surface, in sizes of the object

    @property
    def confidence(self) -> Float[np.ndarray, " n"]:
        """Probability that a place is within a tenth of the object's size of the right one, if the
        pose is right; 0 for a marked point too far from the surface."""
        constant, cosine, distance = _CONFIDENCE
        logit = constant + cosine * self.cosine + distance * self.distance
        return np.where(self.distance < _BALL, expit(logit), 0.0)


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """The part of an object's surface that one frame shows: its patches with measured depth."""

    name: str  # of the frame
    sim3: Sim3  # from the object's world to the common frame
    direction: Float[np.ndarray, "3"]  # from the object to the camera, in the common frame
    points: Float[np.ndarray, "n 3"]  # of the patches, in the common frame
    descriptors: Float[torch.Tensor, "n d"]  # of length 1


def surface_views(
    alignment: CategoryAlignment,
    dataset: Co3D,
    category: str,
    sequence: str,
    backbone: BackboneLike = "zsp-tiny",
) -> list[SurfaceView]:
    """Describe the surface of an object of an aligned category for `transfer`.

    It is seen in evenly spaced frames with a camera, without those with a `frame_defect`.

    Args:
        alignment: Poses of the objects in the common frame.
        dataset: Data set.
        category: Name of the category.
        sequence: Name of the object's sequence.
        backbone: Backbone, or what `load_backbone` takes.

    Raises:
        InputError: No frame shows the object's surface.
    """
    frames = spread_frames(dataset, category, sequence)
    usable = [frame for frame in frames if not frame_defect(frame)]
    unmasked = any(frame.mask is None for frame in usable)
    method = ZeroShotPose(as_backbone(backbone), foreground="saliency" if unmasked else "mask")
    surface = describe_surface(method.views(usable), alignment.objects[sequence].sim3)
    if not surface:
        raise InputError(
            f"sequence {category}/{sequence}: none of {len(frames)} frames shows the object with "
            "depth"
        )
    return surface


def spread_frames(dataset: Co3D, category: str, sequence: str) -> list[Frame]:
    """Load evenly spaced frames of an object with a camera."""
    annotations = [
        frame for frame in dataset.frames(category, sequence) if frame.viewpoint is not None
    ]
    return [dataset.load(annotations[k]) for k in spread(VIEWS, len(annotations))]


def describe_surface(views: Iterable[View], sim3: Sim3) -> list[SurfaceView]:
    """Gather the patches of views of one world, given its similarity to the common frame."""
    surface = []
    for view in views:
        patches = np.flatnonzero(view.known_foreground)
        if not len(patches):
            continue
        camera = view.frame.camera
        points = sim3.apply(camera.to_world(view.measured_points[0].reshape(-1, 3)[patches]))
        near = near_median(points)
        towards = sim3.apply(camera.centre) - np.median(points, axis=0)
        index = bin_indices(view.features.grid)[:, patches[near]]
        (built,) = descriptors(view.features.keys[None], index)
        surface.append(
            SurfaceView(
                view.frame.name,
                sim3,
                towards / np.linalg.norm(towards),
                points[near],
                F.normalize(built, dim=1),
            )
        )
    return surface


def marked_point(frame: Frame, x: float, y: float, what: str) -> Float[np.ndarray, "3"]:
    """Return the world point at a pixel of a frame; InputError, which begins with `what`, if it is
    outside, has no depth, or is not on the object."""
    height, width = frame.camera.size
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(f"{what} is outside the image, expected one of {width} x {height}")
    row, column = int(y), int(x)
    if frame.depth is None or not frame.depth[row, column] > 0:
        raise InputError(f"{what} has no depth, expected a pixel with measured depth")
    if frame.mask is not None and not object_pixels(frame)[row, column]:
        raise InputError(f"{what} is not on the object, expected a pixel of its mask")
    return frame.camera.unproject(np.array([x, y]), frame.depth[row, column])


def object_size(views: Sequence[SurfaceView]) -> float:
    """Return the diameter of an object in the common frame, as `clouds.extent` defines it."""
    points = np.concatenate([view.points for view in views])
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    return float(np.linalg.norm(high - low))


def transfer(
    points: Float[np.ndarray, "n 3"], source: Sequence[SurfaceView], target: Sequence[SurfaceView]
) -> TransferredPoints:
    """Find the places of marked points on another object (see the module's docstring).

    Args:
        points: Marked points, in the world of the source object.
        source: `surface_views` of the object that the points are marked on.
        target: `surface_views` of the other object.

    Raises:
        InputError: The points are not of shape (n, 3), or not finite.
    """
    marked = real_array("points", points, (None, 3))
    check_magnitude("points", marked)
    marks = source[0].sim3.apply(marked)
    size = object_size(target)
    surface = KDTree(np.concatenate([view.points for view in target]))
    distance, _ = surface.query(marks)

    # All source patches (p, 3), with their displacements (p, 3) and highest cosines (p).
    start = np.concatenate([view.points for view in source])
    compared = zip(*(_compare(view, target, size) for view in source))
    displacement, cosine = map(np.concatenate, compared)

    # Their mean around each mark.
    squared = cdist(marks, start, "sqeuclidean") / size**2  # (marks, patches)
    logits = cosine / _SOURCE_TEMPERATURE - squared / (2 * _SMOOTHING**2)
    weights = _softmax_within(squared, logits)
    _, nearest = surface.query(marks + weights @ displacement)
    places = target[0].sim3.inverse().apply(surface.data[nearest])
    return TransferredPoints(places, weights @ cosine, distance / size)


def _compare(
    view: SurfaceView, target: Sequence[SurfaceView], size: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Compute the displacement of each patch of a source view, and its highest cosine.

    They are 0 and -1 without a patch of the target in the ball.
    """
    similar = sorted(target, key=lambda other: other.direction @ view.direction)[-_TARGET_VIEWS:]
    points = np.concatenate([other.points for other in similar])
    other_descriptors = torch.cat([other.descriptors for other in similar])
    cosines = (view.descriptors @ other_descriptors.T).double().numpy()
    squared = cdist(view.points, points, "sqeuclidean") / size**2
    weights = _softmax_within(squared, cosines / _TEMPERATURE - squared / (2 * _PRIOR**2))
    displacement = weights @ points - weights.sum(axis=1, keepdims=True) * view.points
    return displacement, np.where(squared < _BALL**2, cosines, -1).max(axis=1)


def _softmax_within(
    squared: Float[np.ndarray, "n m"], logits: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n m"]:
    """Return the softmax of each row over the patches in the ball; 0 for a row without one."""
    inside = squared < _BALL**2
    # Not -inf, of which the softmax of a row without a patch would be NaN.
    return inside * softmax(np.where(inside, logits, -1e9), axis=1)
