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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.special import expit, softmax

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import BackboneLike, as_backbone
from zsp_lite.category import CategoryAlignment
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import frame_defect
from zsp_lite.errors import InputError, check_choice, real_array
from zsp_lite.features import log_bin
from zsp_lite.points import near_median
from zsp_lite.views import IMAGE_SIZE, View, extract_views, object_crop

VIEWS = 12  # frames of an object whose patches are its surface
_TARGET_VIEWS = 3  # views of the target that a source view is compared with
_SIMILAR_SIDE = 0.5  # least cosine of the directions of two views that are compared
# Lengths in sizes of the target object.
_BALL = 0.15  # radius in which corresponding patches are sought
_PRIOR = 0.05  # standard deviation of the distance of corresponding patches
_SMOOTHING = 0.06  # standard deviation of the Gaussian around a marked point
_TEMPERATURE = 0.05  # of cosines, for the patches of the target
_SOURCE_TEMPERATURE = 0.1  # of cosines, for the patches around a marked point
_OUTLIER = 4.0  # multiple of the median distance from the median point, as in `points`
# Coefficients of the confidence: constant, cosine, and distance to the surface in sizes of the
# object. Fitted by tools/marks.py on validation categories.
CONFIDENCE = (-9.4, 18.7, -64.0)
FOUND = 0.5  # least confidence of a point that is found


@dataclass(frozen=True, eq=False)
class TransferredPoints:
    """The places of marked points on another object."""

    world: Float[np.ndarray, "n 3"]  # points of the object's surface, in its world
    # of the patches around each marked point, weighted mean of the highest cosine with a patch of
    # this object; 0 where no patch is compared
    cosine: Float[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]  # of the marked point to the surface, in sizes of the object

    @property
    def confidence(self) -> Float[np.ndarray, " n"]:
        """Probability that a place is within a tenth of the object's size of the right one."""
        constant, cosine, distance = CONFIDENCE
        logit = constant + cosine * self.cosine + distance * self.distance
        return np.where(self.distance < _BALL, expit(logit), 0.0)

    @property
    def found(self) -> Bool[np.ndarray, " n"]:
        """Points with a confidence of at least a half; the object has nothing like the others."""
        return self.confidence >= FOUND


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """The part of an object's surface that one frame shows: its patches with measured depth."""

    number: int  # of the frame
    view: View
    sim3: Sim3  # from the object's world to the common frame
    direction: Float[np.ndarray, "3"]  # from the object to the camera, in the common frame
    patches: Int[np.ndarray, " n"]  # indices in the view's grid, row by row
    points: Float[np.ndarray, "n 3"]  # in the common frame
    descriptors: Float[torch.Tensor, "n d"]  # of length 1


