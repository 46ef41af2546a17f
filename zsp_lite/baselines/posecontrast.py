"""PoseContrast: absolute viewpoints by a network trained on pose labels (Xiao et al. 2021; paper sec. 5.2).

A ResNet-50 computes a feature of the image. A small head predicts azimuth, elevation and in-plane rotation, each as a
bin and an offset inside the bin.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from zsp_lite.backbones.backbone import normalize, prepare_images
from zsp_lite.backbones.checkpoints import load_weights
from zsp_lite.baselines.resnet import ResNet50, checkpoint_path
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.tensors import load_torch

URL = "https://github.com/YoungXIAO13/PoseContrast"  # the authors' repository links the checkpoint
IMAGE_SIZE = 224
_BIN = 15.0  # degrees
_BINS = {"azi": 24, "ele": 12, "inp": 24}  # numbers of bins of azimuth, elevation and in-plane rotation
_WIDTHS = (2048, 800, 400, 200)  # of the network's feature and of the head's layers
# PoseContrast's cameras look along -z with +y up (OpenGL), ours along +z with +y down.
_AXES = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Rotation from the canonical frame of the category to the camera (OpenCV axes), and a feature of the image."""

    rotation: Float[np.ndarray, "3 3"]
    feature: Float[Tensor, " d"]


class ViewpointHead(nn.Module):
    """Classifier of the bins of each angle, and regression of the offset inside each bin as a fraction of its width."""

    def __init__(self):
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(_WIDTHS):
            layers += [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU(inplace=True)]
        self.compress = nn.Sequential(*layers)
        for kind in ("cls", "reg"):
            for angle, bins in _BINS.items():
                setattr(self, f"fc_{kind}_{angle}", nn.Linear(_WIDTHS[-1], bins))
        self.eval().requires_grad_(False)

    def forward(self, feature: Float[Tensor, "b d"]) -> Float[Tensor, "b 3"]:
        """Compute azimuth, elevation and in-plane rotation in degrees: the most probable bin and its offset."""
        x = self.compress(feature)
        angles = []
        for angle in _BINS:
            chosen = getattr(self, f"fc_cls_{angle}")(x).argmax(1)
            offset = getattr(self, f"fc_reg_{angle}")(x).gather(1, chosen[:, None])[:, 0]
            angles.append((chosen + offset) * _BIN)
        return torch.stack(angles, dim=1).clamp(0, 360)


class PoseContrast:
    """Estimator of absolute viewpoints."""

    name = "posecontrast"

    def __init__(self, network: ResNet50, head: ViewpointHead):
        self.network, self.head = network, head

    def state_dict(self) -> dict[str, Tensor]:
        """Return the weights, which identify the estimator in the benchmark."""
        return self.network.state_dict() | self.head.state_dict(prefix="head.")

    def describe(self, frames: Sequence[Frame]) -> list[Viewpoint]:
        """Estimate the viewpoints of object crops."""
        viewpoints = []
        for frame in frames:
            with torch.inference_mode():
                layers = self.network(normalize(prepare_images([square_crop(frame)], IMAGE_SIZE)))
                feature = layers[-1].mean((2, 3))
                angles = self.head(feature)[0].numpy()
            viewpoints.append(Viewpoint(euler_to_rotation(angles), feature[0].clone()))
        return viewpoints


def load_posecontrast() -> PoseContrast:
    """Load the published network, {"net_feat": ..., "net_vp": ...}, from $ZSP_LITE_POSECONTRAST or the cache folder."""
    path = checkpoint_path(URL, "ZSP_LITE_POSECONTRAST", "posecontrast.pth")
    content = load_torch(path, "posecontrast")
    network, head = ResNet50(), ViewpointHead()
    for part, module in (("net_feat", network), ("net_vp", head)):
        weights = content.get(part) if isinstance(content, dict) else None
        if not isinstance(weights, dict):
            raise InputError(f"posecontrast {path}: expected a dict with net_feat and net_vp")
        weights = {str(key).removeprefix("module."): value for key, value in weights.items()}
        load_weights(module, weights, f"posecontrast {path}", ignored=("fc.",))
    return PoseContrast(network, head)


def euler_to_rotation(angles: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Convert azimuth, elevation and in-plane rotation to the rotation from the canonical frame to the camera.

    The angles are in [0, 360), [0, 180] and [0, 360) degrees. The rotation to an OpenGL camera is Rz(in-plane - 180)
    Rx(elevation - 180) Rz(azimuth).
    """
    zxz = (np.asarray(angles, np.float64) - (0, 180, 180))[::-1]
    return _AXES @ Rotation.from_euler("ZXZ", zxz, degrees=True).as_matrix()


def square_crop(frame: Frame) -> UInt8[np.ndarray, "s s 3"]:
    """Restore the aspect ratio of an object crop, and pad it with black to a square.

    The aspect ratio follows from the camera of the crop, because the pixels of the photograph are square.
    """
    size = IMAGE_SIZE
    x, y = frame.camera.focal_length * (1 / frame.camera.size[1], 1 / frame.camera.size[0])
    aspect = y / x  # width : height
    width, height = (size, max(1, round(size / aspect))) if aspect > 1 else (max(1, round(size * aspect)), size)
    square = np.zeros((size, size, 3), np.uint8)
    top, left = (size - height) // 2, (size - width) // 2
    resized = cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA)
    square[top : top + height, left : left + width] = resized
    return square
