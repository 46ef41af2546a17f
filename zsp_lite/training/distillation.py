"""DINO: a student learns to say of any crop what a slow average of itself says of a large one (Caron et al. 2021).

Only pixels go in: no label, no mask, no depth, no second view. Every picture is cut into two global and some local
crops; student and teacher describe each by a distribution over K outputs that mean nothing beforehand, and the student
is asked to agree, on all crops, with the teacher on the *other* global crop. Two answers would agree without seeing
anything: always the same output, and all outputs alike. Centring prevents the first and invites the second,
sharpening the other way round; `DistillationConfig` can switch each off. `Distillation` takes single steps, `distil`
is the whole run with its log.
"""

import copy
import json
import math
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
from zsp_lite.io.files import write_atomic
from zsp_lite.training.batches import _crop_grids as crop_grids
from zsp_lite.training.batches import _recolour as recolour
from zsp_lite.training.batches import sample_batch
from zsp_lite.training.renders import DEFORMATION, PROPORTIONS, VIEWS, RenderSet, training_and_held_out
from zsp_lite.training.train import (
    Trainee,
    TrainingConfig,
    _log_until,
    claim_folder,
    export_checkpoint,
    held_out_accuracy,
    initialise,
)


@dataclass(frozen=True)
class DistillationConfig:
    """Everything that decides the result but the pictures and the backbone's first weights.

    A step takes `images` pictures and cuts 2 + `local_crops` crops out of each. Sides are pixels, scales the crops'
    width as a fraction (low, high) of the picture's. `teacher_momentum` and `weight_decay` go from their first to their
    second number. Without `centring` the centre stays 0; without `sharpening` the teacher's temperature is the
    student's. InputError for numbers without a meaning.
    """

    seed: int = 0
    steps: int = 300
    images: int = 16
    local_crops: int = 4
    global_side: int = 96
    local_side: int = 48
    global_scale: tuple[float, float] = (0.6, 1.0)
    local_scale: tuple[float, float] = (0.25, 0.6)
    outputs: int = 512  # DINO has 65,536
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
                raise InputError(f"DistillationConfig: {name} is {getattr(self, name)}, expected at least 1")
        if self.local_crops < 0:
            raise InputError(f"DistillationConfig: local_crops is {self.local_crops}, expected 0 or more")
        if min(self.student_temperature, self.teacher_temperature) <= 0:
            raise InputError("DistillationConfig: temperatures must be positive")


# Nearer to DINO's own settings: hours on a CPU.
LONG_RUN = DistillationConfig(
    steps=7000, images=32, outputs=4096, hidden=1024, bottleneck=256, teacher_momentum=(0.996, 1.0), learning_rate=5e-4
)  # fmt: skip


class Head(nn.Module):
    """CLS output to K logits: an MLP, then cosines with K learned directions.

    DINO's weight-normalised last layer with its gain fixed at 1, on a bottleneck of unit length: so no logit leaves
    [-1, 1], and only the temperatures decide how peaked a distribution is.
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
    """Backbone and head. Only the backbone is kept afterwards."""

    def __init__(self, backbone: VisionTransformer, config: DistillationConfig):
        super().__init__()
        self.backbone = backbone
        self.head = Head(backbone.embed_dim, config.hidden, config.bottleneck, config.outputs)

    def forward(self, images: Float[Tensor, "batch 3 side side"]) -> Float[Tensor, "batch outputs"]:
        return self.head(self.backbone.extract(images, 0).cls)


def multi_crop(
    pictures: UInt8[np.ndarray, "batch size size 3"], rng: np.random.Generator, config: DistillationConfig
) -> tuple[Float[Tensor, "2 batch 3 g g"], Float[Tensor, "k batch 3 l l"]]:
    """Two global and k local crops of every picture, each turned, flipped and coloured for itself."""
    rgb = torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 255

    def crops(count: int, side: int, scale: tuple[float, float]) -> Tensor:
        grid, _ = crop_grids(rng, count * len(rgb), 1, side, scale)
        cut = F.grid_sample(rgb.repeat(count, 1, 1, 1), grid, padding_mode="reflection", align_corners=False)
        return recolour(rng, cut).unflatten(0, (count, len(rgb)))

    large = crops(2, config.global_side, config.global_scale)
    if config.local_crops == 0:
        return large, large.new_empty(0, len(rgb), 3, config.local_side, config.local_side)
    return large, crops(config.local_crops, config.local_side, config.local_scale)


def distillation_loss(
    student: Float[Tensor, "crops batch outputs"], teacher: Float[Tensor, "2 batch outputs"],
    centre: Float[Tensor, " outputs"], student_temperature: float, teacher_temperature: float,
) -> tuple[Tensor, dict[str, float]]:  # fmt: skip
    """Cross-entropy between the teacher on one global crop and the student on each other crop (DINO, eq. 3).

    The student's first two crops are the teacher's. Also returns, in nats: `teacher_entropy` of a single output; `kl`,
    how far the student is from it (their sum is the loss); and `information`, the entropy of the batch's mean output
    less `teacher_entropy`: what an output tells about the picture. It is 0 in either collapse, and at most log(batch)
    where the two crops of a picture agree.
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


