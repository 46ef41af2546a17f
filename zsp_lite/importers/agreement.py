"""Check that the depth of a few frames agrees by their poses, or name the usual mistake.

Points of the object in one frame are moved into another frame. If units and poses are right, a high
share of the points lies on the surface there, also with noise and holes: about 0.9 for cameras 15
degrees apart, and 0.8 for 45 degrees.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import ON_OBJECT, Frame, frame_defect
from zsp_lite.errors import Contradiction, Doubt, InputError
from zsp_lite.importers.capture import FROM_OPENGL
from zsp_lite.importers.files import WINDOW_5
from zsp_lite.importers.masks import PLAUSIBLE, masks_from_depth
from zsp_lite.metrics import rotation_angle
from zsp_lite.points import object_pixels, world_points

_POINTS = 500  # largest number of points of a frame, about
_LEAST_POINTS = 50  # with fewer points, a share says little
_PAIRS = 8  # largest number of pairs of frames
# Angles between the two cameras of a pair, degrees. With a smaller angle, wrong poses agree, too;
# with a larger one, the cameras see other sides of the object.
_LEAST_TURN = 4.0
_BEST_TURN = 20.0
_LARGEST_TURN = 50.0
_TOLERANCE = 0.05  # largest difference of depth on a surface, relative to the object's distance
_AGREEING = 0.6  # frames agree without doubt above this share of points
_FITTING = 0.5  # the right correction makes at least this share of points agree
_GAIN = 0.25  # a correction of poses raises the share by at least this value
_ALIKE = 0.03  # of corrections whose shares differ by less, the likelier is named
# Depth along the ray raises the share in the whole image by at least this factor. The gain is
# small, because both depths are nearly equal near the optical axis.
_RAY_GAIN = 1.2
_CONTRADICTING = 0.4  # frames contradict each other below this share of points
_UNITS = {1.0: "metres", 0.001: "millimetres", 0.0002: "1/5000 m"}
_SCALES = np.geomspace(1e-3, 1e3, 280)  # factors of the depth in steps of 5 %
_SMALL_SCALES = np.geomspace(0.6, 1.7, 27)  # in steps of 4 %, where the given unit is about right
_FINE = np.linspace(0.95, 1.05, 11)  # in steps of 1 %, around the best of the others
# The right factor makes the weighted share at least so many times as great. On renderings with the
# noise of phones, where the unit is right, 1.28 times is the most; units that are off by 15 % make
# at least 1.4 times without noise.
_SCALE_GAIN = 1.35
# The right focal length makes the closeness in the mean at least so many times as great as any
# factor of the depth, such as 1, and raises it in each pair. On renderings with the noise of phones
# and right intrinsics no factor does both; of 40 focal lengths that are 1.25 times as long, 35 are
# found.
_FOCAL_GAIN = 1.07
_OWN_SCALES = np.geomspace(0.4, 2.5, 39)  # of a single frame

_Pose = Float[np.ndarray, "4 4"]  # world to camera
_Correction = Callable[[_Pose], _Pose]


@dataclass(frozen=True, eq=False)
class _Surface:
    """The object in one frame."""

    points: Float[np.ndarray, "n 3"]  # some points of the object in the camera's frame
    depth: Float[np.ndarray, "h w"]  # 0 where unknown, infinite off the object
    camera: Camera
    distance: float  # median depth of the points; 0 without points

    @classmethod
    def of(cls, frame: Frame) -> "_Surface":
        """Gather some points of the object in a frame; without a mask, all is object."""
        mask = np.ones(frame.depth.shape, np.float32) if frame.mask is None else frame.mask
        pixels = object_pixels(frame)
        points = frame.camera.to_camera(
            world_points(frame, pixels, int(pixels.sum()) // _POINTS + 1)
        )
        # The mask is widened by two pixels, because masks and poses are not exact.
        depth = np.where(cv2.dilate(mask, WINDOW_5) > ON_OBJECT, frame.depth, np.inf)
        distance = float(np.median(points[:, 2])) if len(points) else 0.0
        return cls(points, depth, frame.camera, distance)

    def share(
        self,
        other: "_Surface",
        motion: _Pose,
        focal: float = 1.0,
        along_ray: bool = False,
        own_scale: bool = False,
        weighted: bool = False,
    ) -> float:
        """Return the share of points that lie on another surface after a motion between cameras.

        The focal length of both is multiplied by the factor `focal`. `own_scale` multiplies the
        other surface's depth by the factor that fits. Points are `weighted` from 1 on the surface
        to 0 at the tolerance.
        """
        focal_length = focal * other.camera.focal_length
        camera = replace(other.camera, R=motion[:3, :3], t=motion[:3, 3], focal_length=focal_length)
        points = self.points / (focal, focal, 1)
        if along_ray:
            # The stored depth is the length of the ray: points move towards the camera.
            points = points * points[:, 2:] / np.linalg.norm(points, axis=1, keepdims=True)
        pixels, depth = camera.project(points)
        inside = (
            (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < other.depth.shape[::-1]).all(axis=1)
        )
        stored = np.linalg.norm(camera.to_camera(points), axis=1) if along_ray else depth
        stored = stored[inside]
        columns, rows = pixels[inside].astype(int).T
        surface = other.depth[rows, columns]
        seen = (surface > 0) & np.isfinite(surface)
        if own_scale and seen.any():
            stored = stored / np.median(stored[seen] / surface[seen])
        off = np.abs(stored - surface) / (_TOLERANCE * other.distance)
        agreeing = (1 - off).clip(0) if weighted else off < 1
        # Points on pixels of unknown depth do not count.
        return agreeing.sum() / max(1, len(inside) - (surface == 0).sum())


_Pair = tuple[_Surface, _Surface]


def disagreement(frames: Iterable[Frame], unit: float | None = None) -> str:
    """Say that frames of one object do not agree, and which usual mistake explains it.

    Returns a `Doubt` or `Contradiction`, which are texts, or "" if the frames agree or none of them
    overlap. Frames without a mask get one by depth. `unit` has the world units per stored depth
    value, if the user can change it.
    """
    # The surfaces of each frame: of the object, and of everything in the image.
    objects = []
    scenes = []
    for frame in frames:
        if frame_defect(frame):
            continue
        scenes.append(_Surface.of(replace(frame, mask=None)))
        if frame.mask is None:
            with suppress(InputError):
                (frame,) = masks_from_depth([frame])
        objects.append(_Surface.of(frame))
    pairs = _pairs(objects)
    whole = _pairs(scenes)
    if not pairs:
        # No two cameras are turned enough to test the poses. Those that are hardly turned agree,
        # unless the object turns.
        unturned = _pairs(objects, 0.0)
        if not unturned or _share(unturned) > _AGREEING:
            return ""
        return Contradiction(
            "the cameras hardly turn, but the object does: expected the poses of the cameras "
            "relative to the object"
        )
    given = _share(pairs)
    everywhere = _share(whole)
    found = f"depth and poses do not agree ({given:.0%} of the object's points do)"

    # A wrong focal length. On the object alone, which is near the optical axis, it changes little:
    # all that is seen counts, too. Each pair must agree better, because errors of poses are not
    # alike in all pairs.
    def closeness_by(**factor: float) -> Float[np.ndarray, " n"]:
        """Return the closeness of each pair, of the object and of all, by a factor."""
        every = [*pairs, *whole]
        return np.array([_share([pair], weighted=True, **factor) for pair in every])

    focal = max(_SMALL_SCALES, key=lambda factor: closeness_by(focal=factor).sum())
    refocused = closeness_by(focal=focal)
    share = _share(pairs, focal=focal)
    if (
        len(pairs) > 2
        and share > _AGREEING
        and (refocused > closeness_by()).all()
        and refocused.sum()
        > _FOCAL_GAIN * max(closeness_by(scale=scale).sum() for scale in (1.0, *_SMALL_SCALES))
    ):
        return Contradiction(
            f"depth and poses agree better ({share:.0%} of the object's points, not {given:.0%}) "
            f"if the focal length is multiplied by about {focal:.2g}"
        )

    # Depth along the ray changes little on the object alone, which is near the optical axis: the
    # whole image decides.
    everywhere_by_ray = _share(whole, along_ray=True)
    gains = everywhere_by_ray > max(_RAY_GAIN * everywhere, _FITTING)
    if gains and _share(pairs, along_ray=True) > _AGREEING:
        return Doubt(
            f"{found}; all that is seen agrees better ({everywhere_by_ray:.0%}, not "
            f"{everywhere:.0%}) if depth is the distance along the ray of a pixel, not along the "
            "optical axis"
        )

    # Mistakes in poses and units.
    closeness = _share(pairs, weighted=True)
    # The closeness is 1 at most, so no factor can raise it enough. The share is no less than it.
    if _SCALE_GAIN * closeness > 1:
        return ""
    factors = _SMALL_SCALES
    if given <= _AGREEING:
        shares = np.array([_share(pairs, correct) for _, correct in _CORRECTIONS])
        likeliest = np.argmax(shares > shares.max() - _ALIKE)  # the first of those alike
        if shares[likeliest] > max(_FITTING, given + _GAIN):
            return Contradiction(
                f"{found}; they agree ({shares[likeliest]:.0%}) if the poses "
                f"{_CORRECTIONS[likeliest][0]}"
            )
        factors = _SCALES
    factor = _best_scale(pairs, _best_scale(pairs, factors) * _FINE)
    closeness_scaled = _share(pairs, scale=factor, weighted=True)
    share = _share(pairs, scale=factor)
    if share > _FITTING and closeness_scaled > _SCALE_GAIN * closeness:
        distance = float(np.median([surface.distance for surface, _ in pairs]))
        return Contradiction(
            f"{found}; they agree best ({share:.0%}) if {_scaled(factor, distance, unit)}"
        )
    if given > _AGREEING:
        return ""
    # Two factors, of all depth and of the second frame's alone, fit many wrong poses of a single
    # pair, but not those of all of several pairs.
    share = min(
        max(_share([pair], scale=scale, own_scale=True) for scale in _OWN_SCALES) for pair in pairs
    )
    if len(pairs) > 2 and share > max(_AGREEING, given + _GAIN):
        return Contradiction(
            f"{found}; they agree ({share:.0%}) if each frame's depth is multiplied by a factor of "
            "its own, as depth of a network needs"
        )
    if max(given, everywhere) < _CONTRADICTING:
        return Contradiction(
            f"{found}, and no usual mistake in units or poses explains it: are the poses those of "
            "other frames?"
        )
    return ""


def neighbours(count: int) -> list[int]:
    """Choose three positions among `count` frames around an object, and one beside each."""
    thirds = [k * count // 3 for k in range(3)]
    steps = (0, max(1, count // 18))  # 20 degrees of a turn around the object
    return sorted({(third + step) % count for third in thirds for step in steps})


def _pairs(surfaces: Sequence[_Surface], least_turn: float = _LEAST_TURN) -> list[_Pair]:
    """Pair each surface with another one whose camera is turned by about `_BEST_TURN` degrees, and
    by `least_turn` at least."""
    surfaces = [surface for surface in surfaces if len(surface.points) >= _LEAST_POINTS]
    pairs = []
    for surface in surfaces:
        others = [other for other in surfaces if other is not surface]
        # These angles can be trusted: no usual mistake in the poses changes them.
        angles = np.array([rotation_angle(surface.camera.R, other.camera.R) for other in others])
        angles[(angles < least_turn) | (angles > _LARGEST_TURN)] = np.inf
        if np.isfinite(angles).any():
            pairs.append((surface, others[np.abs(angles - _BEST_TURN).argmin()]))
    return pairs[:: len(pairs) // _PAIRS + 1]


def _share(
    pairs: Sequence[_Pair],
    corrected: _Correction = np.asarray,
    scale: float = 1.0,
    **options: float,
) -> float:
    """Return the median share of agreeing points, with corrected poses and with scaled depth;
    `options` are of `_Surface.share`."""
    shares = []
    for surface, other in pairs:
        # The motion leads from the camera of the surface to the other camera. Dividing its
        # translation by a factor is the same as multiplying all depth by the factor.
        motion = corrected(other.camera.matrix) @ np.linalg.inv(corrected(surface.camera.matrix))
        motion[:3, 3] /= scale
        shares.append(surface.share(other, motion, **options))
    return float(np.median(shares))


def _best_scale(pairs: Sequence[_Pair], factors: np.ndarray) -> float:
    """Return the factor of the depth by which the points are nearest to the surfaces."""
    return max(factors.tolist(), key=lambda scale: _share(pairs, scale=scale, weighted=True))


def _scaled(factor: float, distance: float, unit: float | None) -> str:
    """Say that the depth, or else the cameras' positions, must be multiplied by a factor."""
    if not unit:
        return f"the depth is multiplied by {factor:.3g}"
    new = factor * unit
    # A unit within 4 % of a usual one is taken for that one, unless it is the present unit.
    new = next((one for one in _UNITS if abs(one / new - 1) < 0.04 and one != unit), new)
    # The depth is right if its factor would make a plausible distance of the object implausible.
    nearest, farthest = PLAUSIBLE
    if nearest <= distance <= farthest and not nearest <= distance * new / unit <= farthest:
        return f"the positions of the cameras are multiplied by {unit / new:.3g}"
    what = f"taken in {_UNITS[new]}" if new in _UNITS else f"multiplied by {factor:.3g}"
    return f"the depth is {what}: --depth-unit {new:.3g}"


def _reorder(pose: _Pose) -> _Pose:
    """Take the first number of the quaternion from camera to world as w, in place of the last."""
    to_world = np.linalg.inv(pose)
    quaternion = Rotation.from_matrix(to_world[:3, :3]).as_quat()
    to_world[:3, :3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    return np.linalg.inv(to_world)


_OTHER_AXES = (
    "have the other axes, OpenGL's for OpenCV's or the reverse: negate the columns y and z"
)
_INVERSE = "are world to camera"
_INVERSE_OPENGL = (
    "are world to camera in the other axes: invert them, then negate the columns y and z"
)
# Corrections from wrong to right world-to-camera matrices, the likeliest first. The axes of the
# world do not matter.
_CORRECTIONS: list[tuple[str, _Correction]] = [
    (_INVERSE, np.linalg.inv),
    (_INVERSE_OPENGL, lambda pose: FROM_OPENGL @ np.linalg.inv(pose)),
    (_OTHER_AXES, lambda pose: FROM_OPENGL @ pose),
    ("are from quaternions with w first", _reorder),
]
