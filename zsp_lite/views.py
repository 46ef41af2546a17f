"""Views: the object crop of a frame with its features, foreground patches and 3D points (fig. 2, left)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from zsp_lite.data.depth import patch_points
from zsp_lite.data.frames import Frame, crop_to_object, frame_defect, resize_frame, turn_frame
from zsp_lite.errors import InputError, check_integer
from zsp_lite.features import SALIENCY_THRESHOLD, FeatureExtractor, FeatureMap

IMAGE_SIZE = 224  # pixels of an object crop for a backbone without the attribute image_size
_MOST_PIXELS = 4096
# Share of a foreground patch that the mask covers. Thin parts, such as a chair's legs, do not cover half a patch.
_MASK_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class View:
    """An object crop with its features and foreground.

    Attributes:
        frame: The crop.
        features: Features of the crop's image.
        foreground: Patches on the object.
        object_mask: Probability of each pixel of being on the object, in [0, 1]; None if unknown.
    """

    frame: Frame
    features: FeatureMap
    foreground: Bool[torch.Tensor, "rows cols"]
    object_mask: Float[np.ndarray, "height width"] | None = None

    def __repr__(self) -> str:
        (height, width), (rows, columns) = self.frame.camera.size, self.features.grid
        return (
            f"View({self.frame.name!r}, {height} x {width} pixels, {int(self.foreground.sum())} of {rows} x {columns} "
            f"patches foreground)"
        )

    @property
    def soft_mask(self) -> Float[np.ndarray, "height width"]:
        """`object_mask`, or if there is none, the foreground patches interpolated between their centres."""
        if self.object_mask is not None:
            return self.object_mask
        patches = self.foreground.cpu().numpy().astype(np.float32)
        return cv2.resize(patches, self.frame.camera.size[::-1], interpolation=cv2.INTER_LINEAR)

    @cached_property
    def patch_points(self) -> tuple[Float[np.ndarray, "rows cols 3"], Bool[np.ndarray, "rows cols"]]:
        """Camera-frame point of each patch, and whether its depth was measured (see `depth.patch_points`).

        Computed on first use: of N target views the paper's solver needs only those of the chosen one.

        Raises:
            InputError: The frame has no known depth.
        """
        return self._patch_points(inpaint=True)

    @cached_property
    def measured_points(self) -> tuple[Float[np.ndarray, "rows cols 3"], Bool[np.ndarray, "rows cols"]]:
        """`patch_points` without in-painting: the point of a patch without measured depth is the origin."""
        return self._patch_points(inpaint=False)

    def _patch_points(self, inpaint: bool) -> tuple[Float[np.ndarray, "rows cols 3"], Bool[np.ndarray, "rows cols"]]:
        name = self.frame.name or "frame"
        if self.frame.depth is None:
            raise InputError(f"{name}: no depth map, expected one to unproject matches")
        try:
            return patch_points(self.frame.depth, self.frame.camera, self.features.grid, inpaint)
        except InputError as error:
            raise InputError(f"{name}: {error}") from error

    @property
    def known_foreground(self) -> Bool[np.ndarray, "rows cols"]:
        """Foreground patches with measured depth."""
        return np.asarray(self.foreground.cpu()) & self.measured_points[1]


def crop_size(backbone: FeatureExtractor | None) -> int:
    """Get the size of object crops for a backbone, in pixels: its `image_size`, or 224 without one.

    Raises:
        InputError: `image_size` is not an integer from 1 to 4096.
    """
    size = getattr(backbone, "image_size", IMAGE_SIZE)
    check_integer("image_size of the backbone", size, 1, _MOST_PIXELS)
    return size


def has_saliency(backbone: FeatureExtractor | None) -> bool:
    """Tell whether a backbone separates the object from the background: its `has_saliency`, or True without one."""
    return getattr(backbone, "has_saliency", True)


def object_crop(frame: Frame, size: int = IMAGE_SIZE) -> Frame:
    """Crop a frame to its object and resize it to (size, size), not keeping its aspect (supplement, "Object crops").

    A frame without a mask, or with an empty one, is not cropped.

    Args:
        frame: Frame, whole.
        size: Pixels; see `crop_size` for the size that a backbone takes.
    """
    return resize_frame(frame if frame.mask is None or not frame.mask.any() else crop_to_object(frame), (size, size))


def extract_views(
    backbone: FeatureExtractor,
    frames: Sequence[Frame],
    foreground: str = "saliency",
    saliency_threshold: float = SALIENCY_THRESHOLD,
) -> list[View]:
    """Extract the views of cropped frames, their features in one batch.

    Args:
        backbone: Computes the features.
        frames: Object crops (see `object_crop`).
        foreground: "saliency" or "mask" (see `frame_view`).
        saliency_threshold: A patch is foreground if its saliency is above this.
    """
    if not callable(backbone):
        raise InputError(f"backbone is {backbone!r}, expected a callable that maps images to feature maps")
    maps = backbone([frame.rgb for frame in frames])
    return [frame_view(frame, features, foreground, saliency_threshold) for frame, features in zip(frames, maps)]


def frame_view(
    frame: Frame, features: FeatureMap, foreground: str = "saliency", saliency_threshold: float = SALIENCY_THRESHOLD
) -> View:
    """Combine a cropped frame with its features and its foreground patches.

    A frame with an empty mask has no foreground.

    Args:
        frame: Object crop.
        features: Features of its image.
        foreground: "saliency" for patches whose saliency is above the threshold, or "mask" for patches of which the
            frame's mask covers at least a quarter.
        saliency_threshold: A patch is foreground if its saliency is above this.

    Raises:
        InputError: foreground is "mask" and the frame has no mask.
    """
    if foreground == "mask" or (frame.mask is not None and not frame.mask.any()):
        return View(frame, features, patch_mask(frame, features.grid).to(features.keys.device), frame.mask)
    soft = soft_saliency(features, frame.camera.size, saliency_threshold)
    return View(frame, features, features.foreground(saliency_threshold), soft)


def turn_view(view: View, quarters: int) -> View:
    """Turn a view with its feature maps and masks by quarter turns; features are not computed again.

    Args:
        view: The view.
        quarters: Number of turns by 90 degrees, counterclockwise as in `numpy.rot90`.
    """
    features = view.features
    keys, saliency, foreground = (
        torch.rot90(values, quarters, (0, 1)) for values in (features.keys, features.saliency, view.foreground)
    )
    mask = None if view.object_mask is None else np.ascontiguousarray(np.rot90(view.object_mask, quarters))
    features = FeatureMap(keys, saliency, features.global_feature)
    return View(turn_frame(view.frame, quarters), features, foreground, mask)


def usable_targets(targets: Sequence[View]) -> tuple[list[int], tuple[str, ...]]:
    """Select the target views that a pose can be estimated in.

    Args:
        targets: Target views.

    Returns:
        The indices of the views without a `frame_defect` and with a foreground patch, and for each other view a flag
        that names it and the reason.

    Raises:
        InputError: No view is usable.
    """
    usable, flags = [], []
    for index, target in enumerate(targets):
        defect = frame_defect(target.frame) or ("" if target.foreground.any() else "no foreground")
        if defect:
            flags.append(f"{target.frame.name or f'target view {index}'} left out: {defect}")
        else:
            usable.append(index)
    if not usable:
        raise InputError(f"all {len(targets)} target views were left out: {'; '.join(flags)}")
    return usable, tuple(flags)


def soft_saliency(
    features: FeatureMap, size: tuple[int, int], threshold: float = SALIENCY_THRESHOLD
) -> Float[np.ndarray, "height width"]:
    """Turn saliency into a soft mask: 0 for no saliency, 0.5 at the threshold, 1 from twice the threshold on.

    Args:
        features: Features of the image.
        size: (height, width) of the mask in pixels; values are interpolated between the patches' centres.
        threshold: Threshold of the foreground.
    """
    ramp = (features.saliency.cpu().numpy() / max(2 * threshold, 1e-6)).clip(0, 1)
    return cv2.resize(ramp, size[::-1], interpolation=cv2.INTER_LINEAR)


def patch_mask(frame: Frame, grid: tuple[int, int]) -> Bool[torch.Tensor, "rows cols"]:
    """Select the patches of which the frame's mask covers at least a quarter.

    Raises:
        InputError: The frame has no mask.
    """
    if frame.mask is None:
        raise InputError(f"{frame.name or 'frame'}: no mask, expected one for the patches' foreground")
    covered = cv2.resize(frame.mask, grid[::-1], interpolation=cv2.INTER_AREA)
    return torch.from_numpy(covered >= _MASK_SHARE)
