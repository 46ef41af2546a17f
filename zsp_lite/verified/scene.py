"""The scene: the points, feature similarities and maps of all views, in two normalised frames.

Working units: the reference's points are centred at their mean and divided by their spread
(`points.standard_deviation`). The points of all target views together are normalised in the same
way, with the axes of the first target camera. A pose between the two frames then has a scale near 1
and a translation near 0, and all lengths in the solver are relative to the size of the object.

Maps have depth, mask, silhouette distance and patch of each pixel. A pixel of unknown depth gives
no information about surfaces: its weight is 0. It may still lie inside or outside the silhouette,
which comes from the mask.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zsp_lite.alignment import Sim3
from zsp_lite.data.azimuths import view_span
from zsp_lite.data.cameras import Camera
from zsp_lite.errors import NoPoseError
from zsp_lite.estimates import between_cameras
from zsp_lite.matching import Matches
from zsp_lite.points import near_median, standard_deviation
from zsp_lite.verified.poses import Poses, exp_, float_tensor, rotation_angles
from zsp_lite.views import View

# Points farther from the median point than this many median distances are outliers: patches at a
# silhouette may have the depth of the background.
_OUTLIER_DISTANCE = 3.0
# Width of the kernel by which points are weighted, working units: one to two patches; chosen.
_DENSITY_SIGMA = 0.25
_DENSITY_ROWS = 200  # number of points whose densities are computed together
_MIN_POINTS = 8  # fewer do not determine a shape to align; chosen
# Resolution of the maps. Finer maps do not change results with patches of 8 pixels, and exceed the
# processor's cache.
_MAP_PIXELS = 128 * 128
_NO_SILHOUETTE = 1e4  # distance in pixels where the mask is empty
# The silhouette of a soft mask is uncertain: distances are averaged over several thresholds.
_MASK_THRESHOLDS = (0.3, 0.5, 0.7)
_MIN_DEPTH = 1e-3  # working units; smaller depths are raised to it before the projection


@dataclass(frozen=True, eq=False)
class ViewMaps:
    """Cameras of v views in working units, and one table row for each of their pixels."""

    # world-to-camera: `x_cam = rotation @ x + translation`, x in the working frame
    rotation: Float[Tensor, "v 3 3"]
    translation: Float[Tensor, "v 3"]  # working units
    # in map pixels; the maps are resampled so that it is equal along both axes
    focal_length: Float[Tensor, " v"]
    principal_point: Float[Tensor, "v 2"]  # (x, y) in map pixels
    size: Float[Tensor, "v 2"]  # (width, height) in map pixels, whole numbers
    first_row: Int[Tensor, " v"]  # table row of each view's first pixel
    # row-major, view after view, each column contiguous: depth in working units; its weight (the
    # soft mask, 0 where the depth is unknown); distance to the silhouette in map pixels (0 inside);
    # row (of the reference's maps) or column (of the targets') of the patch in `Scene.similarity`
    # (-1: none)
    table: Float[Tensor, "pixels 4"]


@dataclass(frozen=True, eq=False)
class Scene:
    """A reference view and v target views of another object, prepared for scoring poses."""

    # foreground patches of known depth in the reference, working units
    reference_points: Float[Tensor, "n 3"]
    target_points: Float[Tensor, "m 3"]  # such patches of all target views together
    target_column: Int[Tensor, " m"]  # column of each target point in `similarity`
    # share of the surface that each target point represents; they sum to 1
    target_weight: Float[Tensor, " m"]
    # of each reference point to each foreground patch of all targets, double-centred
    similarity: Float[Tensor, "n columns"]
    reference_maps: ViewMaps  # of the reference alone
    target_maps: ViewMaps  # of the targets
    reference_to_working: Sim3  # from the reference's camera frame
    target_to_working: Sim3  # from the first target's camera frame
    target_cameras: tuple[Camera, ...]
    # for each target, the points of its matches: in the reference, and in the target
    matches: tuple[tuple[Float[Tensor, "_ 3"], Float[Tensor, "_ 3"]], ...]
    view_similarity: Float[Tensor, " v"]  # of each target view to the reference, less their mean
    view_span: float  # angle in degrees that the target views span around the target

    def view_angles(self, poses: Poses) -> Float[Tensor, "m v"]:
        """Compute the angle in degrees from the reference's camera to each target view's."""
        return rotation_angles(poses.rotation, self.target_maps.rotation.transpose(1, 2))

    def to_sim3(self, poses: Poses, index: int, view: int) -> Sim3:
        """Convert a pose in working units to one from the reference's camera to a view's camera."""
        # The nearest orthogonal matrix: a rotation in float32 is not orthogonal in float64.
        left, _, right = np.linalg.svd(poses.rotation[index].double().numpy())
        pose = Sim3(
            float(poses.scale[index]), left @ right, poses.translation[index].double().numpy()
        )
        return (
            between_cameras(self.target_cameras[0], self.target_cameras[view])
            @ self.target_to_working.inverse()
            @ pose
            @ self.reference_to_working
        )


def build_scene(
    reference: View,
    targets: Sequence[View],
    similarities: Sequence[Tensor],
    matches: Sequence[Matches],
) -> Scene:
    """Prepare the scene of a reference view and its target views."""
    cameras = tuple(target.frame.camera for target in targets)
    to_camera = [between_cameras(cameras[0], camera) for camera in cameras]

    # Points of all patches, (patches, 3) per view. Those of the targets are moved to the frame of
    # the first target camera.
    source = reference.measured_points[0].reshape(-1, 3)
    clouds = [
        (view.measured_points[0].reshape(-1, 3) - motion.t) @ motion.R  # its inverse
        for view, motion in zip(targets, to_camera)
    ]
    cloud = np.concatenate(clouds)
    known = np.concatenate([target.known_foreground.ravel() for target in targets])

    # Both clouds in working units.
    reference_to_working, source_valid = _normalisation(
        source, reference.known_foreground.ravel(), reference.frame.name or "reference"
    )
    target_to_working, valid = _normalisation(cloud, known, "target views")
    source = reference_to_working.apply(source)
    cloud = target_to_working.apply(cloud)

    # Similarities of the foreground patches: a row for each patch of the reference, and a column
    # for each patch of a target.
    foregrounds = [target.foreground.ravel() for target in targets]
    column = _number(np.concatenate(foregrounds))
    reference_foreground = reference.foreground.ravel()
    between_foregrounds = [
        similarity[reference_foreground][:, foreground]
        for similarity, foreground in zip(similarities, foregrounds)
    ]
    # The similarity of a target view to the reference: the highest similarity of each patch to any
    # patch of the other view, averaged over the reference's patches and over the target's.
    closeness = torch.stack(
        [(block.amax(dim=1).mean() + block.amax(dim=0).mean()) / 2 for block in between_foregrounds]
    )
    view_similarity = closeness - closeness.mean()
    valid_rows = torch.from_numpy(source_valid)[reference_foreground]

    # Points of the matches with measured depth on both sides.
    matched = []
    for target, motion, match in zip(targets, to_camera, matches):
        x, y, measured = measured_match_points(reference, target, match)
        x = reference_to_working.apply(x[measured])
        y = target_to_working.apply((y[measured] - motion.t) @ motion.R)
        matched.append((float_tensor(x), float_tensor(y)))

    # The mean of the targets' points, in the first target camera's frame.
    centre = target_to_working.inverse().t
    starts = np.cumsum([len(points) for points in clouds])[:-1]  # rows where later targets begin
    return Scene(
        reference_points=float_tensor(source[source_valid]),
        target_points=float_tensor(cloud[valid]),
        target_column=torch.from_numpy(column[valid]),
        target_weight=surface_weights(float_tensor(cloud[valid])),
        similarity=torch.cat(
            [_double_centre(block[valid_rows]) for block in between_foregrounds], dim=1
        ),
        # The reference's points are in its camera's frame: its camera has the identity as pose.
        reference_maps=build_maps(
            [reference],
            [Sim3.identity()],
            reference_to_working,
            [_number(source_valid)],
        ),
        target_maps=build_maps(targets, to_camera, target_to_working, np.split(column, starts)),
        reference_to_working=reference_to_working,
        target_to_working=target_to_working,
        target_cameras=cameras,
        matches=tuple(matched),
        view_similarity=view_similarity,
        view_span=view_span(cameras, cameras[0].to_world(centre)),
    )


def build_maps(
    views: Sequence[View],
    world_to_camera: Sequence[Sim3],
    to_working: Sim3,
    columns: Sequence[Int[np.ndarray, " _"]],
) -> ViewMaps:
    """Build the maps of views that share a world frame; `columns` has the number of each patch."""
    maps = [_table(view, column, to_working.scale) for view, column in zip(views, columns)]
    cameras, tables = zip(*maps)
    pixels = [0, *(table.shape[1] for table in tables[:-1])]  # their running sum: the first rows
    return ViewMaps(
        float_tensor([one.R for one in world_to_camera]),
        # In working units, with x_working = scale * x + to_working.t and x_cam times the scale:
        # scale * x_cam = scale * (R @ x + t) = R @ x_working + scale * t - R @ to_working.t.
        float_tensor([to_working.scale * one.t - one.R @ to_working.t for one in world_to_camera]),
        float_tensor([np.sqrt(camera.focal_length.prod()) for camera in cameras]),
        float_tensor([camera.principal_point for camera in cameras]),
        float_tensor([camera.size[::-1] for camera in cameras]),
        torch.from_numpy(np.cumsum(pixels)),
        torch.from_numpy(np.concatenate(tables, axis=1)).T,
    )


def project_points(
    maps: ViewMaps, poses: Poses, points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "m v n"] | Int[Tensor, "m v n"], ...]:
    """Project n points, moved by m poses, into v views and read the maps at their pixels.

    Returns (m, v, n) each: the depth of the point, and the measured depth at its pixel, working
    units; the weight of the measured depth, in [0, 1], 0 where it is unknown or background; the
    distance to the silhouette at the point's depth, working units, 0 inside; the row or column of
    the patch at the pixel in `Scene.similarity`, -1 for none.
    """
    # The points in all cameras, (m, v, 3, n), by one product of (m * v * 3, 3) and (3, n).
    camera_linear = (maps.rotation @ poses.linear[:, None]).reshape(-1, 3)
    rotated = maps.rotation @ poses.translation[:, None, :, None]
    camera_translation = rotated[..., 0] + maps.translation
    in_camera = (camera_linear @ points.T).view(len(poses), len(maps.size), 3, -1)
    in_camera = in_camera.add_(camera_translation[..., None])
    depth = in_camera[:, :, 2]
    pixels_per_unit = maps.focal_length[:, None] / depth.clamp_min(_MIN_DEPTH)
    pixels = (
        in_camera[:, :, :2].mul_(pixels_per_unit[:, :, None]).add_(maps.principal_point[..., None])
    )
    # The largest floats below the size: they truncate to the last pixel.
    last = torch.nextafter(maps.size, torch.zeros(()))[..., None]
    # A point beyond the border reads the nearest border pixel, and the distance to that pixel is
    # added to its silhouette distance. Where the silhouette reaches the border, the object is cut
    # off and its extent unknown: the distance stays 0.
    nearest = torch.minimum(pixels.clamp_min(0), last)
    column, row = nearest.int().unbind(2)
    index = (row * maps.size[:, :1].int()).add_(column).add_(maps.first_row[:, None].int())
    # The columns of the table are read one after the other: (m, v, n) each.
    read = [
        values.index_select(0, index.flatten()).view(index.shape) for values in maps.table.unbind(1)
    ]
    surface_depth, weight, distance, patch = read
    beyond = torch.sub(pixels, nearest).abs_().sum(2)  # 0 within the image
    # The sign is 0 where the border pixel is inside the silhouette.
    distance = distance.addcmul_(beyond, distance.sign()).div_(pixels_per_unit)
    return depth, surface_depth, weight, distance, patch.int()


def _table(
    view: View, columns: Int[np.ndarray, " patches"], scale: float
) -> tuple[Camera, Float[np.ndarray, "4 pixels"]]:
    """Return the camera of a map of about `_MAP_PIXELS` pixels, and the map's table."""
    camera = view.frame.camera
    grid = view.features.grid
    # Height over width of the field of view, in tangents of angles: a map with such sides has
    # equal focal lengths.
    aspect = (camera.size[0] / camera.focal_length[1]) / (camera.size[1] / camera.focal_length[0])
    height = max(round(float(np.sqrt(_MAP_PIXELS * aspect))), 1)
    width = max(round(_MAP_PIXELS / height), 1)
    size = (height, width)

    mask = cv2.resize(view.soft_mask, (width, height), interpolation=cv2.INTER_LINEAR)
    depth = view.frame.depth[_at_centres(size, camera.size)]
    distances = []
    for threshold in _MASK_THRESHOLDS:
        outside = (mask < threshold).astype(np.uint8)
        distance = cv2.distanceTransform(outside, cv2.DIST_L2, 5)  # by OpenCV's 5 x 5 window
        distances.append(distance.clip(max=_NO_SILHOUETTE))
    column = columns.reshape(grid)[_at_centres(size, grid)]
    table = [depth * scale, np.where(depth > 0, mask, 0), np.mean(distances, axis=0), column]
    stacked = np.stack([values.astype(np.float32) for values in table])
    return camera.resize(size), stacked.reshape(4, -1)


