"""Training of "swav-tiny" by swapped prediction of cluster assignments (SwAV; Caron et al. 2020).

No labels are used. Each image is cut into two large and two small crops. The large crops are assigned to prototypes
by a few Sinkhorn iterations over the batch, which keep the assignments balanced; every other crop of the image is
trained to predict the assignment.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.backbones.backbone import normalize
from zsp_lite.baselines.resnet import TINY, ResNet
from zsp_lite.errors import InputError
from zsp_lite.matchers import sinkhorn
from zsp_lite.synthetic.training_categories import TRAINING
from zsp_lite.training.batches import MEAN, STD, crop_grids, recolour
from zsp_lite.training.export import export_convolutional
from zsp_lite.training.loop import Task, claim_folder, cosine, run
from zsp_lite.training.object_crops import ObjectCrops, object_crops

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SwavConfig:
    """Everything that determines the result of a run.

    Attributes:
        seed: Seed of objects, crops and random weights.
        objects: Number of training objects.
        steps: Number of steps.
        batch: Images per step.
        prototypes: Number of prototypes. SwAV has 3,000 for the 1,000 classes of ImageNet.
        large, small: Sides of the crops in pixels.
        large_scale, small_scale: Smallest and largest width of the crops as a fraction of the image's.
        temperature: Temperature of the predictions.
        regularisation: Entropic regularisation of the Sinkhorn iterations.
        learning_rate: Largest learning rate.
        weight_decay: AdamW's.

    Raises:
        InputError: For numbers below 1, and batches of fewer than 2 images.
    """

    seed: int = 0
    objects: int = 1500
    steps: int = 700
    batch: int = 48
    prototypes: int = 32
    large: int = 64
    small: int = 32
    large_scale: tuple[float, float] = (0.4, 1.0)
    small_scale: tuple[float, float] = (0.2, 0.4)
    temperature: float = 0.1
    regularisation: float = 0.05
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4

    def __post_init__(self):
        if min(self.objects, self.steps, self.prototypes) < 1 or self.batch < 2:
            raise InputError(
                f"objects={self.objects}, steps={self.steps}, prototypes={self.prototypes}, batch={self.batch}; "
                "expected at least 1, 1, 1 and 2"
            )


class Network(nn.Module):
    """Residual network with a projection and prototypes. Only the residual network is exported."""

    def __init__(self, prototypes: int, hidden: int = 256, bottleneck: int = 64):
        super().__init__()
        self.backbone = ResNet(TINY)
        dim = TINY.channels[-1]
        self.projection = nn.Sequential(
            nn.Linear(dim, hidden),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            nn.Linear(hidden, bottleneck),
            nn.BatchNorm1d(bottleneck, affine=False),  # without it, projections of all images stay similar for long
        )
        self.prototypes = nn.Parameter(torch.randn(prototypes, bottleneck))

    def forward(self, images: Float[Tensor, "b 3 s s"]) -> Float[Tensor, "b k"]:
        """Return the cosine similarities of the images' projections to the k prototypes."""
        projected = F.normalize(self.projection(self.backbone(images)), dim=1)
        return F.linear(projected, F.normalize(self.prototypes, dim=1))


def swapped_prediction(
    scores: Float[Tensor, "crops b k"], temperature: float, regularisation: float
) -> tuple[Float[Tensor, ""], float]:
    """Compute the swapped-prediction loss.

    Args:
        scores: Cosine similarities of b images' crops to k prototypes; the first two crops are the large ones.
        temperature: Temperature of the predictions.
        regularisation: Entropic regularisation of the Sinkhorn iterations.

    Returns:
        The mean cross-entropy between the assignments of each large crop and the predictions of each other crop, and
        the entropy of the mean assignment divided by log k, which is 1 if all prototypes are used equally.
    """
    with torch.no_grad():
        # Each image's assignment sums to 1, because columns are normalised last.
        assigned = torch.stack(
            [sinkhorn(-score.T.float(), regularisation, 3).T * len(score) for score in scores[:2]]
        ).to(scores.dtype)
    predicted = (scores / temperature).log_softmax(-1)
    cross = -torch.einsum("abk,cbk->ac", assigned, predicted) / scores.shape[1]
    other = ~torch.eye(*cross.shape, dtype=torch.bool)
    mean = assigned.mean((0, 1))
    return cross[other].mean(), float(-torch.xlogy(mean, mean).sum() / math.log(len(mean)) if len(mean) > 1 else 1.0)


class SwavTraining(Task):
    """Training of a `Network` on crops."""

    def __init__(self, config: SwavConfig, crops: ObjectCrops):
        super().__init__()
        torch.manual_seed(config.seed)
        self.config, self.crops, self.steps = config, crops, config.steps
        self.network = Network(config.prototypes)
        parameters = self.network.parameters()
        self.optimizer = torch.optim.AdamW(parameters, config.learning_rate, weight_decay=config.weight_decay)

    def schedule(self, step: int) -> dict[str, float]:
        warm_up = min(1.0, (step + 1) / 20)
        self.set_learning_rate(self.config.learning_rate * warm_up * cosine((1.0, 0.0), step / self.steps))
        self.network.prototypes.requires_grad_(step >= self.steps // 20)  # SwAV fixes them in the first epoch
        return {}

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        config = self.config
        rng = np.random.default_rng([config.seed, 5, step])
        images = torch.from_numpy(self.crops.rgb[rng.integers(len(self.crops), size=config.batch)])
        crops = multi_crop(images.permute(0, 3, 1, 2).float() / 255, rng, config)
        scores = torch.cat([self.network(batch).unflatten(0, (2, config.batch)) for batch in crops])
        loss, evenness = swapped_prediction(scores, config.temperature, config.regularisation)
        return loss, {"loss": loss.item(), "evenness": evenness}


def train(config: SwavConfig, folder: str | Path, log: Callable[[str], None] = logger.info) -> Path:
    """Render the training set, train or resume, and export `folder`/swav-tiny.safetensors.

    Args:
        config: Configuration of the run.
        folder: Receives renders, config.json, log.jsonl and checkpoint.pt (see `loop.run`) and the weights.
        log: Called with each line of the log as readable text.

    Returns:
        Path of the exported weights.
    """
    folder = Path(folder)
    claim_folder(folder, asdict(config) | {"categories": list(TRAINING)})
    task = SwavTraining(config, object_crops(folder / "crops", config.objects, config.seed))
    run(task, folder, log, log_every=20)
    return export_convolutional(task.network.backbone, folder / "swav-tiny.safetensors")


def multi_crop(
    images: Float[Tensor, "b 3 s s"], rng: np.random.Generator, config: SwavConfig
) -> list[Float[Tensor, "n 3 _ _"]]:
    """Cut two large and two small crops out of each image, with independent colour changes.

    Returns:
        The large and the small crops, (2 b, 3, side, side) each, normalised for the network.
    """
    found = []
    for side, scale in ((config.large, config.large_scale), (config.small, config.small_scale)):
        grid, _ = crop_grids(rng, 2 * len(images), 1, side, scale)
        cut = F.grid_sample(images.repeat(2, 1, 1, 1), grid, padding_mode="reflection", align_corners=False)
        found.append(normalize(recolour(rng, cut) * STD + MEAN))
    return found
