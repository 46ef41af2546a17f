"""Self-distillation of the backbone, DINO (Caron et al. 2021).

Only images are used: no labels, masks, depth or other views. Each image is cut into two global and several local
crops. Student and teacher map each crop to a distribution over K outputs, and the student is trained to predict, from
every crop, the teacher's distribution for the other global crop. The teacher is an exponential average of the student.

Two trivial solutions have a small loss: the same output for every image, and a uniform distribution. Centring of the
teacher's logits prevents the first and favours the second; sharpening, a low teacher temperature, does the opposite.
"""

import copy
import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from zsp_lite.backbones.precision import autocast, choose_precision
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError
from zsp_lite.training.batches import crop_grids, recolour
from zsp_lite.training.export import export_checkpoint
from zsp_lite.training.loop import Task, claim_folder, cosine, run
from zsp_lite.training.recipe import TrainingConfig
from zsp_lite.training.renders import training_and_held_out
from zsp_lite.training.train import held_out_accuracy
from zsp_lite.training.trainee import Trainee, as_trainee, initialise

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DistillationConfig:
    """Everything that determines the result of a run, except the images and the initial backbone.

    Attributes:
        seed: Seed of crops and of the random head.
        steps: Number of steps.
        images: Images per step.
        local_crops: Local crops per image, in addition to two global ones.
        global_side, local_side: Sides of the crops in pixels.
        global_scale, local_scale: Smallest and largest width of the crops as a fraction of the image's.
        outputs: Number K of outputs. DINO has 65,536.
        hidden, bottleneck: Widths of the head's layers.
        student_temperature, teacher_temperature: Temperatures of the softmax.
        centre_momentum: Decay per step of the average of the teacher's logits.
        teacher_momentum: Decay of the teacher's average at the first and the last step.
        learning_rate: Largest learning rate.
        weight_decay: AdamW's, at the first and the last step.
        centring: If false, the centre stays 0.
        sharpening: If false, the teacher has the student's temperature.

    Raises:
        InputError: For counts below 1 (local crops: below 0) and temperatures that are not positive.
    """

    seed: int = 0
    steps: int = 300
    images: int = 16
    local_crops: int = 4
    global_side: int = 96
    local_side: int = 48
    global_scale: tuple[float, float] = (0.6, 1.0)
    local_scale: tuple[float, float] = (0.25, 0.6)
    outputs: int = 512
    hidden: int = 256
    bottleneck: int = 64
    student_temperature: float = 0.1
    teacher_temperature: float = 0.04
    centre_momentum: float = 0.9
    teacher_momentum: tuple[float, float] = (0.99, 1.0)
    learning_rate: float = 1e-3
    weight_decay: tuple[float, float] = (0.04, 0.4)
    centring: bool = True
    sharpening: bool = True

    def __post_init__(self):
        counts = ("steps", "images", "global_side", "local_side", "outputs", "hidden", "bottleneck")
        for name in counts:
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.local_crops < 0:
            raise InputError(f"local_crops: expected at least 0, got {self.local_crops}")
        for name in ("student_temperature", "teacher_temperature"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name}: expected a positive number, got {getattr(self, name)}")


# Closer to DINO's own settings; takes hours on a CPU.
LONG_RUN = DistillationConfig(
    steps=7000, images=32, outputs=4096, hidden=1024, bottleneck=256, teacher_momentum=(0.996, 1.0), learning_rate=5e-4
)  # fmt: skip


class Head(nn.Module):
    """Projection head: an MLP, then cosine similarities to K learned directions.

    This is DINO's weight-normalised last layer with a fixed gain of 1, so that all logits are in [-1, 1].
    """

    def __init__(self, dim: int, hidden: int, bottleneck: int, outputs: int):
        super().__init__()
        first, middle, last = nn.Linear(dim, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, bottleneck)
        self.mlp = nn.Sequential(first, nn.GELU(), middle, nn.GELU(), last)
        self.directions = nn.Parameter(torch.randn(outputs, bottleneck))
        for module in (first, middle, last):
            nn.init.trunc_normal_(module.weight, std=0.02)
            nn.init.zeros_(module.bias)

    def forward(self, cls: Float[Tensor, "batch dim"]) -> Float[Tensor, "batch outputs"]:
        return F.linear(F.normalize(self.mlp(cls), dim=-1), F.normalize(self.directions, dim=-1))