def _at_centres(size: tuple[int, int], grid: tuple[int, int]) -> tuple[Int[np.ndarray, "_ _"], ...]:
    """Index a grid over an image of (height, width) pixels by the cell at each pixel's centre."""
    # The centre of pixel i is at the fraction (2 i + 1) / (2 n) of the side.
    return np.ix_(*((2 * np.arange(n) + 1) * cells // (2 * n) for n, cells in zip(size, grid)))


def _double_centre(similarity: Float[Tensor, "n1 n2"]) -> Float[Tensor, "n1 n2"]:
    """Subtract the means of rows and columns."""
    # Patches amid an object are similar to most, those at its rim to few.
    rows = similarity.mean(dim=1, keepdim=True)
    columns = similarity.mean(dim=0, keepdim=True)
    return similarity - rows - columns + similarity.mean()


def surface_weights(points: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    """Weight points by the inverse of a Gaussian kernel density."""
    # A surface that three views show has three times the points of one that a single view shows.
    points = points / _DENSITY_SIGMA
    square = points.square().sum(dim=1, keepdim=True)
    # The exponent is one matrix product: -|x - y|^2 / 2 = -|y|^2 / 2 + (x, |x|^2) . (y, -1/2).
    # It is computed for few x at a time, so that the product stays in the processor's cache.
    left = torch.cat([points, square], dim=1)
    right = torch.cat([points, torch.full_like(square, -0.5)], dim=1)
    products = (torch.addmm(-square.T / 2, part, right.T) for part in left.split(_DENSITY_ROWS))
    weight = 1 / torch.cat([exp_(product).sum(dim=1) for product in products])
    return weight / weight.sum()


def measured_match_points(
    reference: View, target: View, matches: Matches
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], Bool[np.ndarray, " k"]]:
    """Return the points of matches, each in the frame of its own camera, and which have measured
    depth on both sides."""
    source, known = reference.measured_points
    destination, seen = target.measured_points
    # Index arrays (rows, columns) into the grids of patches: one entry per match.
    u = tuple(matches.reference.T)
    v = tuple(matches.target.T)
    return source[u], destination[v], known[u] & seen[v]


def _number(selected: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Number the selected entries consecutively from 0, -1 for the others."""
    return np.where(selected, np.cumsum(selected) - 1, -1)


def _normalisation(
    points: Float[np.ndarray, "n 3"], valid: Bool[np.ndarray, " n"], name: str
) -> tuple[Sim3, Bool[np.ndarray, " n"]]:
    """Return the transform to mean 0 and unit spread, and which valid points are no outliers."""
    n = int(valid.sum())
    if n < _MIN_POINTS:
        raise NoPoseError(
            f"{name}: {n} foreground patches of known depth, expected at least {_MIN_POINTS}"
        )
    inliers = valid.copy()
    inliers[valid] = near_median(points[valid], _OUTLIER_DISTANCE)
    mean = points[inliers].mean(axis=0)
    spread = standard_deviation(points[inliers])
    return Sim3(1 / spread, np.eye(3), -mean / spread), inliers
