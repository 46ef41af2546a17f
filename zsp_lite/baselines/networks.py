"""The paper's baselines with published networks (sec. 5.2): SwAV as features, PoseContrast as absolute viewpoints.

Both are a ResNet-50 (He et al. 2016): that of transformers, as no CPU build of torchvision matches the pinned torch.
"""

import os
import re
from collections.abc import Mapping, Sequence
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
from zsp_lite.io.files import load_torch

SWAV_URL = "https://dl.fbaipublicfiles.com/deepcluster/swav_800ep_pretrain.pth.tar"
POSECONTRAST_URL = "https://github.com/YoungXIAO13/PoseContrast"  # the authors' repository links the checkpoint
_SIDE = 224  # of PoseContrast's images, pixels
_BIN = 15.0  # degrees
_BINS = {"azi": 24, "ele": 12, "inp": 24}  # numbers of bins of azimuth, elevation and in-plane rotation


def resnet50() -> nn.Module:
    """Make a ResNet-50 without the last linear layer; a checkpoint replaces its weights."""
    try:
        from transformers import ResNetConfig, ResNetModel
    except ImportError as error:
        raise InputError("SwAV and PoseContrast need the package transformers: pip install transformers") from error
    return ResNetModel(ResNetConfig()).eval().requires_grad_(False)


def renamed(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename the weights of torchvision's ResNet-50, which the checkpoints have, to those of transformers."""
    found = {}
    for name, weight in weights.items():
        name = re.sub(r"^(conv|bn)1\.", r"embedder.embedder.\1.", name.removeprefix("module."))
        name = re.sub(r"^layer(\d)\.(\d)\.", lambda part: f"encoder.stages.{int(part[1]) - 1}.layers.{part[2]}.", name)
        name = re.sub(r"\.(conv|bn)(\d)\.", lambda part: f".layer.{int(part[2]) - 1}.{part[1]}.", name)
        name = name.replace(".downsample.0.", ".shortcut.conv.").replace(".downsample.1.", ".shortcut.bn.")
        found[name.replace(".conv.", ".convolution.").replace(".bn.", ".normalization.")] = weight
    return found


class Swav:
    """SwAV (Caron et al. 2020), trained by self-supervision, as a feature extractor without saliency."""

    name = "swav"
    has_saliency = False
    image_size = 448

    def __init__(self):
        """Load the published network from $ZSP_LITE_SWAV, or from the cache folder."""
        path, self.model = _checkpoint(SWAV_URL, "ZSP_LITE_SWAV", "swav_800ep_pretrain.pth.tar"), resnet50()
        weights, ignored = renamed(read_checkpoint(path)[0]), ("projection_head.", "prototypes.")
        load_weights(self.model, weights, f"swav {path}", ignored)
        self.state_dict = self.model.state_dict  # the weights identify the extractor in the benchmark

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Extract the features of (H, W, 3) images, uint8 or float in [0, 1]."""
        maps = []
        for image in normalize(prepare_images(images, self.image_size)):
            third, last = self.model(image[None], output_hidden_states=True).hidden_states[-2:]
            keys = third[0].permute(1, 2, 0)  # (28, 28, 1024); the paper does not state the layer
            maps.append(FeatureMap(keys, torch.ones(keys.shape[:2]), last.mean((2, 3))[0]))
        return maps


class PoseContrast(nn.Module):
    """PoseContrast (Xiao et al. 2021), trained on pose labels; its parts have the names of the published checkpoint."""

    name = "posecontrast"

    def __init__(self):
        """Load the published network from $ZSP_LITE_POSECONTRAST, or from the cache folder."""
        super().__init__()
        path = _checkpoint(POSECONTRAST_URL, "ZSP_LITE_POSECONTRAST", "posecontrast.pth")
        self.net_feat, layers = resnet50(), []
        for inputs, outputs in pairwise((2048, 800, 400, 200)):
            layers += [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU()]
        heads = {f"fc_{kind}_{angle}": nn.Linear(200, bins) for angle, bins in _BINS.items() for kind in ("cls", "reg")}
        self.net_vp = nn.ModuleDict({"compress": nn.Sequential(*layers), **heads})
        content, weights = load_torch(path, "posecontrast"), {}
        try:
            for part in ("net_feat", "net_vp"):
                weights |= {f"{part}.{key}": value for key, value in renamed(content[part]).items()}
        except (AttributeError, KeyError, TypeError) as error:
            raise InputError(f"posecontrast {path}: expected the weights of net_feat and net_vp") from error
        load_weights(self, weights, f"posecontrast {path}", ignored=("net_feat.fc.",))
        self.eval().requires_grad_(False)

    def describe(self, frames: Sequence[Frame]) -> list[tuple[Float[np.ndarray, "3 3"], Float[Tensor, " d"]]]:
        """Estimate the rotation from the category's canonical frame to the camera of each crop, and its feature."""
        found = []
        for frame in frames:
            last = self.net_feat(normalize(prepare_images([square_crop(frame)], _SIDE))).last_hidden_state
            feature, angles = last.mean((2, 3)), []
            x = self.net_vp["compress"](feature)
            for angle in _BINS:  # the most probable bin, and the offset in it
                chosen = int(self.net_vp[f"fc_cls_{angle}"](x).argmax())
                angles.append((chosen + self.net_vp[f"fc_reg_{angle}"](x)[0, chosen]) * _BIN)
            found.append((euler_to_rotation(torch.stack(angles).clamp(0, 360).numpy()), feature[0]))
        return found


def euler_to_rotation(angles: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Convert azimuth, elevation and in-plane angle in degrees to the rotation from canonical frame to camera."""
    # To an OpenGL camera, which looks along -z with +y up, it is Rz(in-plane - 180) Rx(elevation - 180) Rz(azimuth).
    zxz = (np.asarray(angles, np.float64) - (0, 180, 180))[::-1]
    return np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("ZXZ", zxz, degrees=True).as_matrix()


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
