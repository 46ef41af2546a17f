"""PoseContrast: absolute viewpoints by a network trained on pose labels (Xiao et al. 2021), made relative (sec. 5.2).

A residual network describes the picture; from that a small head tells azimuth, elevation and in-plane rotation, each
as one of a number of bins and an offset inside the bin. "posecontrast-tiny" is a small counterpart that this
project trained on the pose labels of its training categories.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from zsp_lite.backbones.backbone import prepare_images
from zsp_lite.backbones.checkpoints import read_checkpoint
from zsp_lite.baselines.resnet import TINY, ResNet, Shape, load_weights
from zsp_lite.baselines.swav import normalised
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder

FILE = "posecontrast.pth"  # in the cache folder; nobody hosts it under a fixed address
TINY_WEIGHTS = Path(__file__).parents[1] / "weights" / "posecontrast-tiny.safetensors"
BIN = 15.0  # degrees
BINS = (24, 12, 24)  # of azimuth, elevation and in-plane rotation
ANGLES = ("azi", "ele", "inp")
# Its cameras look along -z with y up (OpenGL), ours along z with y down.
_AXES = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """rotation: from the category's canonical frame to the camera (ours).  feature: what the picture is like."""

    rotation: Float[np.ndarray, "3 3"]
    feature: Float[Tensor, " d"]


class ViewpointHead(nn.Module):
    """Feature to logits over the bins of each angle, and an offset inside each bin, as a fraction of it."""

    def __init__(self, entering: int, width: int = 200):
        super().__init__()
        layers: list[nn.Module] = []
        for leaving in (4 * width, 2 * width, width):
            layers += [nn.Linear(entering, leaving), nn.BatchNorm1d(leaving), nn.ReLU(inplace=True)]
            entering = leaving
        self.compress = nn.Sequential(*layers)
        for kind in ("cls", "reg"):
            for angle, bins in zip(ANGLES, BINS, strict=True):
                setattr(self, f"fc_{kind}_{angle}", nn.Linear(width, bins))

    def forward(self, feature: Float[Tensor, "b d"]) -> tuple[list[Tensor], list[Tensor]]:
        """Logits and offsets, each of azimuth, elevation and in-plane rotation: (b, bins)."""
        x = self.compress(feature)
        logits, offsets = ([getattr(self, f"fc_{kind}_{angle}")(x) for angle in ANGLES] for kind in ("cls", "reg"))
        return logits, offsets


class PoseContrast:
    """Called on frames (`describe`): one Viewpoint each."""

    def __init__(self, network: ResNet, head: ViewpointHead, name: str, image_size: int = 224):
        self.network, self.head = network.eval().requires_grad_(False), head.eval().requires_grad_(False)
        self.name, self.image_size = name, image_size
        self.device = torch.device("cpu")

    def state_dict(self) -> dict[str, Tensor]:
        """The weights, which tell one PoseContrast from another."""
        return self.network.state_dict() | self.head.state_dict(prefix="head.")

    def describe(self, frames: Sequence[Frame]) -> list[Viewpoint]:
        """Viewpoints of object crops."""
        found = []
        for frame in frames:
            batch = normalised(prepare_images([padded(frame, self.image_size)], self.image_size))
            with torch.inference_mode():
                feature = self.network(batch)
                angles = predicted_angles(*self.head(feature))[0]
            found.append(Viewpoint(euler_to_rotation(angles.numpy()), feature[0].clone()))
        return found


def load_posecontrast(path: str | Path | None = None) -> PoseContrast:
    """The published network from its checkpoint: {"net_feat": ResNet-50 with 128 outputs, "net_vp": the head, ...}.

    path: default `posecontrast.pth` in the cache folder. Raises InputError where it is not there or of another layout.
    """
    path = Path(path) if path is not None else cache_folder() / FILE
    if not path.is_file():
        raise InputError(f"posecontrast: no checkpoint at {path}; put the authors' there, or use posecontrast-tiny")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler stumbles over
        raise InputError(f"posecontrast {path}: damaged, or not of tensors alone") from error
    parts = [content.get(part) if isinstance(content, dict) else None for part in ("net_feat", "net_vp")]
    if not all(isinstance(part, dict) for part in parts):
        raise InputError(f"posecontrast {path}: expected a dict with net_feat and net_vp")
    network, head = ResNet(Shape(outputs=128)), ViewpointHead(Shape().channels[-1])
    for module, weights in zip((network, head), parts, strict=True):
        weights = {key.removeprefix("module."): value for key, value in weights.items()}
        load_weights(module, weights, f"posecontrast {path}")
    return PoseContrast(network, head, "posecontrast")


