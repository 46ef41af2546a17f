"""Proposal of a label by pose estimation, to be corrected by hand."""

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
    """Estimate the similarity from the world of the reference sequence to that of another sequence.

    Poses are estimated by the verified solver between evenly spaced frames of both sequences; the estimate of the
    highest confidence is returned, with its confidence in [0, 1].
    """
    method = ZeroShotPose(backbone, solver="verified")
    first, second = _frames(dataset, category, reference, references), _frames(dataset, category, sequence, views)
    extracted = method.views([*first, *second])
    estimates = [method.estimate_from_views(view, extracted[len(first) :]) for view in extracted[: len(first)]]
    best = int(np.argmax([estimate.confidence for estimate in estimates]))
    estimate = estimates[best]
    to_camera, from_camera = _world_to_camera(first[best].camera), _world_to_camera(estimate.target_camera).inverse()
    return from_camera @ estimate.sim3 @ to_camera, float(estimate.confidence)


def _frames(dataset: Co3D, category: str, sequence: str, count: int) -> Sequence[Frame]:
    """Load `count` evenly spaced frames that have camera, mask and depth."""
    usable = [one for one in dataset.frames(category, sequence) if None not in (one.viewpoint, one.depth, one.mask)]
    if not usable:
        raise InputError(f"sequence {category}/{sequence} has no frame with camera, depth and mask")
    if len(usable) > count:
        usable = [usable[index] for index in np.linspace(0, len(usable) - 1, count + 1)[:-1].astype(int)]
    return [dataset.load(annotation) for annotation in usable]


def _world_to_camera(camera: Camera) -> Sim3:
    return Sim3(1.0, camera.R, camera.t)