def surface_views(
    alignment: CategoryAlignment,
    dataset: Co3D,
    category: str,
    sequence: str,
    backbone: BackboneLike = "zsp-tiny",
    count: int = VIEWS,
) -> list[SurfaceView]:
    """Describe the surface of an object of an aligned category for `transfer`.

    Args:
        alignment: Poses of the objects in the common frame.
        dataset: Data set.
        category: Name of the category.
        sequence: Name of the object's sequence.
        backbone: Backbone, or what `load_backbone` takes.
        count: Number of frames, evenly spaced over the sequence. Frames with a `frame_defect` are
            left out.

    Raises:
        InputError: The alignment has no such object, or no frame shows its surface.
    """
    check_choice("sequence", sequence, alignment.objects)
    sim3 = alignment.objects[sequence].sim3
    annotations = dataset.frames(category, sequence)
    chosen = np.unique(np.arange(count) * len(annotations) // count)
    loaded = {annotations[k].frame_number: dataset.load(annotations[k]) for k in chosen}
    usable = {number: frame for number, frame in loaded.items() if not frame_defect(frame)}

    extractor = as_backbone(backbone)
    size = getattr(extractor, "image_size", IMAGE_SIZE)
    crops = [object_crop(frame, size) for frame in usable.values()]
    masked = all(crop.mask is not None for crop in crops)
    views = extract_views(extractor, crops, "mask" if masked else "saliency")
    surface = [
        _surface_view(number, view, sim3)
        for number, view in zip(usable, views, strict=True)
        if view.known_foreground.any()
    ]
    if not surface:
        raise InputError(
            f"sequence {category}/{sequence}: none of {len(loaded)} frames shows the object with "
            "depth"
        )
    return surface


def _surface_view(number: int, view: View, sim3: Sim3) -> SurfaceView:
    """Gather the patches of a view."""
    camera = view.frame.camera
    patches = np.flatnonzero(view.known_foreground)
    in_camera = view.measured_points[0].reshape(-1, 3)[patches]
    near = near_median(in_camera, _OUTLIER)
    patches = patches[near]
    points = sim3.apply(camera.to_world(in_camera[near]))
    towards = sim3.apply(camera.centre) - np.median(points, axis=0)
    binned = log_bin(view.features.keys[None]).flatten(0, 2)[patches]
    return SurfaceView(
        number,
        view,
        sim3,
        towards / np.linalg.norm(towards),
        patches,
        points,
        F.normalize(binned, dim=1),
    )


def object_size(views: Sequence[SurfaceView]) -> float:
    """Return the diameter of an object in the common frame, as `Co3D.extent` defines it."""
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
    if not np.isfinite(marked).all():
        raise InputError("points have values that are not finite, expected finite coordinates")
    marks = source[0].sim3.apply(marked)
    size = object_size(target)
    surface = KDTree(np.concatenate([view.points for view in target]))
    distance, _ = surface.query(marks)

    # The source patches around any of the marks, with their displacements and highest cosines.
    around = KDTree(marks)
    starts = [np.zeros((0, 3))]
    displacements = [np.zeros((0, 3))]
    cosines = [np.zeros(0)]
    for view in source:
        near = around.query(view.points, distance_upper_bound=_BALL * size)[0] < np.inf
        likeness = np.array([other.direction @ view.direction for other in target])
        similar = np.argsort(-likeness)[:_TARGET_VIEWS]
        compared = [target[k] for k in similar if likeness[k] > _SIMILAR_SIDE]
        if near.any() and compared:
            moved, cosine = _displacements(view, near, compared, size)
            known = np.isfinite(cosine)
            starts.append(view.points[near][known])
            displacements.append(moved[known])
            cosines.append(cosine[known])
    start = np.concatenate(starts)
    best = np.concatenate(cosines)

    # Their mean around each mark. Marks without a patch in the ball have neither correction nor
    # cosine.
    squared = np.square(marks[:, None] - start).sum(axis=2) / size**2  # (marks, patches)
    inside = squared < _BALL**2
    logits = best / _SOURCE_TEMPERATURE - squared / (2 * _SMOOTHING**2)
    weights = _masked_softmax(logits, inside)
    places = marks + weights @ np.concatenate(displacements)
    _, nearest = surface.query(places)
    world = target[0].sim3.inverse().apply(surface.data[nearest])
    return TransferredPoints(world, weights @ best, distance / size)


def _displacements(
    view: SurfaceView, near: Bool[np.ndarray, " n"], target: Sequence[SurfaceView], size: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, " m"]]:
    """Compute the displacement of patches of a source view, and the highest cosine of each.

    Patches without a patch of the target in their ball have the cosine minus infinity.
    """
    points = np.concatenate([other.points for other in target])
    descriptors = torch.cat([other.descriptors for other in target])
    cosines = (view.descriptors[near] @ descriptors.T).double().numpy()
    squared = np.square(view.points[near][:, None] - points).sum(axis=2) / size**2
    inside = squared < _BALL**2
    weights = _masked_softmax(cosines / _TEMPERATURE - squared / (2 * _PRIOR**2), inside)
    highest = np.where(inside, cosines, -np.inf).max(axis=1)
    return weights @ points - view.points[near], highest


def _masked_softmax(
    logits: Float[np.ndarray, "n m"], allowed: Bool[np.ndarray, "n m"]
) -> Float[np.ndarray, "n m"]:
    """Return the softmax of each row over the columns that are allowed; 0 for a row without one."""
    if not allowed.any():
        return np.zeros(allowed.shape)
    return allowed * softmax(np.where(allowed, logits, logits.min() - 1e3), axis=1)


def transfer_points(
    alignment: CategoryAlignment,
    dataset: Co3D,
    category: str,
    sequence: str,
    points: Float[np.ndarray, "n 3"],
    backbone: BackboneLike = "zsp-tiny",
) -> dict[str, TransferredPoints]:
    """Find points that are marked on one object on all other objects of an aligned category.

    Args:
        alignment: Poses of the objects in the common frame, of `align_category`.
        dataset: Data set.
        category: Name of the category.
        sequence: Name of the sequence that the points are marked in.
        points: Marked points of the object's surface, in the world of the sequence.
        backbone: Backbone, or what `load_backbone` takes.

    Returns:
        The places of the points by the name of the object.

    Raises:
        InputError: The alignment has no such sequence, the points are not of shape (n, 3) or not
            finite, or no frame of an object shows its surface.
    """
    extractor = as_backbone(backbone)
    source = surface_views(alignment, dataset, category, sequence, extractor)
    return {
        name: transfer(points, source, surface_views(alignment, dataset, category, name, extractor))
        for name in alignment.objects
        if name != sequence
    }