def cosine(ends: tuple[float, float], progress: float) -> float:
    """From ends[0] to ends[1] along half a cosine; progress in [0, 1]."""
    return ends[1] + (ends[0] - ends[1]) * 0.5 * (1 + math.cos(math.pi * progress))


class Distillation:
    """A run of DINO: student, teacher, centre, optimiser and how many steps are done.

    It starts from a copy of `backbone`; the teacher's backbone is the result. A step depends only on the state, the
    seed and the step's number, so a restored run continues as if nothing had happened.
    """

    def __init__(self, config: DistillationConfig, backbone: VisionTransformer):
        torch.manual_seed(config.seed)
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.precision = choose_precision(device.type)
        self.config, self.steps_done = config, 0
        self.student = Network(copy.deepcopy(backbone), config).to(device).requires_grad_(True)
        self.teacher = copy.deepcopy(self.student).requires_grad_(False)
        self.centre = torch.zeros(config.outputs, device=device)
        matrices = [p for p in self.student.parameters() if p.ndim > 1]
        vectors = [p for p in self.student.parameters() if p.ndim <= 1]  # biases and norms: no weight decay
        groups = [dict(params=matrices), dict(params=vectors, weight_decay=0.0)]
        self.optimiser = torch.optim.AdamW(groups, lr=config.learning_rate)

    def step(self, rgb: UInt8[np.ndarray, "n views size size 3"]) -> dict[str, float]:
        """Learn from `config.images` random pictures of `RenderSet.rgb`; returns the figures of that step."""
        config, device = self.config, self.centre.device
        rng = np.random.default_rng([config.seed, 3, self.steps_done])
        pictures = rgb[rng.integers(len(rgb), size=config.images), rng.integers(rgb.shape[1], size=config.images)]
        large, small = (crops.to(device) for crops in multi_crop(pictures, rng, config))
        progress = self.steps_done / config.steps

        with autocast(device.type, self.precision):
            with torch.no_grad():
                teacher = self.teacher(large.flatten(0, 1)).unflatten(0, large.shape[:2]).float()
            student = [self.student(crops.flatten(0, 1)).unflatten(0, crops.shape[:2]).float()
                       for crops in (large, small) if len(crops)]  # fmt: skip
        sharp = config.teacher_temperature if config.sharpening else config.student_temperature
        loss, figures = distillation_loss(torch.cat(student), teacher, self.centre, config.student_temperature, sharp)
        self.optimiser.zero_grad()
        loss.backward()
        if progress < 0.05:  # DINO holds the last layer for the first epoch: outputs first have to mean something
            self.student.head.directions.grad = None
        nn.utils.clip_grad_norm_(self.student.parameters(), 3.0)
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * min(1.0, 10 * progress) * cosine((1.0, 0.01), progress)
        self.optimiser.param_groups[0]["weight_decay"] = cosine(config.weight_decay, progress)
        self.optimiser.step()
        with torch.no_grad():
            momentum = cosine(config.teacher_momentum, progress)
            for slow, fast in zip(self.teacher.parameters(), self.student.parameters(), strict=True):
                slow.lerp_(fast, 1 - momentum)
            if config.centring:
                self.centre.lerp_(teacher.mean((0, 1)), 1 - config.centre_momentum)  # eq. 4
        self.steps_done += 1
        return dict(step=self.steps_done) | figures

    def save(self, path: Path) -> None:
        """Write all that `restore` needs; a file that is there is replaced only once the new one is whole."""
        parts = dict(student=self.student, teacher=self.teacher, optimiser=self.optimiser)
        state = {name: part.state_dict() for name, part in parts.items()}
        state |= dict(
            centre=self.centre, steps_done=self.steps_done, config=asdict(self.config), precision=self.precision
        )
        unfinished = Path(path).with_suffix(".part")
        torch.save(state, unfinished)
        unfinished.replace(path)

    def restore(self, path: Path) -> None:
        """Continue from a file of `save`. InputError where it is damaged or of another configuration."""
        try:
            state = torch.load(path, map_location=self.centre.device, weights_only=True)
            same = state["config"] == asdict(self.config)
        except Exception as error:  # torch raises whatever its unpickler stumbles over
            raise InputError(f"{path}: no checkpoint of a distillation") from error
        if not same:
            raise InputError(f"{path}: a run of another configuration, expected one of {self.config}")
        try:
            for name in ("student", "teacher", "optimiser"):
                getattr(self, name).load_state_dict(state[name])
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{path}: a run with a backbone of another shape, expected one like this") from error
        self.centre, self.steps_done, self.precision = state["centre"], state["steps_done"], state["precision"]


