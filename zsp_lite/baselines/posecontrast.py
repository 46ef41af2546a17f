"""PoseContrast: absolute viewpoints by a network trained on pose labels (Xiao et al. 2021; paper sec. 5.2).

A ResNet-50 computes a feature of the image. A small head predicts azimuth, elevation and in-plane rotation, each as a
bin and an offset inside the bin.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from zsp_lite.backbones.backbone import normalize, prepare_images
from zsp_lite.backbones.checkpoints import load_weights
from zsp_lite.baselines.resnet import CHANNELS, ResNet50
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder
from zsp_lite.io.tensors import load_torch

SOURCE = "https://github.com/YoungXIAO13/PoseContrast"  # the authors' repository links the checkpoint
FILE = "posecontrast.pth"  # in the cache folder
VARIABLE = "ZSP_LITE_POSECONTRAST"  # environment variable with the path of the checkpoint
IMAGE_SIZE = 224
BIN = 15.0  # degrees
BINS = (24, 12, 24)  # numbers of bins of azimuth, elevation and in-plane rotation
ANGLES = ("azi", "ele", "inp")
_WIDTHS = (800, 400, 200)  # of the head's layers
# PoseContrast's cameras look along -z with +y up (OpenGL), ours along +z with +y down.
_AXES = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Viewpoint of an image.

    Attributes:
        rotation: (3, 3) rotation from the canonical frame of the category to the camera (OpenCV axes).
        feature: (d,) feature of the image.
    """

    rotation: Float[np.ndarray, "3 3"]
    feature: Float[Tensor, " d"]


class ViewpointHead(nn.Module):
    """Classifier of the bins of each angle, and regression of the offset inside each bin as a fraction of its width."""

    def __init__(self):
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in zip((CHANNELS[-1], *_WIDTHS), _WIDTHS):
            layers += [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU(inplace=True)]
        self.compress = nn.Sequential(*layers)
        for kind in ("cls", "reg"):
            for angle, bins in zip(ANGLES, BINS):
                setattr(self, f"fc_{kind}_{angle}", nn.Linear(_WIDTHS[-1], bins))

    def forward(self, feature: Float[Tensor, "b d"]) -> tuple[list[Tensor], list[Tensor]]:
        """Compute the logits and the offsets (b, bins) of azimuth, elevation and in-plane rotation."""
        x = self.compress(feature)
        logits, offsets = ([getattr(self, f"fc_{kind}_{angle}")(x) for angle in ANGLES] for kind in ("cls", "reg"))
        return logits, offsets


class PoseContrast:
    """Estimator of absolute viewpoints."""

    name = "posecontrast"

    def __init__(self, network: ResNet50, head: ViewpointHead):
        self.network, self.head = network.eval().requires_grad_(False), head.eval().requires_grad_(False)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the weights, which identify the estimator in the benchmark."""
        return self.network.state_dict() | self.head.state_dict(prefix="head.")

    def describe(self, frames: Sequence[Frame]) -> list[Viewpoint]:
        """Estimate the viewpoints of object crops."""
        viewpoints = []
        for frame in frames:
            batch = normalize(prepare_images([square_crop(frame, IMAGE_SIZE)], IMAGE_SIZE))
            with torch.inference_mode():
                feature = self.network(batch)
                angles = predict_angles(*self.head(feature))[0]
            viewpoints.append(Viewpoint(euler_to_rotation(angles.numpy()), feature[0].clone()))
        return viewpoints


def load_posecontrast(path: str | Path | None = None) -> PoseContrast:
    """Load the published network.

    Args:
        path: Checkpoint {"net_feat": ResNet-50 with 128 outputs, "net_vp": head, ...}; by default
            $ZSP_LITE_POSECONTRAST, else `posecontrast.pth` in the cache folder.

    Raises:
        InputError: The file is missing or damaged, or has other keys or shapes.
    """
    path = Path(path or os.environ.get(VARIABLE) or cache_folder() / FILE)
    if not path.is_file():
        raise InputError(f"posecontrast: {path} is no file; get the checkpoint from {SOURCE}, and set {VARIABLE} to it")
    network, head = ResNet50(outputs=128), ViewpointHead()
    content = load_torch(path, "posecontrast")
    parts = [content.get(part) if isinstance(content, dict) else None for part in ("net_feat", "net_vp")]
    if not all(isinstance(part, dict) for part in parts):
        raise InputError(f"posecontrast {path}: expected a dict with net_feat and net_vp")
    for module, weights in zip((network, head), parts):
        weights = {str(key).removeprefix("module."): value for key, value in weights.items()}
        load_weights(module, weights, f"posecontrast {path}")
    return PoseContrast(network, head)


def predict_angles(logits: Sequence[Tensor], offsets: Sequence[Tensor]) -> Float[Tensor, "b 3"]:
    """Compute the angles of the most probable bins with their offsets.

    Returns:
        (b, 3) angles in degrees, in the convention of `euler_to_rotation`.
    """
    angles = []
    for logit, offset in zip(logits, offsets, strict=True):
        chosen = logit.argmax(1)
        angles.append((chosen + offset.gather(1, chosen[:, None])[:, 0]) * BIN)
    return torch.stack(angles, dim=1).clamp(0, 360)


def euler_to_rotation(angles: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Convert viewpoint angles to rotations from the canonical frame to the camera (OpenCV axes).

    Azimuth and in-plane rotation are in [0, 360), the elevation in [0, 180] degrees. The rotation to an OpenGL camera
    is Rz(in-plane - 180) Rx(elevation - 180) Rz(azimuth).
    """
    zxz = (np.asarray(angles, np.float64) - (0, 180, 180))[..., ::-1]
    rotation = Rotation.from_euler("ZXZ", zxz.reshape(-1, 3), degrees=True).as_matrix()
    return _AXES @ rotation.reshape(*zxz.shape, 3)


def square_crop(frame: Frame, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """Restore the aspect ratio of an object crop, and pad it with black to a square of `size` pixels.

    The aspect ratio follows from the camera of the crop, because the pixels of the photograph are square.
    """
    x, y = frame.camera.focal_length * (1 / frame.camera.size[1], 1 / frame.camera.size[0])
    aspect = y / x  # width : height
    width, height = (size, max(1, round(size / aspect))) if aspect > 1 else (max(1, round(size * aspect)), size)
    square = np.zeros((size, size, 3), np.uint8)
    top, left = (size - height) // 2, (size - width) // 2
    resized = cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA)
    square[top : top + height, left : left + width] = resized
    return square
