"""True correspondences between synthetic objects: which place of the object each patch of a view shows.

`object_poses.json` beside a category's sequences says where each object stands in its world. With a frame's depth and
camera that gives the point of the object behind each patch (`patch_coordinates`), and with two views of different
objects, which of their patches show the same place (`true_partners`); `true_pair` does all that for an evaluation pair.
No method may look at this: it is for measuring.

Two instances of a category differ in their proportions, so "the same place" is the same place relative to the object's
box: coordinates run from 0 (rear, right, bottom) to 1 (front, left, top) along each axis.
"""

from dataclasses import dataclass

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from sklearn.neighbors import NearestNeighbors

from zsp_lite.data.annotations import decode
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.depth import patch_points
from zsp_lite.data.frames import Frame
from zsp_lite.data.pairs import Pair
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes
from zsp_lite.synthetic.export import POSES_FILE, SETTINGS_FILE, make_object
from zsp_lite.views import object_crop, patch_mask

_MARGIN = 0.05  # outside the box by more than this is no point of the object, but of the room

_SURE = 0.8  # masks are soft, and right to a pixel or two


_Row = tuple[float, float, float, float]


class _Settings(msgspec.Struct):
    seed: int


class _Placement(msgspec.Struct):
    trans: tuple[_Row, _Row, _Row, _Row]
    scale: float


@dataclass(frozen=True, eq=False)
class ObjectFrame:
    """Where one object stands: world = scale * R @ object + t, and its box in object coordinates."""

    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]
    scale: float
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]

    def to_object(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Object coordinates (front +x, left +y, up +z, surface of unit standard deviation) of world points."""
        return (np.asarray(world, np.float64) - self.t) @ self.R / self.scale

    def to_box(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """World points relative to the object's box: 0 to 1 along each object axis."""
        return (self.to_object(world) - self.low) / (self.high - self.low)


@dataclass(frozen=True, eq=False)
class TruePair:
    """Object crops of two instances of a category, and for each patch of the first its true partner in the second.

    partners (row, col) hold where `found` is true (see `true_partners`).
    """

    category: str
    reference: Frame
    target: Frame
    partners: Int[np.ndarray, "rows cols 2"]
    found: Bool[np.ndarray, "rows cols"]


def object_frames(dataset: Co3D, category: str) -> dict[str, ObjectFrame]:
    """The frame of each sequence's object, by the sequence's name; the box is that of the object's exact mesh.

    Raises InputError where the folder is no synthetic one, or one of its two files says something else.
    """
    settings, poses = dataset.root / SETTINGS_FILE, dataset.root / category / POSES_FILE
    for path in (settings, poses):
        if not path.is_file():
            raise InputError(f"{path} is missing, expected a folder of synthetic objects: only they have exact places")
    seed = decode(read_bytes(settings, "settings"), _Settings, settings).seed
    frames = {}
    for sequence, pose in decode(read_bytes(poses, "object poses"), dict[str, _Placement], poses).items():
        trans, vertices = np.array(pose.trans), make_object(category, sequence, seed).vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        frames[sequence] = ObjectFrame(trans[:3, :3], trans[:3, 3], pose.scale, low, high)
    return frames


def patch_coordinates(
    crop: Frame, place: ObjectFrame, grid: tuple[int, int]
) -> tuple[Float[np.ndarray, "rows cols 3"], Bool[np.ndarray, "rows cols"]]:
    """Box coordinates of what each patch of a frame (whole or cropped) shows, and for which patches they are known.

    Known: the mask covers a quarter of the patch, one of its object pixels has a measured depth, and the point is in
    the box. Raises InputError for a frame without depth or mask.
    """
    if crop.depth is None or crop.mask is None:
        raise InputError(f"{crop.name or 'frame'}: expected a depth map and a mask for the coordinates of its patches")
    # The object's pixels alone: between a bicycle's spokes the floor lies in the box too.
    points, measured = patch_points(np.where(crop.mask > _SURE, crop.depth, 0), crop.camera, grid)
    coordinates = place.to_box(crop.camera.to_world(points))
    inside = (np.abs(coordinates - 0.5) <= 0.5 + _MARGIN).all(axis=-1)
    return coordinates, measured & inside & patch_mask(crop, grid).numpy()


def true_partners(
    first: tuple[Float[np.ndarray, "r1 c1 3"], Bool[np.ndarray, "r1 c1"]],
    second: tuple[Float[np.ndarray, "r2 c2 3"], Bool[np.ndarray, "r2 c2"]],
    tolerance: float = 0.1,
) -> tuple[Int[np.ndarray, "r1 c1 2"], Bool[np.ndarray, "r1 c1"]]:
    """For each patch of the first view the patch (row, col) of the second that shows the nearest place of the object.

    first, second: as `patch_coordinates` gives them. The mask says where there is such a patch within `tolerance`, a
    length in box coordinates; elsewhere the place is out of the second view's sight, or not known, and the row is 0, 0.
    """
    (from_points, from_known), (to_points, to_known) = first, second
    partners, found = np.zeros((*from_known.shape, 2), int), np.zeros_like(from_known)
    if from_known.any() and to_known.any():
        search = NearestNeighbors(n_neighbors=1).fit(to_points[to_known])
        distance, index = search.kneighbors(from_points[from_known])
        partners[from_known] = np.argwhere(to_known)[index[:, 0]]
        found[from_known] = distance[:, 0] <= tolerance
        partners[~found] = 0
    return partners, found


def hits(
    cells: Int[np.ndarray, "*batch 2"], partners: Int[np.ndarray, "*batch 2"], within: float = 1
) -> Bool[np.ndarray, "*batch"]:
    """Which cells (row, col) lie within `within` patches of their true partners, in rows and in columns."""
    return np.abs(np.asarray(cells) - partners).max(axis=-1) <= within


def true_pair(dataset: Co3D, pair: Pair, grid: tuple[int, int] = (28, 28)) -> TruePair:
    """The object crops of a pair's reference and of that target view which shows most of the same places.

    Raises InputError where the folder is no synthetic one, or lacks one of the pair's frames.
    """
    places = object_frames(dataset, pair.category)

    def known(sequence: str, number: int):
        crop = object_crop(dataset.load(dataset.frame(pair.category, sequence, number)))
        return crop, patch_coordinates(crop, places[sequence], grid)

    reference, shown = known(pair.reference_sequence, pair.reference_frame)
    targets = [known(pair.target_sequence, number) for number in pair.target_frames]
    truths = [true_partners(shown, seen) for _, seen in targets]
    best = int(np.argmax([found.sum() for _, found in truths]))
    return TruePair(pair.category, reference, targets[best][0], *truths[best])