def load_posecontrast_tiny(path: str | Path = TINY_WEIGHTS) -> PoseContrast:
    """This project's small counterpart. Raises InputError where its weights are not there."""
    if not Path(path).is_file():
        raise InputError(
            f"posecontrast-tiny: {Path(path).name} is not there; `zsp-lite train-baseline posecontrast-tiny` makes it"
        )
    weights, _ = read_checkpoint(path)
    parts = TinyParts()
    load_weights(parts, weights, f"posecontrast-tiny {path}")
    return PoseContrast(parts.network, parts.estimator, "posecontrast-tiny", TINY_SIZE)


TINY_SIZE = 64


class TinyParts(nn.Module):
    """The small network and its head: what the trainer trains and the file holds."""

    def __init__(self):
        super().__init__()
        self.network, self.estimator = ResNet(TINY), ViewpointHead(TINY.channels[-1], 64)


def predicted_angles(logits: Sequence[Tensor], offsets: Sequence[Tensor]) -> Float[Tensor, "b 3"]:
    """Degrees of the likeliest bins and their offsets, as the labels count them: all from 0."""
    angles = []
    for logit, offset in zip(logits, offsets, strict=True):
        chosen = logit.argmax(1)
        angles.append((chosen + offset.gather(1, chosen[:, None])[:, 0]) * BIN)
    return torch.stack(angles, dim=1).clamp(0, 360)


def euler_to_rotation(angles: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Canonical frame to camera (ours) from azimuth, elevation and in-plane rotation in degrees, all counted from 0.

    Rz(in-plane - 180) Rx(elevation - 180) Rz(azimuth) towards a camera that looks along -z.
    """
    radians = np.radians(np.asarray(angles, np.float64) - (0, 180, 180))
    azimuth, elevation, in_plane = (np.asarray(angle) for angle in np.moveaxis(radians, -1, 0))
    return _AXES @ _turn(in_plane, 2) @ _turn(elevation, 0) @ _turn(azimuth, 2)


def rotation_to_euler(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """The inverse of `euler_to_rotation`: azimuth and in-plane rotation in [0, 360), elevation in [0, 180]."""
    turned = _AXES @ np.asarray(rotation, np.float64)
    # Seen straight from above or below, azimuth and in-plane rotation are one: all of it is given to the azimuth.
    pole = np.hypot(turned[..., 2, 0], turned[..., 2, 1]) < 1e-9
    in_plane = np.where(pole, 0.0, np.arctan2(-turned[..., 0, 2], turned[..., 1, 2]))
    azimuth = np.where(
        pole,
        np.arctan2(-turned[..., 0, 1], turned[..., 0, 0]),
        np.arctan2(-turned[..., 2, 0], -turned[..., 2, 1]),
    )
    elevation = -np.arccos(turned[..., 2, 2].clip(-1, 1))
    degrees = np.degrees(np.stack([azimuth, elevation, in_plane], axis=-1)) + (0, 180, 180)
    return np.stack([degrees[..., 0] % 360, degrees[..., 1], degrees[..., 2] % 360], axis=-1)


def padded(frame: Frame, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """An object crop in its own aspect again, with black beside or above and below it to make a square.

    The crop's camera tells its aspect: a photograph's pixels were square before the crop was squeezed.
    """
    x, y = frame.camera.focal_length * (1 / frame.camera.size[1], 1 / frame.camera.size[0])
    return pad_to_square(frame.rgb, y / x, size)


def pad_to_square(rgb: UInt8[np.ndarray, "h w 3"], aspect: float, size: int) -> UInt8[np.ndarray, "s s 3"]:
    """A picture of width : height `aspect` in the middle of a black square."""
    width, height = (size, max(1, round(size / aspect))) if aspect > 1 else (max(1, round(size * aspect)), size)
    square = np.zeros((size, size, 3), np.uint8)
    top, left = (size - height) // 2, (size - width) // 2
    square[top : top + height, left : left + width] = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    return square


def _turn(angle: Float[np.ndarray, "*batch"], axis: int) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation about a coordinate axis."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., axis, axis] = 1
    matrix[..., first, first] = matrix[..., second, second] = np.cos(angle)
    matrix[..., second, first], matrix[..., first, second] = np.sin(angle), -np.sin(angle)
    return matrix
