"""Trains "posecontrast-tiny": viewpoints of the training categories, by their pose labels (Xiao et al. 2021).

The loss is PoseContrast's: cross-entropy over the bins of the three angles, Huber on the offset inside the true bin,
and a contrastive term that pushes two pictures' features apart the more, the more their poses differ.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from zsp_lite.backbones.backbone import normalize
from zsp_lite.baselines.posecontrast import (
    BIN,
    BINS,
    TINY_SIZE,
    TinyPoseContrast,
    euler_to_rotation,
    pad_to_square,
    predict_angles,
    rotation_to_euler,
)
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy, median, rotation_error
from zsp_lite.training.batches import MEAN, STD
from zsp_lite.training.batches import _recolour as recolour
from zsp_lite.training.object_crops import VIEWS, ObjectCrops, object_crops
from zsp_lite.training.swav import export, note_config


@dataclass(frozen=True)
class PoseContrastConfig:
    """What decides the result.  tilt: degrees (standard deviation) by which pictures are turned in their plane."""

    seed: int = 0
    objects: int = 1500
    steps: int = 1500
    batch: int = 32
    learning_rate: float = 1e-3
    weight_decay: float = 5e-4
    contrast: float = 1.0
    temperature: float = 0.5
    tilt: float = 7.0

    def __post_init__(self):
        if min(self.objects, self.steps) < 1 or self.batch < 2:
            raise InputError(
                f"objects={self.objects}, steps={self.steps}, batch={self.batch}; expected at least 1, 1 and 2"
            )


def train(
    config: PoseContrastConfig,
    folder: str | Path,
    log: Callable[[str], None] = print,
    progress=lambda iterable, total: iterable,
) -> Path:
    """Render, train, and export `folder`/posecontrast-tiny.safetensors, with its configuration and log beside it.

    The last twelfth of the objects is never trained on: the log's held_out figures are theirs. Raises InputError for
    fewer than two objects.
    """
    if config.objects < 2:
        raise InputError("training has 1 object, expected at least 2: the last ones are held out")
    folder = Path(folder)
    crops = object_crops(folder / "crops", config.objects, config.seed, progress=progress)
    training, held_out = crops.split(max(1, len(crops) // VIEWS // 12) * VIEWS)
    note_config(config, folder / "posecontrast-tiny.json")
    torch.manual_seed(config.seed)
    model = TinyPoseContrast()
    optimiser = torch.optim.AdamW(model.parameters(), config.learning_rate, weight_decay=config.weight_decay)
    with (folder / "posecontrast-tiny.jsonl").open("w") as file:
        for step in range(config.steps):
            rng = np.random.default_rng([config.seed, 4, step])
            images, again, labels = sample(training, rng, config)
            model.train()
            features = model.network(torch.cat([images, again]))
            first, second = features.split(len(images))
            loss = viewpoint_loss(*model.estimator(first), labels)
            contrast = pose_contrast(first, second, labels, config.temperature)
            optimiser.zero_grad()
            (loss + config.contrast * contrast).backward()
            for group in optimiser.param_groups:
                warm = min(1.0, (step + 1) / 30)
                group["lr"] = config.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / config.steps))
            optimiser.step()
            if (step + 1) % 50 == 0 or step + 1 == config.steps:
                row = {"step": step + 1, "loss": round(loss.item(), 4), "contrast": round(contrast.item(), 4)}
                row |= held_out_errors(model, held_out)
                file.write(json.dumps(row) + "\n")
                file.flush()
                log("  ".join(f"{name} {value}" for name, value in row.items()))
    return export(model, folder / "posecontrast-tiny.safetensors")


def sample(
    crops: ObjectCrops, rng: np.random.Generator, config: PoseContrastConfig
) -> tuple[Float[Tensor, "b 3 s s"], Float[Tensor, "b 3 s s"], Float[Tensor, "b 3"]]:
    """Pictures, each in two colourings, turned a little in their plane, and their angles (degrees, counted from 0)."""
    index = rng.integers(len(crops), size=config.batch)
    images = _pictures(crops, index)
    tilt = np.radians(rng.normal(0, config.tilt, config.batch))
    c, s = np.cos(tilt), np.sin(tilt)
    # A turn of the camera about its axis by `tilt`: what the picture shows at x, it showed at the turned-back x.
    back = np.stack([np.stack([c, s, 0 * c], -1), np.stack([-s, c, 0 * c], -1)], -2)
    grid = F.affine_grid(torch.from_numpy(back.astype(np.float32)), list(images.shape), align_corners=False)
    images = F.grid_sample(images, grid, align_corners=False)
    turned = np.zeros((config.batch, 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = c
    turned[:, 1, 0], turned[:, 0, 1], turned[:, 2, 2] = s, -s, 1
    labels = torch.from_numpy(rotation_to_euler(turned @ crops.rotation[index]).astype(np.float32))
    first, second = (normalize(recolour(rng, images) * STD + MEAN) for _ in range(2))
    return first, second, labels


def viewpoint_loss(
    logits: Sequence[Float[Tensor, "b _"]], offsets: Sequence[Float[Tensor, "b _"]], labels: Float[Tensor, "b 3"]
) -> Float[Tensor, ""]:
    """Cross-entropy of the true bins, and Huber on five times the offset in them."""
    chosen = [(labels[:, i] / BIN).long().clamp(0, bins - 1) for i, bins in enumerate(BINS)]
    classes = sum(F.cross_entropy(logit, bin_) for logit, bin_ in zip(logits, chosen, strict=True))
    found = torch.stack(
        [offset.gather(1, bin_[:, None])[:, 0] for offset, bin_ in zip(offsets, chosen, strict=True)], 1
    )
    return classes + F.smooth_l1_loss(5 * found, 5 * (labels / BIN - torch.stack(chosen, 1)))


def pose_contrast(
    first: Float[Tensor, "b d"], second: Float[Tensor, "b d"], labels: Float[Tensor, "b 3"], temperature: float
) -> Float[Tensor, ""]:
    """Pose-aware contrastive loss: another picture counts as a negative by the angle between the poses, over 180."""
    first, second = F.normalize(first, dim=1), F.normalize(second, dim=1)
    rotation = euler_to_rotation(labels.numpy())
    apart = torch.from_numpy(rotation_error(rotation[:, None], rotation[None])).to(first.dtype) / 180
    positive = ((first * second).sum(1) / temperature).exp()
    negative = ((first @ first.T / temperature).exp() * apart).sum(1)
    return -(positive / (positive + negative)).log().mean()


@torch.no_grad()
def held_out_errors(model: TinyPoseContrast, crops: ObjectCrops, most: int = 400) -> dict[str, float]:
    """Median error (degrees) and Acc30 (%) of absolute poses of objects that no step has seen."""
    model.eval()
    index = np.arange(min(most, len(crops)))
    angles = predict_angles(*model.estimator(model.network(normalize(_pictures(crops, index)))))
    errors = rotation_error(euler_to_rotation(angles.numpy()), crops.rotation[index])
    return {"held_out_median": round(float(median(errors)), 1), "held_out_acc30": round(float(accuracy(errors, 30)), 1)}


def _pictures(crops: ObjectCrops, index: np.ndarray) -> Float[Tensor, "b 3 s s"]:
    squares = np.stack([pad_to_square(crops.rgb[i], float(crops.aspect[i]), TINY_SIZE) for i in index])
    return torch.from_numpy(squares).permute(0, 3, 1, 2).float() / 255
