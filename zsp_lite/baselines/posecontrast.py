"""PoseContrast: absolute viewpoints by a network trained on pose labels (Xiao et al. 2021; paper sec. 5.2).

A residual network computes a feature of the image. A small head predicts azimuth, elevation and in-plane rotation, each
as a bin and an offset inside the bin. "posecontrast-tiny" is a small network of this project, trained on the pose
labels of the training categories.
"""

import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from zsp_lite.backbones.backbone import normalize, prepare_images
from zsp_lite.backbones.checkpoints import load_weights, read_checkpoint
from zsp_lite.backbones.pretrained import check_shipped
from zsp_lite.baselines.resnet import TINY, ResNet, ResNetConfig
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder, pinned
from zsp_lite.io.tensors import load_torch

FILE = "posecontrast.pth"  # in the cache folder; there is no permanent URL
TINY_WEIGHTS = Path(__file__).parents[1] / "weights" / "posecontrast-tiny.safetensors"
TINY_SIZE = 64  # image size of posecontrast-tiny, pixels
BIN = 15.0  # degrees
BINS = (24, 12, 24)  # numbers of bins of azimuth, elevation and in-plane rotation
ANGLES = ("azi", "ele", "inp")
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

    def __init__(self, inputs: int, width: int = 200):
        super().__init__()
        layers: list[nn.Module] = []
        for outputs in (4 * width, 2 * width, width):
            layers += [nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU(inplace=True)]
            inputs = outputs
        self.compress = nn.Sequential(*layers)
        for kind in ("cls", "reg"):
            for angle, bins in zip(ANGLES, BINS, strict=True):
                setattr(self, f"fc_{kind}_{angle}", nn.Linear(width, bins))

    def forward(self, feature: Float[Tensor, "b d"]) -> tuple[list[Tensor], list[Tensor]]:
        """Compute the logits and the offsets (b, bins) of azimuth, elevation and in-plane rotation."""
        x = self.compress(feature)
        logits, offsets = ([getattr(self, f"fc_{kind}_{angle}")(x) for angle in ANGLES] for kind in ("cls", "reg"))
        return logits, offsets


class PoseContrast:
    """Estimator of absolute viewpoints."""

    def __init__(self, network: ResNet, head: ViewpointHead, name: str, image_size: int = 224):
        self.network, self.head = network.eval().requires_grad_(False), head.eval().requires_grad_(False)
        self.name, self.image_size = name, image_size
        self.device = torch.device("cpu")

    def state_dict(self) -> dict[str, Tensor]:
        """Return the weights, which identify the estimator in the benchmark's cache."""
        return self.network.state_dict() | self.head.state_dict(prefix="head.")

    def describe(self, frames: Sequence[Frame]) -> list[Viewpoint]:
        """Estimate the viewpoints of object crops."""
        viewpoints = []
        for frame in frames:
            batch = normalize(prepare_images([square_crop(frame, self.image_size)], self.image_size))
            with torch.inference_mode():
                feature = self.network(batch)
                angles = predict_angles(*self.head(feature))[0]
            viewpoints.append(Viewpoint(euler_to_rotation(angles.numpy()), feature[0].clone()))
        return viewpoints


def load_posecontrast(path: str | Path | None = None) -> PoseContrast:
    """Load the published network.

    Args:
        path: Checkpoint {"net_feat": ResNet-50 with 128 outputs, "net_vp": head, ...}; by default `posecontrast.pth` in
            the cache folder.

    Raises:
        InputError: The file is missing or damaged, has other keys or shapes, or is another one than at its first use.
    """
    released = path is None
    path = cache_folder() / FILE if path is None else Path(path)
    if not path.is_file():
        raise InputError(
            f"posecontrast: no checkpoint at {path}; copy the authors' file there, or use posecontrast-tiny"
        )
    config = ResNetConfig(outputs=128)
    network, head = ResNet(config), ViewpointHead(config.channels[-1])
    with pinned(path) if released else nullcontext():
        content = load_torch(path, "posecontrast")
        parts = [content.get(part) if isinstance(content, dict) else None for part in ("net_feat", "net_vp")]
        if not all(isinstance(part, dict) for part in parts):
            raise InputError(f"posecontrast {path}: expected a dict with net_feat and net_vp")
        for module, weights in zip((network, head), parts, strict=True):
            weights = {str(key).removeprefix("module."): value for key, value in weights.items()}
            load_weights(module, weights, f"posecontrast {path}")
    return PoseContrast(network, head, "posecontrast")


