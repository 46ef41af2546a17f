"""The paper's baselines with published networks (sec. 5.2): SwAV as features, PoseContrast as absolute viewpoints.

Both are a ResNet-50 (He et al. 2016), written here because no CPU build of torchvision matches the pinned torch.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from zsp_lite.backbones.backbone import Image, normalize, prepare_images
from zsp_lite.backbones.checkpoints import load_weights, read_checkpoint
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.io.download import cache_folder
from zsp_lite.io.tensors import load_torch

SWAV_URL = "https://dl.fbaipublicfiles.com/deepcluster/swav_800ep_pretrain.pth.tar"
POSECONTRAST_URL = "https://github.com/YoungXIAO13/PoseContrast"  # the authors' repository links the checkpoint
_SIDE = 224  # of PoseContrast's images, pixels
_BIN = 15.0  # degrees
_BINS = {"azi": 24, "ele": 12, "inp": 24}  # numbers of bins of azimuth, elevation and in-plane rotation
# PoseContrast's cameras look along -z with +y up (OpenGL), ours along +z with +y down.
_AXES = np.diag([1.0, -1.0, -1.0])


class ResNet50(nn.Module):
    """Residual network with torchvision's parameter names, without the last linear layer."""

    def __init__(self):
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False), nn.BatchNorm2d(64)
        self.layer1 = _layer(64, 256, blocks=3, stride=1)
        self.layer2 = _layer(256, 512, blocks=4)
        self.layer3 = _layer(512, 1024, blocks=6)
        self.layer4 = _layer(1024, 2048, blocks=3)
        self.eval().requires_grad_(False)

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b _ _ _"], Float[Tensor, "b _ _ _"]]:
        """Return the outputs of the last two layers."""
        x = nn.functional.max_pool2d(torch.relu(self.bn1(self.conv1(images))), 3, stride=2, padding=1)
        third = self.layer3(self.layer2(self.layer1(x)))
        return third, self.layer4(third)


class _Block(nn.Module):
    """Three convolutions and a shortcut; the second convolution has the stride."""

    def __init__(self, inputs: int, outputs: int, stride: int):
        super().__init__()
        width = outputs // 4
        self.conv1, self.bn1 = nn.Conv2d(inputs, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
        self.downsample = nn.Sequential()
        if inputs != outputs:
            self.downsample.extend([nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)])

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.bn1(self.conv1(x)))
        y = torch.relu(self.bn2(self.conv2(y)))
        return torch.relu(self.bn3(self.conv3(y)) + self.downsample(x))


def _layer(inputs: int, outputs: int, blocks: int, stride: int = 2) -> nn.Sequential:
    return nn.Sequential(_Block(inputs, outputs, stride), *(_Block(outputs, outputs, 1) for _ in range(blocks - 1)))


class Swav:
    """SwAV (Caron et al. 2020), trained by self-supervision, as a feature extractor without saliency."""

    name = "swav"
    has_saliency = False
    image_size = 448

    def __init__(self, model: ResNet50):
        self.model, self.state_dict = model, model.state_dict  # the weights identify the extractor in the benchmark

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Extract the features of (H, W, 3) images, uint8 or float in [0, 1]."""
        maps = []
        for image in normalize(prepare_images(images, self.image_size)):
            third, last = self.model(image[None])
            keys = third[0].permute(1, 2, 0)  # (28, 28, 1024); the paper does not state the layer
            maps.append(FeatureMap(keys, torch.ones(keys.shape[:2]), last.mean((2, 3))[0]))
        return maps


def load_swav() -> Swav:
    """Load the published network from $ZSP_LITE_SWAV, or from the cache folder."""
    path, model = _checkpoint(SWAV_URL, "ZSP_LITE_SWAV", "swav_800ep_pretrain.pth.tar"), ResNet50()
    load_weights(model, read_checkpoint(path)[0], f"swav {path}", ignored=("projection_head.", "prototypes."))
    return Swav(model)


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Rotation from the canonical frame of the category to the camera (OpenCV axes), and a feature of the image."""

    rotation: Float[np.ndarray, "3 3"]
    feature: Float[Tensor, " d"]


