"""Views: the object crop of a frame with its features, foreground patches and 3D points (fig. 2,
left)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from zsp_lite.data.depth import patch_points
from zsp_lite.data.frames import Frame, crop_to_object, frame_defect, resize_frame
from zsp_lite.errors import FatalError, InputError, NoPoseError, ends_the_run
from zsp_lite.features import SALIENCY_THRESHOLD, FeatureExtractor, FeatureMap
from zsp_lite.matching import Matches

IMAGE_SIZE = 224  # pixels of an object crop for a backbone without the attribute image_size
# Share of a foreground patch that the mask covers. Thin parts, such as a chair's legs, do not cover
# half a patch.
_MASK_SHARE = 0.25
_PatchPoints = tuple[Float[np.ndarray, "rows cols 3"], Bool[np.ndarray, "rows cols"]]


@dataclass(frozen=True, eq=False)
class View:
    """An object crop with its features and foreground."""

    frame: Frame  # the crop
    features: FeatureMap  # features of the crop's image
    foreground: Bool[torch.Tensor, "rows cols"] = field(repr=False)  # patches on the object
    # probability of each pixel of being on the object, in [0, 1]
    soft_mask: Float[np.ndarray, "height width"] = field(repr=False)
    # standard deviation of the object in the frame's lengths; the scenes of CO3D are scaled to 1
    size: float = 1.0

    @cached_property  # of N target views the paper's solver needs only those of the chosen one
    def patch_points(self) -> _PatchPoints:
        """Camera-frame point of each patch, and whether its depth was measured (see
        `depth.patch_points`)."""
        return self._points(inpaint=True)

    @cached_property
    def measured_points(self) -> _PatchPoints:
        """`patch_points` without in-painting: the point of a patch without measured depth is the
        origin."""
        return self._points(inpaint=False)

    def _points(self, inpaint: bool) -> _PatchPoints:
        # OpenCV's in-painting depends on the unit of length.
        depth = self.frame.depth / self.size
        points, known = patch_points(depth, self.frame.camera, self.features.grid, inpaint)
        return self.size * points, known

    @property
    def known_foreground(self) -> Bool[np.ndarray, "rows cols"]:
        """Foreground patches with measured depth."""
        return self.foreground.numpy() & self.measured_points[1]


@dataclass(frozen=True, eq=False)
class ViewMatch:
    """The reference and one target view, with their matches: the input of a view selector."""

    reference: View
    target: View
    # cosines between the descriptors of their patches
    similarity: Float[torch.Tensor, "reference target"]
    matches: Matches  # at most k matches
    k: int  # requested number of matches


def object_crop(frame: Frame, size: int | None = IMAGE_SIZE) -> Frame:
    """Crop a frame to its object and resize it to size x size pixels, if given (supplement, "Object
    crops").

    The aspect is not kept. A frame without a mask, or with an empty one, is not cropped.
    """
    cropped = crop_to_object(frame) if frame.mask is not None and frame.shows_object else frame
    return resize_frame(cropped, (size, size)) if size else cropped


def extract_views(
    backbone: FeatureExtractor, crops: Sequence[Frame], foreground: str = "saliency"
) -> list[View]:
    """Extract the views of object crops, their features in one batch; see `frame_view` for the
    foreground."""
    maps = feature_maps(backbone, crops)
    return [frame_view(crop, features, foreground) for crop, features in zip(crops, maps)]


def feature_maps(backbone: FeatureExtractor, crops: Sequence[Frame]) -> list[FeatureMap]:
    """Call a backbone on copies of the crops' images; FatalError unless it returns a feature map
    for each."""
    name = getattr(backbone, "name", type(backbone).__name__)
    with ends_the_run(f"backbone {name}"):
        maps = list(backbone([crop.rgb.copy() for crop in crops]))
    if len(maps) != len(crops) or not all(isinstance(one, FeatureMap) for one in maps):
        kinds = ", ".join(sorted({type(one).__name__ for one in maps})) or "nothing"
        raise FatalError(
            f"backbone {name} returned {len(maps)} of {kinds} for {len(crops)} images, "
            f"expected {len(crops)} of FeatureMap"
        )
    return maps


def frame_view(crop: Frame, features: FeatureMap, foreground: str) -> View:
    """Combine an object crop with its features and its foreground patches.

    The foreground are the salient patches (see `FeatureMap.foreground`), or for "mask" the patches
    of which the frame's mask covers at least a quarter. A frame with an empty mask has no
    foreground.
    """
    if foreground == "mask" or not crop.shows_object:
        return View(crop, features, patch_mask(crop, features.grid), crop.mask)
    # As a soft mask: 0 for no saliency, 0.5 at the threshold of the foreground, 1 from twice that
    # on.
    ramp = (features.saliency.numpy() / (2 * SALIENCY_THRESHOLD)).clip(0, 1)
    soft_mask = cv2.resize(ramp, crop.camera.size[::-1], interpolation=cv2.INTER_LINEAR)
    return View(crop, features, features.foreground(), soft_mask)


def usable_targets(targets: Sequence[View]) -> tuple[list[int], tuple[str, ...]]:
    """Select the target views that a pose can be estimated in: those without a `frame_defect`, with
    a foreground patch.

    Returns their indices, and for each other view a flag that names it and the reason. NoPoseError
    if none is usable.
    """
    usable = []
    flags = []
    for index, target in enumerate(targets):
        defect = frame_defect(target.frame) or ("" if target.foreground.any() else "no foreground")
        if defect:
            flags.append(f"{target.frame.name or f'target view {index}'} left out: {defect}")
        else:
            usable.append(index)
    if not usable:
        raise NoPoseError(f"all {len(targets)} target views were left out: {'; '.join(flags)}")
    return usable, tuple(flags)


def patch_mask(frame: Frame, grid: tuple[int, int]) -> Bool[torch.Tensor, "rows cols"]:
    """Select the patches of which the frame's mask covers at least a quarter."""
    if frame.mask is None:
        raise InputError(
            f"{frame.name or 'frame'}: no mask, expected one for the patches' foreground"
        )
    covered = cv2.resize(frame.mask, grid[::-1], interpolation=cv2.INTER_AREA)
    return torch.from_numpy(covered >= _MASK_SHARE)
