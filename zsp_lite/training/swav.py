"""Trains "swav-tiny": crops of one picture agree on a prototype, prototypes are used evenly (Caron et al. 2020).

No label goes in. Every picture is cut into two large and two small crops; each large crop is assigned to prototypes by
a few Sinkhorn steps over the batch, and every other crop of that picture learns to predict the assignment.
"""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from safetensors.torch import save_file
from torch import Tensor, nn

from zsp_lite.backbones.backbone import normalize
from zsp_lite.baselines.resnet import TINY, ResNet
from zsp_lite.errors import InputError
from zsp_lite.matchers import sinkhorn
from zsp_lite.synthetic.training_categories import TRAINING
from zsp_lite.training.batches import MEAN, STD
from zsp_lite.training.batches import _crop_grids as crop_grids
from zsp_lite.training.batches import _recolour as recolour
from zsp_lite.training.object_crops import object_crops


@dataclass(frozen=True)
class SwavConfig:
    """What decides the result. Sides are pixels, scales the crops' width as a fraction (low, high) of the picture's."""

    seed: int = 0
    objects: int = 1500
    steps: int = 700
    batch: int = 48
    prototypes: int = 32  # SwAV has 3,000, for a thousand kinds of object
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
    """The network that is kept, and the projection and prototypes that are not."""

    def __init__(self, prototypes: int, hidden: int = 256, bottleneck: int = 64):
        super().__init__()
        self.backbone = ResNet(TINY)
        dim = TINY.channels[-1]
        self.projection = nn.Sequential(
            nn.Linear(dim, hidden),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            nn.Linear(hidden, bottleneck),
            nn.BatchNorm1d(bottleneck, affine=False),  # or else all pictures look alike for long
        )
        self.prototypes = nn.Parameter(torch.randn(prototypes, bottleneck))

    def forward(self, images: Float[Tensor, "b 3 s s"]) -> Float[Tensor, "b k"]:
        """Cosines of the pictures' projections with the prototypes."""
        projected = F.normalize(self.projection(self.backbone(images)), dim=1)
        return F.linear(projected, F.normalize(self.prototypes, dim=1))


def swapped_prediction(
    scores: Float[Tensor, "crops b k"], temperature: float, regularisation: float
) -> tuple[Float[Tensor, ""], float]:
    """The loss, and how evenly prototypes are used: the entropy of the mean assignment over its largest value.

    The first two crops are the large ones, which are assigned; every crop predicts the assignments of the others.
    """
    with torch.no_grad():
        # Columns are scaled last: each picture's assignment sums to one.
        assigned = torch.stack(
            [sinkhorn(-score.T.float(), regularisation, 3).T * len(score) for score in scores[:2]]
        ).to(scores.dtype)
    predicted = (scores / temperature).log_softmax(-1)
    cross = -torch.einsum("abk,cbk->ac", assigned, predicted) / scores.shape[1]
    other = ~torch.eye(*cross.shape, dtype=torch.bool)
    mean = assigned.mean((0, 1))
    return cross[other].mean(), float(-torch.xlogy(mean, mean).sum() / math.log(len(mean)) if len(mean) > 1 else 1.0)


def train(
    config: SwavConfig,
    folder: str | Path,
    log: Callable[[str], None] = print,
    progress=lambda iterable, total: iterable,
) -> Path:
    """Render, train, and export `folder`/swav-tiny.safetensors, with its configuration and log beside it."""
    folder = Path(folder)
    crops = object_crops(folder / "crops", config.objects, config.seed, progress=progress)
    note_config(config, folder / "swav-tiny.json")
    torch.manual_seed(config.seed)
    model = Network(config.prototypes)
    optimiser = torch.optim.AdamW(model.parameters(), config.learning_rate, weight_decay=config.weight_decay)
    with (folder / "swav-tiny.jsonl").open("w") as file:
        for step in range(config.steps):
            rng = np.random.default_rng([config.seed, 5, step])
            pictures = torch.from_numpy(crops.rgb[rng.integers(len(crops), size=config.batch)])
            scores = torch.cat([
                model(cut).unflatten(0, (2, config.batch))
                for cut in multi_crop(pictures.permute(0, 3, 1, 2).float() / 255, rng, config)
            ])  # fmt: skip
            loss, evenness = swapped_prediction(scores, config.temperature, config.regularisation)
            optimiser.zero_grad()
            loss.backward()
            if step < config.steps // 20:  # SwAV holds the prototypes for the first epoch
                model.prototypes.grad = None
            for group in optimiser.param_groups:
                warm = min(1.0, (step + 1) / 20)
                group["lr"] = config.learning_rate * warm * 0.5 * (1 + math.cos(math.pi * step / config.steps))
            optimiser.step()
            if (step + 1) % 20 == 0 or step + 1 == config.steps:
                row = {"step": step + 1, "loss": round(loss.item(), 4), "evenness": round(evenness, 4)}
                file.write(json.dumps(row) + "\n")
                file.flush()
                log("  ".join(f"{name} {value}" for name, value in row.items()))
    return export(model.backbone, folder / "swav-tiny.safetensors")


def note_config(config: Any, path: Path) -> None:
    """Write down what decides a training's result, and whose pictures it sees."""
    path.write_text(json.dumps(asdict(config) | {"categories": list(TRAINING)}, indent=1) + "\n")


def export(module: nn.Module, path: Path) -> Path:
    """Write a network's weights in half precision; what batch norms measured stays in single, for it has any range."""
    weights = {}
    for name, value in module.state_dict().items():
        if not name.endswith("num_batches_tracked"):
            weights[name] = (value if "running_" in name else value.half()).contiguous()
    save_file(weights, path, metadata={"name": path.stem})
    path.chmod(0o644)  # safetensors makes files that only their owner reads
    return path


def multi_crop(
    pictures: Float[Tensor, "b 3 s s"], rng: np.random.Generator, config: SwavConfig
) -> list[Float[Tensor, "n 3 _ _"]]:
    """Two large, then two small crops of every picture, each coloured for itself, ready for the network."""
    found = []
    for side, scale in ((config.large, config.large_scale), (config.small, config.small_scale)):
        grid, _ = crop_grids(rng, 2 * len(pictures), 1, side, scale)
        cut = F.grid_sample(pictures.repeat(2, 1, 1, 1), grid, padding_mode="reflection", align_corners=False)
        found.append(normalize(recolour(rng, cut) * STD + MEAN))
    return found