class PoseContrast(nn.Module):
    """PoseContrast (Xiao et al. 2021), trained on pose labels; its parts have the names of the published checkpoint."""

    name = "posecontrast"

    def __init__(self):
        super().__init__()
        self.net_feat, layers = ResNet50(), []
        for inputs, outputs in pairwise((2048, 800, 400, 200)):
            layers += [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU()]
        heads = {f"fc_{kind}_{angle}": nn.Linear(200, bins) for angle, bins in _BINS.items() for kind in ("cls", "reg")}
        self.net_vp = nn.ModuleDict({"compress": nn.Sequential(*layers), **heads})
        self.eval().requires_grad_(False)

    def describe(self, frames: Sequence[Frame]) -> list[Viewpoint]:
        """Estimate the viewpoints of object crops: the most probable bin of each angle, and the offset in it."""
        viewpoints = []
        for frame in frames:
            _, last = self.net_feat(normalize(prepare_images([square_crop(frame)], _SIDE)))
            feature, angles = last.mean((2, 3)), []
            x = self.net_vp["compress"](feature)
            for angle in _BINS:
                chosen = int(self.net_vp[f"fc_cls_{angle}"](x).argmax())
                angles.append((chosen + self.net_vp[f"fc_reg_{angle}"](x)[0, chosen]) * _BIN)
            rotation = euler_to_rotation(torch.stack(angles).clamp(0, 360).numpy())
            viewpoints.append(Viewpoint(rotation, feature[0]))
        return viewpoints


def load_posecontrast() -> PoseContrast:
    """Load the published network from $ZSP_LITE_POSECONTRAST, or from the cache folder."""
    path, model = _checkpoint(POSECONTRAST_URL, "ZSP_LITE_POSECONTRAST", "posecontrast.pth"), PoseContrast()
    content, weights = load_torch(path, "posecontrast"), {}
    try:
        for part in ("net_feat", "net_vp"):
            weights |= {f"{part}.{key.removeprefix('module.')}": value for key, value in content[part].items()}
    except (AttributeError, KeyError, TypeError) as error:
        raise InputError(f"posecontrast {path}: expected the weights of net_feat and net_vp") from error
    load_weights(model, weights, f"posecontrast {path}", ignored=("net_feat.fc.",))
    return model


def euler_to_rotation(angles: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Convert azimuth, elevation and in-plane angle in degrees to the rotation from canonical frame to camera."""
    # To an OpenGL camera, it is Rz(in-plane - 180) Rx(elevation - 180) Rz(azimuth).
    zxz = (np.asarray(angles, np.float64) - (0, 180, 180))[::-1]
    return _AXES @ Rotation.from_euler("ZXZ", zxz, degrees=True).as_matrix()


def square_crop(frame: Frame) -> UInt8[np.ndarray, "s s 3"]:
    """Restore the aspect ratio of an object crop, and pad it with black to a square."""
    # Width and height at depth 1, which are those of the photograph, because its pixels are square.
    extent = frame.camera.size[::-1] / frame.camera.focal_length
    width, height = np.maximum(1, np.round(_SIDE * extent / extent.max())).astype(int).tolist()
    resized = cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA)
    top, left = (_SIDE - height) // 2, (_SIDE - width) // 2
    return cv2.copyMakeBorder(resized, top, _SIDE - height - top, left, _SIDE - width - left, cv2.BORDER_CONSTANT)


def _checkpoint(url: str, variable: str, name: str) -> Path:
    """Return the path of a checkpoint that is not part of this library: $VARIABLE, else `name` in the cache folder."""
    path = Path(os.environ.get(variable) or cache_folder() / name)
    if not path.is_file():
        raise InputError(f"checkpoint {path} is no file; download it from {url}, and set {variable} to its path")
    return path
