"""PoseContrast: absolute viewpoints by a network trained on pose labels (Xiao et al. 2021; paper sec. 5.2)."""

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
    """Azimuth, elevation and in-plane rotation: a bin of each, and the offset in the bin as a fraction of its width."""

    def __init__(self):
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(_WIDTHS):
            layers += [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU(inplace=True)]
        self.compress = nn.Sequential(*layers)
        for angle, bins in _BINS.items():
            for kind in ("cls", "reg"):
                self.add_module(f"fc_{kind}_{angle}", nn.Linear(_WIDTHS[-1], bins))

    def forward(self, feature: Float[Tensor, "b d"]) -> Float[Tensor, "b 3"]:
        """Compute the three angles in degrees: the most probable bin and its offset."""
        x = self.compress(feature)
        angles = []
        for angle in _BINS:
            chosen = getattr(self, f"fc_cls_{angle}")(x).argmax(1)
            offset = getattr(self, f"fc_reg_{angle}")(x).gather(1, chosen[:, None])[:, 0]
            angles.append((chosen + offset) * _BIN)
        return torch.stack(angles, dim=1).clamp(0, 360)


class PoseContrast(nn.Module):
    """Estimator of absolute viewpoints; its parts have the names of the published checkpoint."""

    name = "posecontrast"

    def __init__(self):
        super().__init__()
        self.net_feat, self.net_vp = ResNet50(), ViewpointHead()
        self.eval().requires_grad_(False)

    def describe(self, frames: Sequence[Frame]) -> list[Viewpoint]:
        """Estimate the viewpoints of object crops."""
        viewpoints = []
        for frame in frames:
            feature = self.net_feat(normalize(prepare_images([square_crop(frame)], IMAGE_SIZE)))[-1].mean((2, 3))
            viewpoints.append(Viewpoint(euler_to_rotation(self.net_vp(feature)[0].numpy()), feature[0]))
        return viewpoints


def load_posecontrast() -> PoseContrast:
    """Load the published network from $ZSP_LITE_POSECONTRAST or the cache folder."""
    path, model = checkpoint_path(URL, "ZSP_LITE_POSECONTRAST", "posecontrast.pth"), PoseContrast()
    content = load_torch(path, "posecontrast")
    parts = {part: content.get(part) if isinstance(content, dict) else None for part in ("net_feat", "net_vp")}
    weights = {
        f"{part}.{str(key).removeprefix('module.')}": value
        for part, values in parts.items()
        for key, value in (values.items() if isinstance(values, dict) else ())
    }
    load_weights(model, weights, f"posecontrast {path}", ignored=("net_feat.fc.",))
    return model


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
    extent = frame.camera.size[::-1] / frame.camera.focal_length  # width and height at depth 1
    width, height = np.maximum(1, np.round(IMAGE_SIZE * extent / extent.max())).astype(int).tolist()
    square = np.zeros((IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
    top, left = (IMAGE_SIZE - height) // 2, (IMAGE_SIZE - width) // 2
    resized = cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA)
    square[top : top + height, left : left + width] = resized
    return square