def load_posecontrast_tiny(path: str | Path = TINY_WEIGHTS) -> PoseContrast:
    """Load the small network of this project. Raises InputError if the file is missing or invalid."""
    if not Path(path).is_file():
        raise InputError(
            f"posecontrast-tiny: {Path(path).name} does not exist; `zsp-lite train-baseline posecontrast-tiny` creates "
            "it"
        )
    if path == TINY_WEIGHTS:
        check_shipped(path)
    weights, _ = read_checkpoint(path)
    model = TinyPoseContrast()
    load_weights(model, weights, f"posecontrast-tiny {path}")
    return PoseContrast(model.network, model.estimator, "posecontrast-tiny", TINY_SIZE)


class TinyPoseContrast(nn.Module):
    """Network and head of posecontrast-tiny, as one module for training and storage."""

    def __init__(self):
        super().__init__()
        self.network, self.estimator = ResNet(TINY), ViewpointHead(TINY.channels[-1], 64)


def predict_angles(logits: Sequence[Tensor], offsets: Sequence[Tensor]) -> Float[Tensor, "b 3"]:
    """Compute the angles of the most probable bins with their offsets.

    Args:
        logits: (b, bins) of azimuth, elevation and in-plane rotation.
        offsets: (b, bins) of the same.

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

    The rotation to an OpenGL camera is Rz(in-plane - 180) Rx(elevation - 180) Rz(azimuth).

    Args:
        angles: (..., 3) azimuth in [0, 360), elevation in [0, 180] and in-plane rotation in [0, 360), degrees.
    """
    zxz = (np.asarray(angles, np.float64) - (0, 180, 180))[..., ::-1]
    rotation = Rotation.from_euler("ZXZ", zxz.reshape(-1, 3), degrees=True).as_matrix()
    return _AXES @ rotation.reshape(*zxz.shape, 3)


def rotation_to_euler(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Convert rotations to viewpoint angles; the inverse of `euler_to_rotation`.

    At elevations 0 and 180, where only a combination of azimuth and in-plane rotation is defined, one of them is fixed.
    """
    rotation = _AXES @ np.asarray(rotation, np.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the gimbal lock described above
        zxz = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_euler("ZXZ", degrees=True)
    # SciPy's middle angle is in [0, 180], ours in [-180, 0]: the other two change by 180 degrees.
    in_plane, elevation, azimuth = zxz.T
    angles = np.stack([(azimuth + 180) % 360, 180 - elevation, in_plane % 360], axis=-1)
    angles[angles == 360] = 0  # the remainder of a tiny negative number
    return angles.reshape(rotation.shape[:-1])


def square_crop(frame: Frame, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """Restore the aspect ratio of an object crop, and pad it with black to a square of `size` pixels.

    The aspect ratio follows from the camera of the crop, because the pixels of the photograph are square.
    """
    x, y = frame.camera.focal_length * (1 / frame.camera.size[1], 1 / frame.camera.size[0])
    return pad_to_square(frame.rgb, y / x, size)


def pad_to_square(rgb: UInt8[np.ndarray, "h w 3"], aspect: float, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """Resize an image to the ratio width : height = `aspect` in the middle of a black square of `size` pixels."""
    width, height = (size, max(1, round(size / aspect))) if aspect > 1 else (max(1, round(size * aspect)), size)
    square = np.zeros((size, size, 3), np.uint8)
    top, left = (size - height) // 2, (size - width) // 2
    square[top : top + height, left : left + width] = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    return square
