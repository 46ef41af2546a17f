"""A first guess of a label by the method itself: the person corrects instead of beginning from nothing."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.pipeline import ZeroShotPose

if TYPE_CHECKING:
    from zsp_lite.backbones.backbone import Backbone


def guess_alignment(
    dataset: Co3D, backbone: "Backbone", category: str, reference: str, sequence: str,
    references: int = 3, views: int = 6,
) -> tuple[Sim3, float]:  # fmt: skip
    """The reference's world laid on the sequence's world, and how sure the method is (0 to 1).

    From `references` frames of the one and `views` of the other, each evenly spread, by the verified solver; the
    surest estimate is taken. Raises InputError where no frame of either has a camera, a mask and depth.
    """
    method = ZeroShotPose(backbone, solver="verified")
    first, second = _frames(dataset, category, reference, references), _frames(dataset, category, sequence, views)
    seen = method.views([*first, *second])
    found = [method.estimate_from_views(view, seen[len(first) :]) for view in seen[: len(first)]]
    best = int(np.argmax([estimate.confidence for estimate in found]))
    to_camera, from_camera = _rigid(first[best].camera), _rigid(found[best].target_camera).inverse()
    return from_camera @ found[best].sim3 @ to_camera, float(found[best].confidence)


def _frames(dataset: Co3D, category: str, sequence: str, count: int) -> Sequence[Frame]:
    usable = [one for one in dataset.frames(category, sequence) if None not in (one.viewpoint, one.depth, one.mask)]
    if not usable:
        raise InputError(f"sequence {category}/{sequence} has no frame with camera, depth and mask, expected some")
    if len(usable) > count:
        usable = [usable[index] for index in np.linspace(0, len(usable) - 1, count + 1)[:-1].astype(int)]
    return [dataset.load(annotation) for annotation in usable]


def _rigid(camera: Camera) -> Sim3:
    """World to camera."""
    return Sim3(1.0, camera.R, camera.t)
