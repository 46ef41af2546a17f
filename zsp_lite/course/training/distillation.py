"""Self-distillation of the backbone, DINO (Caron et al. 2021).

Only images are used: no labels, masks, depth or other views. Each image is cut into two global and
several local crops. Student and teacher map each crop to a distribution over M outputs, and the
student is trained to predict, from every crop, the teacher's distribution for the other global
crop. The teacher is an exponential average of the student.

Two trivial solutions have a small loss: the same output for every image, and a uniform
distribution. Centring of the teacher's logits prevents the first and favours the second;
sharpening, a low teacher temperature, does the opposite.
"""

import copy
import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.course.training.batches import crop_grids, recolour

# Ranges of the crops' widths, as a fraction of the image's.
GLOBAL_SCALE = (0.6, 1.0)
LOCAL_SCALE = (0.25, 0.6)
HIDDEN = 256  # width of the head's hidden layers
BOTTLENECK = 64  # width of its last hidden layer
STUDENT_TEMPERATURE = 0.1
CENTRE_MOMENTUM = 0.9  # decay per step of the average of the teacher's logits
TEACHER_MOMENTUM = 0.99, 1.0  # decay of the teacher's average at the first and the last step
WEIGHT_DECAY = 0.04, 0.4  # AdamW's, at the first and the last step
LEARNING_RATE_DECAY = 1.0, 0.01  # factors of the largest rate, at the first and the last step
# Share of the run in which the last layer is fixed; DINO fixes it in the first epoch.
FIXED_LAST_LAYER = 0.05
MAX_GRADIENT_NORM = 3.0  # gradients with a larger norm are scaled down to it
_CROPS = 3  # seeds the random crops with the run's seed and the step; any other number would do


@dataclass(frozen=True)
class DistillationConfig:
    """Everything that determines a run, except the images and the initial backbone."""

    seed: int = 0  # of crops and of the random head
    steps: int = 300
    images: int = 16  # per step
    local_crops: int = 4  # per image, at least 1, in addition to two global ones
    global_side: int = 96  # of the crops, pixels
    local_side: int = 48
    outputs: int = 512  # M; DINO has 65,536
    teacher_temperature: float = 0.04  # of the teacher's softmax
    learning_rate: float = 1e-3  # the largest
    centring: bool = True  # if false, the centre stays 0
    sharpening: bool = True  # if false, the teacher has the student's temperature