class Network(nn.Module):
    """Backbone and head. Only the backbone is exported."""

    def __init__(self, backbone: VisionTransformer, config: DistillationConfig):
        super().__init__()
        self.backbone = backbone
        self.head = Head(backbone.embed_dim, config.hidden, config.bottleneck, config.outputs)

    def forward(self, images: Float[Tensor, "batch 3 side side"]) -> Float[Tensor, "batch outputs"]:
        return self.head(self.backbone.extract(images, 0).cls)


def multi_crop(
    images: UInt8[np.ndarray, "batch size size 3"], rng: np.random.Generator, config: DistillationConfig
) -> tuple[Float[Tensor, "2 batch 3 g g"], Float[Tensor, "k batch 3 l l"]]:
    """Cut two global and k local crops out of each image, each rotated, mirrored and recoloured independently."""
    rgb = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255

    def crops(count: int, side: int, scale: tuple[float, float]) -> Tensor:
        grid, _ = crop_grids(rng, count * len(rgb), 1, side, scale)
        cut = F.grid_sample(rgb.repeat(count, 1, 1, 1), grid, padding_mode="reflection", align_corners=False)
        return recolour(rng, cut).unflatten(0, (count, len(rgb)))

    large = crops(2, config.global_side, config.global_scale)
    if config.local_crops == 0:
        return large, large.new_empty(0, len(rgb), 3, config.local_side, config.local_side)
    return large, crops(config.local_crops, config.local_side, config.local_scale)


def distillation_loss(
    student: Float[Tensor, "crops batch outputs"],
    teacher: Float[Tensor, "2 batch outputs"],
    centre: Float[Tensor, " outputs"],
    student_temperature: float,
    teacher_temperature: float,
) -> tuple[Tensor, dict[str, float]]:
    """Compute the cross-entropy between the teacher's and the student's distributions of different crops (eq. 3).

    Args:
        student: Logits of all crops; the first two are the global ones.
        teacher: Logits of the global crops.
        centre: Average of the teacher's logits, which is subtracted.
        student_temperature, teacher_temperature: Temperatures of the softmax.

    Returns:
        The loss, and figures in nats: "loss"; "teacher_entropy", mean entropy of the teacher's distributions; "kl",
        divergence of the student's distributions from them (loss = teacher_entropy + kl); "information", entropy of the
        teacher's mean distribution minus teacher_entropy, which is the mutual information of output and image: 0 for
        both trivial solutions, at most log(batch) if both crops of an image have the same distribution.
    """
    log_p = ((teacher.detach() - centre) / teacher_temperature).log_softmax(-1)
    p = log_p.exp()
    log_q = (student / student_temperature).log_softmax(-1)
    cross = -torch.einsum("gbk,cbk->gc", p, log_q) / p.shape[1]
    other = ~torch.eye(*cross.shape, dtype=torch.bool, device=cross.device)
    loss = cross[other].mean()
    entropy = -(p * log_p).sum(-1).mean().item()
    mean = p.mean((0, 1))
    information = -torch.xlogy(mean, mean).sum().item() - entropy
    return loss, dict(loss=loss.item(), teacher_entropy=entropy, kl=loss.item() - entropy, information=information)