def as_trainee(backbone: VisionTransformer, shape: TrainingConfig, renders: RenderSet, side: int = 96) -> Trainee:
    """The backbone as the other trainer sees one, so that both are measured and exported by the same code.

    The mean key, which that trainer follows from step to step, is taken from crops of `side` pixels of `renders`.
    """
    device = next(backbone.parameters()).device
    trainee = Trainee(shape).to(device)
    trainee.backbone = backbone
    crops = sample_batch(renders, np.random.default_rng(7), min(6, len(renders)), VIEWS, side, (0.85, 1.0)).images
    with torch.no_grad():
        trainee.centred(backbone.forward_training(crops.to(device), trainee.key_block).keys, update_mean=True)
    return trainee


def distil(
    config: DistillationConfig, shape: TrainingConfig, folder: Path, renders: Path | None = None,
    log: Callable[[str], None] = print, progress=lambda iterable, total: iterable, checkpoint_every: int = 250,
    log_every: int = 50,
) -> Path:  # fmt: skip
    """Run DINO from random weights, or resume from `folder`/checkpoint.pt, and export `folder`/dino-tiny.safetensors.

    Of `shape` count the backbone's size and key block, and which objects there are and how they are rendered. folder
    receives config.json and log.jsonl, one JSON object per line: figures of `Distillation.step`, means since the line
    before, and in every tenth line those of `held_out_accuracy` on TRAINING-category objects that no step sees.
    `renders` is where the training set is kept or made (default `folder`/renders); `progress` wraps the rendering of
    its shards.
    Raises InputError where `folder` holds a run of another configuration or a damaged one.
    """
    folder = Path(folder)
    network = {name: getattr(shape, name) for name in ("embed_dim", "depth", "num_heads", "key_block")}
    rendered = dict(proportions=shape.proportions, deformation=shape.deformation)
    settings = dict(asdict(config), objects=shape.objects, pictures_seed=shape.seed, network=network) | rendered
    claim_folder(folder, settings, earlier=dict(proportions=PROPORTIONS, deformation=DEFORMATION))
    training, held_out = training_and_held_out(
        renders or folder / "renders", shape.objects, shape.seed, progress, **rendered
    )
    start = Trainee(shape)
    initialise(start, training, shape.seed)
    run = Distillation(config, start.backbone)
    if (checkpoint := folder / "checkpoint.pt").exists():
        run.restore(checkpoint)
    earlier = _log_until(folder / "log.jsonl", run.steps_done)
    write_atomic(folder / "log.jsonl", "".join(earlier).encode())
    rows: list[dict[str, float]] = []
    with (folder / "log.jsonl").open("a") as log_file:
        while run.steps_done < config.steps:
            rows.append(run.step(training.rgb))
            step = run.steps_done
            last = step == config.steps
            if step % log_every == 0 or last:
                row = dict(step=step)
                row |= {name: round(float(np.mean([r[name] for r in rows])), 4) for name in rows[0] if name != "step"}
                if step % (10 * log_every) == 0 or last:
                    measured = held_out_accuracy(as_trainee(run.teacher.backbone, shape, training), held_out)
                    row |= {name: round(value, 4) for name, value in measured.items()}
                rows = []
                log_file.write(json.dumps(row) + "\n")
                log_file.flush()
                log("  ".join(f"{name} {value}" for name, value in row.items()))
            if step % checkpoint_every == 0 or last:
                run.save(checkpoint)
    trainee = as_trainee(run.teacher.backbone.cpu(), shape, training)
    return export_checkpoint(trainee, held_out, shape, folder / "dino-tiny.safetensors")