class Head(nn.Module):
    """Projection head: an MLP, then cosine similarities to M learned directions."""

    def __init__(self, dim: int, outputs: int):
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(dim, HIDDEN),
            nn.GELU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.GELU(),
            nn.Linear(HIDDEN, BOTTLENECK),
        )
        self.directions = nn.Parameter(torch.randn(outputs, BOTTLENECK))
        for linear in self.mlp[::2]:
            nn.init.trunc_normal_(linear.weight, std=0.02)  # as in DINO
            nn.init.zeros_(linear.bias)

    def forward(self, cls: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch outputs"]:
        # DINO's weight-normalised last layer with a fixed gain of 1: all logits are in [-1, 1].
        features = F.normalize(self.mlp(cls), dim=-1)
        return F.linear(features, F.normalize(self.directions, dim=-1))


class Network(nn.Module):
    """Backbone and head."""

    def __init__(self, backbone: VisionTransformer, outputs: int):
        super().__init__()
        self.backbone = backbone
        self.head = Head(backbone.embed_dim, outputs)

    def forward(
        self, images: Float[Tensor, "crops batch 3 side side"]
    ) -> Float[Tensor, "crops batch outputs"]:
        cls = self.backbone(images.flatten(0, 1))[:, 0]
        return self.head(cls).unflatten(0, images.shape[:2])


def multi_crop(
    images: UInt8[np.ndarray, "batch size size 3"],
    rng: np.random.Generator,
    config: DistillationConfig,
) -> tuple[Float[Tensor, "2 batch 3 g g"], Float[Tensor, "k batch 3 l l"]]:
    """Cut two global and k local crops out of each image; each crop is recoloured independently."""
    rgb = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255

    def crops(count: int, side: int, scale: tuple[float, float]) -> Tensor:
        grid, _ = crop_grids(rng, count * len(rgb), per_object=1, side=side, scale=scale)
        cut = F.grid_sample(
            rgb.repeat(count, 1, 1, 1), grid, padding_mode="reflection", align_corners=False
        )
        return recolour(rng, cut).unflatten(0, (count, len(rgb)))

    large = crops(2, config.global_side, GLOBAL_SCALE)
    return large, crops(config.local_crops, config.local_side, LOCAL_SCALE)


def distillation_loss(
    student: Float[Tensor, "crops batch outputs"],
    teacher: Float[Tensor, "2 batch outputs"],
    centre: Float[Tensor, " outputs"],
    student_temperature: float,
    teacher_temperature: float,
) -> tuple[Tensor, dict[str, float]]:
    """Compute the cross-entropy of the student with the teacher on other crops, eq. 3 of DINO.

    Args:
        student: logits of the student; the first two crops are the global ones.
        teacher: logits of the teacher for the global crops.
        centre: average of the teacher's logits, which is subtracted from them.
        student_temperature: divides the student's logits.
        teacher_temperature: divides the teacher's logits.

    Returns:
        The loss and these figures, all in nats:

        - "loss": the loss;
        - "teacher_entropy": mean entropy of the teacher's distributions;
        - "kl": mean divergence of the student's distributions from the teacher's;
        - "information": mutual information of output and image. It is 0 for both trivial solutions,
          and at most log(batch) if both crops of an image have the same distribution.
    """
    log_p = ((teacher.detach() - centre) / teacher_temperature).log_softmax(-1)
    p = log_p.exp()
    log_q = (student / student_temperature).log_softmax(-1)
    # The mean over the batch, for each global crop (rows) and each crop (columns).
    cross = -torch.einsum("gbk,cbk->gc", p, log_q) / p.shape[1]
    different = ~torch.eye(*cross.shape, dtype=torch.bool)
    loss = cross[different].mean()
    entropy = -(p * log_p).sum(-1).mean().item()
    # Mutual information: the entropy of the mean distribution minus the mean entropy.
    mean = p.mean((0, 1))
    information = -torch.xlogy(mean, mean).sum().item() - entropy
    return loss, {
        "loss": loss.item(),
        "teacher_entropy": entropy,
        "kl": loss.item() - entropy,
        "information": information,
    }


class Distillation:
    """A run of DINO on several views of each of n objects; its result is the teacher's backbone."""

    def __init__(
        self,
        config: DistillationConfig,
        backbone: VisionTransformer,
        rgb: UInt8[np.ndarray, "n views size size 3"],
    ):
        torch.manual_seed(config.seed)
        self.config = config
        self.rgb = rgb
        self.steps_done = 0
        self.student = Network(copy.deepcopy(backbone), config.outputs).requires_grad_(True)
        self.teacher = copy.deepcopy(self.student).requires_grad_(False)
        self.centre = torch.zeros(config.outputs)
        # Weights (matrices) decay; biases and the parameters of norms (vectors) do not.
        matrices = [p for p in self.student.parameters() if p.ndim > 1]
        vectors = [p for p in self.student.parameters() if p.ndim <= 1]
        groups = [{"params": matrices}, {"params": vectors, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate)

    def step(self) -> dict[str, float]:
        """Take one step and return its figures (see `distillation_loss`)."""
        # The schedules: learning rate, weight decay, and the last layer.
        config = self.config
        progress = self.steps_done / config.steps
        # The rate rises linearly in the first tenth of the run.
        warm_up = min(1.0, 10 * progress)
        rate = config.learning_rate * warm_up * cosine(LEARNING_RATE_DECAY, progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        matrices, _ = self.optimizer.param_groups
        matrices["weight_decay"] = cosine(WEIGHT_DECAY, progress)
        self.student.head.directions.requires_grad_(progress >= FIXED_LAST_LAYER)

        # The loss on the crops of random images; the teacher sees only the global ones.
        rng = np.random.default_rng([config.seed, _CROPS, self.steps_done])
        n_objects, n_views = self.rgb.shape[:2]
        objects = rng.integers(n_objects, size=config.images)
        views = rng.integers(n_views, size=config.images)
        large, small = multi_crop(self.rgb[objects, views], rng, config)
        with torch.no_grad():
            teacher = self.teacher(large)
        student = torch.cat([self.student(large), self.student(small)])
        temperature = config.teacher_temperature if config.sharpening else STUDENT_TEMPERATURE
        loss, figures = distillation_loss(
            student, teacher, self.centre, STUDENT_TEMPERATURE, temperature
        )

        # The student follows the gradient, the teacher and its centre follow slowly.
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.student.parameters(), MAX_GRADIENT_NORM)
        self.optimizer.step()

        with torch.no_grad():
            weight = 1 - cosine(TEACHER_MOMENTUM, progress)
            for slow, fast in zip(self.teacher.parameters(), self.student.parameters()):
                slow.lerp_(fast, weight)
        if config.centring:
            self.centre.lerp_(teacher.mean((0, 1)), 1 - CENTRE_MOMENTUM)  # eq. 4 of DINO
        self.steps_done += 1
        return figures


def cosine(ends: tuple[float, float], progress: float) -> float:
    """Interpolate from ends[0] to ends[1] along half a cosine, for progress from 0 to 1."""
    return ends[1] + (ends[0] - ends[1]) * 0.5 * (1 + math.cos(math.pi * progress))
