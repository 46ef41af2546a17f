"""Training of "posecontrast-tiny" on pose labels of the training categories (PoseContrast; Xiao et al. 2021).

The loss is PoseContrast's: cross-entropy over the bins of the three angles, Huber loss of the offset within the true
bin, and a contrastive loss in which a pair of images is weighted by the angle between their poses.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
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
from zsp_lite.synthetic.training_categories import TRAINING
from zsp_lite.training.batches import MEAN, STD, recolour
from zsp_lite.training.export import export_convolutional
from zsp_lite.training.loop import Task, claim_folder, cosine, run
from zsp_lite.training.object_crops import VIEWS, ObjectCrops, object_crops

_EVALUATED = 400  # held-out images, at most

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class PoseContrastConfig:
    """Everything that determines the result of a run.

    Attributes:
        seed: Seed of objects, images and random weights.
        objects: Number of objects, of which the last twelfth is held out.
        steps: Number of steps.
        batch: Images per step.
        learning_rate: Largest learning rate.
        weight_decay: AdamW's.
        contrast: Weight of the contrastive loss.
        temperature: Temperature of the contrastive loss.
        tilt: Standard deviation in degrees of the random in-plane rotation of images.

    Raises:
        InputError: For fewer than 2 objects or images per step, or no step.
    """

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
        if self.steps < 1 or min(self.objects, self.batch) < 2:
            raise InputError(
                f"objects={self.objects}, steps={self.steps}, batch={self.batch}; expected at least 2, 1 and 2"
            )


class PoseContrastTraining(Task):
    """Training of `TinyPoseContrast` on crops; the last twelfth of the objects is held out."""

    def __init__(self, config: PoseContrastConfig, crops: ObjectCrops):
        super().__init__()
        torch.manual_seed(config.seed)
        self.config, self.steps = config, config.steps
        self.training_set, self.held_out = crops.split(max(1, len(crops) // VIEWS // 12) * VIEWS)
        self.model = TinyPoseContrast()
        parameters = self.model.parameters()
        self.optimizer = torch.optim.AdamW(parameters, config.learning_rate, weight_decay=config.weight_decay)

    def schedule(self, step: int) -> dict[str, float]:
        warm_up = min(1.0, (step + 1) / 30)
        self.set_learning_rate(self.config.learning_rate * warm_up * cosine((1.0, 0.0), step / self.steps))
        return {}

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        config = self.config
        images, again, labels = sample(self.training_set, np.random.default_rng([config.seed, 4, step]), config)
        self.model.train()
        features = self.model.network(torch.cat([images, again]))
        first, second = features.split(len(images))
        viewpoint = viewpoint_loss(*self.model.estimator(first), labels)
        contrast = pose_contrast(first, second, labels, config.temperature)
        return viewpoint + config.contrast * contrast, {"loss": viewpoint.item(), "contrast": contrast.item()}

    def evaluate(self) -> dict[str, float]:
        return held_out_errors(self.model, self.held_out)


def train(config: PoseContrastConfig, folder: str | Path, log: Callable[[str], None] = logger.info) -> Path:
    """Render the training set, train or resume, and export `folder`/posecontrast-tiny.safetensors.

    Args:
        config: Configuration of the run.
        folder: Receives renders, config.json, log.jsonl and checkpoint.pt (see `loop.run`) and the weights.
        log: Called with each line of the log as readable text.

    Returns:
        Path of the exported weights.
    """
    folder = Path(folder)
    claim_folder(folder, asdict(config) | {"categories": list(TRAINING)})
    task = PoseContrastTraining(config, object_crops(folder / "crops", config.objects, config.seed))
    run(task, folder, log, evaluate_every=50)
    return export_convolutional(task.model, folder / "posecontrast-tiny.safetensors")


def sample(
    crops: ObjectCrops, rng: np.random.Generator, config: PoseContrastConfig
) -> tuple[Float[Tensor, "b 3 s s"], Float[Tensor, "b 3 s s"], Float[Tensor, "b 3"]]:
    """Draw a batch of images with a random in-plane rotation.

    Returns:
        The images with two independent colour changes, normalised for the network, and their azimuth, elevation and
        in-plane rotation (see `euler_to_rotation`).
    """
    index = rng.integers(len(crops), size=config.batch)
    images = _square_images(crops, index)
    tilt = np.radians(rng.normal(0, config.tilt, config.batch))
    c, s = np.cos(tilt), np.sin(tilt)
    # The camera rotates about its axis by `tilt`: pixel x shows what was at the position x rotated back.
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
    """Return the cross-entropy of the true bins plus the Huber loss of five times the offset within them."""
    chosen = [(labels[:, i] / BIN).long().clamp(0, bins - 1) for i, bins in enumerate(BINS)]
    classes = sum(F.cross_entropy(logit, bin_) for logit, bin_ in zip(logits, chosen, strict=True))
    found = torch.stack(
        [offset.gather(1, bin_[:, None])[:, 0] for offset, bin_ in zip(offsets, chosen, strict=True)], 1
    )
    return classes + F.smooth_l1_loss(5 * found, 5 * (labels / BIN - torch.stack(chosen, 1)))


def pose_contrast(
    first: Float[Tensor, "b d"], second: Float[Tensor, "b d"], labels: Float[Tensor, "b 3"], temperature: float
) -> Float[Tensor, ""]:
    """Compute the pose-aware contrastive loss.

    With unit features f_i and f'_i of two versions of image i, the angle d_ij between the poses of images i and j
    in degrees, and temperature t, it is the mean over i of

        -log(p_i / (p_i + sum_j (d_ij / 180) exp(f_i . f_j / t))),  p_i = exp(f_i . f'_i / t).

    Args:
        first, second: Features of the two versions of b images.
        labels: Azimuth, elevation and in-plane rotation in degrees.
        temperature: Temperature t.
    """
    first, second = F.normalize(first, dim=1), F.normalize(second, dim=1)
    rotation = euler_to_rotation(labels.numpy())
    apart = torch.from_numpy(rotation_error(rotation[:, None], rotation[None])).to(first.dtype) / 180
    positive = ((first * second).sum(1) / temperature).exp()
    negative = ((first @ first.T / temperature).exp() * apart).sum(1)
    return -(positive / (positive + negative)).log().mean()


@torch.no_grad()
def held_out_errors(model: TinyPoseContrast, crops: ObjectCrops) -> dict[str, float]:
    """Return the median error in degrees and Acc30 in per cent of absolute poses, on at most 400 crops."""
    model.eval()
    index = np.arange(min(_EVALUATED, len(crops)))
    angles = predict_angles(*model.estimator(model.network(normalize(_square_images(crops, index)))))
    errors = rotation_error(euler_to_rotation(angles.numpy()), crops.rotation[index])
    return {"held_out_median": round(float(median(errors)), 1), "held_out_acc30": round(float(accuracy(errors, 30)), 1)}


def _square_images(crops: ObjectCrops, index: np.ndarray) -> Float[Tensor, "b 3 s s"]:
    squares = np.stack([pad_to_square(crops.rgb[i], float(crops.aspect[i]), TINY_SIZE) for i in index])
    return torch.from_numpy(squares).permute(0, 3, 1, 2).float() / 255