class Distillation(Task):
    """A run of DINO; the teacher's backbone is its result.

    Args:
        config: Configuration.
        backbone: Initial backbone; it is copied.
        rgb: Images, several views of each of n objects.
        measure: Computes figures of the teacher's backbone for the log.
    """

    max_gradient_norm = 3.0

    def __init__(
        self,
        config: DistillationConfig,
        backbone: VisionTransformer,
        rgb: UInt8[np.ndarray, "n views size size 3"],
        measure: Callable[[VisionTransformer], dict[str, float]] = lambda backbone: {},
    ):
        super().__init__()
        torch.manual_seed(config.seed)
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.precision = choose_precision(device.type)
        self.config, self.rgb, self.measure, self.steps = config, rgb, measure, config.steps
        self.student = Network(copy.deepcopy(backbone), config).to(device).requires_grad_(True)
        self.teacher = copy.deepcopy(self.student).requires_grad_(False)
        self.register_buffer("centre", torch.zeros(config.outputs, device=device))
        matrices = [p for p in self.student.parameters() if p.ndim > 1]
        vectors = [p for p in self.student.parameters() if p.ndim <= 1]  # biases and norms: no weight decay
        groups = [{"params": matrices}, {"params": vectors, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate)

    def schedule(self, step: int) -> dict[str, float]:
        progress = step / self.steps
        self.set_learning_rate(self.config.learning_rate * min(1.0, 10 * progress) * cosine((1.0, 0.01), progress))
        self.optimizer.param_groups[0]["weight_decay"] = cosine(self.config.weight_decay, progress)
        self.student.head.directions.requires_grad_(progress >= 0.05)  # DINO fixes the last layer in the first epoch
        return {}

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        config, device = self.config, self.centre.device
        rng = np.random.default_rng([config.seed, 3, step])
        objects, views = (rng.integers(count, size=config.images) for count in self.rgb.shape[:2])
        large, small = (crops.to(device) for crops in multi_crop(self.rgb[objects, views], rng, config))
        with autocast(device.type, self.precision):
            with torch.no_grad():
                teacher = self.teacher(large.flatten(0, 1)).unflatten(0, large.shape[:2]).float()
            student = [self.student(crops.flatten(0, 1)).unflatten(0, crops.shape[:2]).float()
                       for crops in (large, small) if len(crops)]  # fmt: skip
        self.teacher_mean = teacher.mean((0, 1))
        sharp = config.teacher_temperature if config.sharpening else config.student_temperature
        return distillation_loss(torch.cat(student), teacher, self.centre, config.student_temperature, sharp)

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        momentum = cosine(self.config.teacher_momentum, step / self.steps)
        for slow, fast in zip(self.teacher.parameters(), self.student.parameters(), strict=True):
            slow.lerp_(fast, 1 - momentum)
        if self.config.centring:
            self.centre.lerp_(self.teacher_mean, 1 - self.config.centre_momentum)  # eq. 4

    def evaluate(self) -> dict[str, float]:
        return self.measure(self.teacher.backbone)


def distil(
    config: DistillationConfig,
    shape: TrainingConfig,
    folder: Path,
    renders: Path | None = None,
    log: Callable[[str], None] = logger.info,
    log_every: int = 50,
    checkpoint_every: int = 250,
) -> Path:
    """Train a backbone by DINO or resume its training, and export `folder`/dino-tiny.safetensors.

    Args:
        config: Configuration of the run.
        shape: Size of the backbone, the block that is evaluated, and the training objects; its other fields are not
            used.
        folder: Receives config.json, log.jsonl and checkpoint.pt (see `loop.run`) and the exported weights. A run in it
            is resumed.
        renders: Folder in which the renders are made or found. Default: `folder`/renders.
        log: Called with each line of the log as readable text.
        log_every: Steps between lines of the log; every tenth line has the figures of `held_out_accuracy`.
        checkpoint_every: Steps between checkpoints.

    Returns:
        Path of the exported weights.

    Raises:
        InputError: If `folder` has a run with another configuration or a damaged checkpoint.
    """
    folder = Path(folder)
    network = {name: getattr(shape, name) for name in ("embed_dim", "depth", "num_heads", "layer")}
    rendered = {"proportions": shape.proportions, "deformation": shape.deformation}
    objects = {"objects": shape.objects, "objects_seed": shape.seed}
    claim_folder(folder, asdict(config) | objects | rendered | {"network": network})
    training, held_out = training_and_held_out(renders or folder / "renders", shape.objects, shape.seed, **rendered)
    start = Trainee(shape)
    initialise(start, training, shape.seed)

    def measure(backbone: VisionTransformer) -> dict[str, float]:
        return held_out_accuracy(as_trainee(backbone, shape, training), held_out)

    task = Distillation(config, start.backbone, training.rgb, measure)
    run(task, folder, log, log_every, 10 * log_every, checkpoint_every)
    trainee = as_trainee(task.teacher.backbone.cpu(), shape, training)
    return export_checkpoint(trainee, held_out, shape, folder / "dino-tiny.safetensors")
