"""Train the embedded backbone in runs that go on from one another, each in stages from small crops to full size.

The first run starts from random weights (`TrainingConfig`'s defaults). In the order of its stages: the patch tokens
learn geometry, for correspondence alone drowns in its own gradient noise when it starts from nothing; then
correspondence takes over at 96 px, where crops are cheap; last come larger crops, up to the size that the method
uses. Further runs (`CONTINUATION`) start from the last one's weights and add the choice of the view. An exponential
average of the weights is what is evaluated and exported.
"""

import ctypes
import hashlib
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor, nn

from zsp_lite.backbones.backbone import IMAGENET_MEAN, IMAGENET_STD
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.precision import Precision, autocast, choose_precision
from zsp_lite.backbones.pretrained import TINY
from zsp_lite.backbones.vit import TrainingTokens, VisionTransformer
from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic
from zsp_lite.training.batches import MEAN, STD, Batch, sample_batch
from zsp_lite.training.objectives import attention_loss, correspondence_loss, geometry_loss, view_loss
from zsp_lite.training.renders import DEFORMATION, PROPORTIONS, VIEWS, RenderSet, training_and_held_out


@dataclass(frozen=True)
class Stage:
    """A stretch of training: crops of `side` pixels, `objects` x `views` of them a step.

    `correspondence` is the weight of that loss at the stage's start and end, `helpers` that of geometry and
    attention, `view` that of the choice of the view, which needs all views of an object.
    """

    steps: int
    side: int
    objects: int
    views: int
    scale: tuple[float, float]
    correspondence: tuple[float, float] = (1.0, 1.0)
    helpers: float = 0.4
    radius: float = 0.15
    view: float = 0.0


@dataclass(frozen=True)
class TrainingConfig:
    """What decides the result, beside the weights that a run starts from.

    `seed` fixes objects, crops and random weights; `objects` are trained on, others are held out; the views of an
    object differ by `proportions` and `deformation` (see `render_object`). `queries` and `view_queries` are patches,
    per object and per view. With `log_binned` the view loss compares what the method does, otherwise bare keys.
    InputError for no object, and for amounts that are negative or not finite.
    """

    seed: int = 0
    objects: int = 5600
    proportions: float = PROPORTIONS
    deformation: float = DEFORMATION
    embed_dim: int = 192
    depth: int = 12
    num_heads: int = 6
    key_block: int = 9
    learning_rate: float = 1e-3
    weight_decay: float = 0.05
    temperature: float = 0.1
    view_temperature: float = 0.03
    queries: int = 256
    view_queries: int = 64
    log_binned: bool = True
    average: float = 0.998
    stages: tuple[Stage, ...] = (
        Stage(1200, 96, 8, 2, (0.4, 1.0), correspondence=(0.1, 0.1), helpers=1.0),
        Stage(700, 96, 3, 8, (0.4, 1.0), correspondence=(0.1, 1.0), helpers=1.0),
        Stage(3000, 96, 3, 8, (0.4, 1.0)),
        Stage(1300, 128, 3, 8, (0.5, 1.0)),
        Stage(500, 184, 2, 8, (0.75, 1.0), radius=0.12),
        Stage(250, 224, 1, 8, (0.85, 1.0), radius=0.12),
    )

    def __post_init__(self):
        if self.objects < 1:
            raise InputError(f"training has {self.objects} objects, expected at least 1")
        for name in ("proportions", "deformation"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"training has {name} {getattr(self, name)}, expected a finite number from 0 on")

    @property
    def steps(self) -> int:
        return sum(stage.steps for stage in self.stages)

    def shortened(self, factor: float) -> "TrainingConfig":
        """The same recipe with every stage's steps multiplied by `factor`, at most 1000. InputError on others."""
        if not 0 < factor <= 1000:
            raise InputError(f"steps are to be multiplied by {factor}, expected more than 0 and at most 1000")
        return replace(self, stages=tuple(replace(s, steps=max(1, round(s.steps * factor))) for s in self.stages))


# A further run, which starts from the weights of an earlier one: now the choice of the view counts most.
CONTINUATION = TrainingConfig(
    learning_rate=3e-4,
    stages=(
        Stage(400, 128, 3, 8, (0.6, 1.0), view=2.0),
        Stage(500, 160, 3, 8, (0.7, 1.0), view=2.0),
        Stage(500, 184, 2, 8, (0.8, 1.0), radius=0.12, view=2.0),
        Stage(900, 224, 2, 8, (0.9, 1.0), radius=0.12, view=2.0),
    ),
)


class Trainee(nn.Module):
    """The backbone with the two linear read-outs that only training uses, and the running mean of its keys."""

    def __init__(self, config: TrainingConfig):
        super().__init__()
        self.key_block = config.key_block
        self.precision: Precision | None = None
        self.backbone = VisionTransformer(224, 8, config.embed_dim, config.depth, config.num_heads)
        self.geometry_of_tokens = nn.Linear(config.embed_dim, 5)
        self.geometry_of_keys = nn.Linear(config.embed_dim, 5)
        self.register_buffer("key_mean", torch.zeros(config.embed_dim))

    def forward(self, images: Tensor) -> TrainingTokens:
        """Run the backbone at `precision`, by default the one that is fast on the images' device."""
        device = images.device.type
        with autocast(device, self.precision or choose_precision(device)):
            return self.backbone.forward_training(images, self.key_block)

    def centred(self, keys: Tensor, update_mean: bool = False) -> Tensor:
        """Keys about their running mean; `export_checkpoint` does the same by a mean at 224 px, in the key bias."""
        keys = keys.float()
        if update_mean:
            mean = keys.detach().mean((0, 1))
            self.key_mean.copy_(mean if not self.key_mean.any() else 0.95 * self.key_mean + 0.05 * mean)
        return keys - self.key_mean


def initialise(model: Trainee, renders: RenderSet, seed: int) -> None:
    """Start values: scaled residual branches, sine-cosine positions, a damped-whitening patch embedding.

    A random linear patch embedding passes little but mean brightness on; whitening the training patches (damped, so
    that noise is not blown up) starts with all of their contrast, and stays one linear convolution.
    """
    backbone, dim = model.backbone, model.backbone.embed_dim
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, module in backbone.named_modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight, generator=generator)
                if name.endswith(("proj", "fc2")):
                    module.weight *= 1.5 * (2 * backbone.depth) ** -0.5
        nn.init.normal_(backbone.cls_token, std=0.02, generator=generator)
        backbone.pos_embed.zero_()
        backbone.pos_embed[0, 1:] = 0.25 * _sincos(dim, backbone.image_size // backbone.patch_size)
        rng = np.random.default_rng([seed, 1])
        images = torch.cat([sample_batch(renders, rng, 15, VIEWS, 96, (0.4, 1.0)).images for _ in range(4)])
        p = backbone.patch_size
        patches = F.unfold(images, p, stride=p).transpose(1, 2).flatten(0, 1)
        patches = patches - patches.mean(0)
        variance, axes = torch.linalg.eigh(patches.T @ patches / len(patches))
        kept = min(dim, len(variance))
        whiten = (axes[:, -kept:] / (variance[-kept:] + 0.02).sqrt()).T
        mixing = torch.linalg.qr(torch.randn(dim, dim, generator=generator))[0][:, :kept]
        backbone.patch_embed.proj.weight.copy_((0.5 * mixing @ whiten).view(dim, 3, p, p))
        backbone.patch_embed.proj.bias.zero_()


def _sincos(dim: int, side: int, span: float = 12.0) -> Tensor:
    """Sine-cosine position embedding (side * side, dim) of a grid."""
    centre = (torch.arange(side) + 0.5) / side * span
    wave = torch.exp(-math.log(60) * torch.arange(dim // 4) / (dim // 4))
    y, x = torch.meshgrid(centre, centre, indexing="ij")
    return torch.cat([f(p[..., None] * wave) for p in (y, x) for f in (torch.sin, torch.cos)], -1).flatten(0, 1)


def losses(model: Trainee, batch: Batch, stage: Stage, weight: float, config: TrainingConfig,
           generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:  # fmt: skip
    """The weighted sum of the objectives on one batch, and the figures worth logging."""
    out = model(batch.images)
    on_object = ~batch.surface[..., 0].isnan()
    geometry = 0.5 * sum(
        geometry_loss(head(features.float()), batch.geometry, on_object)
        for head, features in ((model.geometry_of_tokens, out.tokens[:, 1:]), (model.geometry_of_keys, out.key_input))
    )
    attention, iou = attention_loss(out.cls_logits.float(), batch.coverage)
    keys = model.centred(out.keys, update_mean=True)
    descriptors = F.normalize(keys, dim=-1)
    match, accuracy = correspondence_loss(
        descriptors, batch.surface, batch.objects, stage.radius, config.temperature, config.queries, generator
    )
    total = weight * match + stage.helpers * (geometry + attention)
    figures = dict(match=match, geometry=geometry, attention=attention)
    shares = dict(accuracy=accuracy, iou=iou)
    if stage.view:
        figures["view"], shares["view_accuracy"] = view_loss(
            keys.unflatten(1, out.grid), on_object, batch.objects, config.view_temperature, config.view_queries,
            generator, config.log_binned,
        )  # fmt: skip
        total = total + stage.view * figures["view"]
    return total, {name: value.item() for name, value in (dict(loss=total) | figures).items()} | shares


@torch.no_grad()
def held_out_accuracy(model: Trainee, renders: RenderSet, side: int = 128, objects: int = 24) -> dict[str, float]:
    """Match accuracy, view accuracy and saliency IoU on TRAINING-category objects that no step has seen.

    The same crops every time.
    """
    rng, generator = np.random.default_rng(7), torch.Generator().manual_seed(7)
    hits, views, ious = [], [], []
    device = next(model.parameters()).device
    for first in range(0, min(objects, len(renders)), 2):
        members = np.arange(first, min(first + 2, len(renders)))
        batch = _to(sample_batch(renders, rng, len(members), VIEWS, side, (0.85, 1.0), members=members), device)
        out = model(batch.images)
        keys, on_object = model.centred(out.keys), ~batch.surface[..., 0].isnan()
        descriptors = F.normalize(keys, dim=-1)
        hits.append(correspondence_loss(descriptors, batch.surface, len(members), 0.15, 0.1, 256, generator)[1])
        views.append(view_loss(keys.unflatten(1, out.grid), on_object, len(members), 0.03, 10**6, generator)[1])
        ious.append(attention_loss(out.cls_logits.float(), batch.coverage)[1])
    means = dict(held_out_accuracy=hits, held_out_view_accuracy=views, held_out_iou=ious)
    return {name: float(np.mean(values)) for name, values in means.items()}


def _to(batch: Batch, device) -> Batch:
    tensors = ("images", "surface", "geometry", "coverage")
    return replace(batch, **{name: getattr(batch, name).to(device) for name in tensors})


def _learning_rate(config: TrainingConfig, step: int, side: int) -> float:
    """Warm-up over 150 steps, or a quarter of a short run, constant for a third, then a cosine to 1 %.

    Less for large crops.
    """
    warm_up = max(1, min(150, config.steps // 4))
    progress = max(0.0, (step / config.steps - 0.35) / 0.65)
    decay = 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress))
    return config.learning_rate * min(1, (step + 1) / warm_up) * decay * (0.7 if side > 128 else 1.0)


def train(
    config: TrainingConfig, folder: Path, renders: Path | None = None, log: Callable[[str], None] = print,
    progress=lambda iterable, total: iterable, checkpoint_every: int = 250, log_every: int = 50,
    start_from: str | Path | None = None,
) -> Path:  # fmt: skip
    """Train from scratch, or resume from `folder`/checkpoint.pt, and export `folder`/zsp-tiny.safetensors.

    folder receives config.json, log.jsonl (one JSON object per line), the checkpoint and the exported weights;
    `start_from` is where the weights of a further run come from (see `starting_weights`); what an exported file lacks,
    the read-outs, is fitted first.
    `renders` is where the training set is kept or made (default `folder`/renders): 1.1 MB per object there, and in
    memory; `progress` wraps the rendering of its shards. The checkpoint holds model, average, optimiser, step and what
    the run started from; batches depend only on (seed, step), so a resumed run continues as if nothing had happened.
    Raises InputError where `folder` holds a run of another configuration, a damaged one, or one from other weights
    than `start_from`, if that is still there; where `start_from` does not fit; where the loss is no longer finite.
    """
    folder = Path(folder)
    checkpoint_file = folder / "checkpoint.pt"
    first_time = not checkpoint_file.exists()
    start, origin = None, "random weights"
    if start_from is not None and (first_time or _weights_file(start_from).exists()):
        start = starting_weights(config, start_from)
        origin = hashlib.sha256(b"".join(start[name].numpy().tobytes() for name in sorted(start))).hexdigest()
    claim_folder(folder, asdict(config), earlier=dict(proportions=PROPORTIONS, deformation=DEFORMATION))
    resumed = None if first_time else _load(config, checkpoint_file)
    if resumed is not None:
        if start is not None and resumed["origin"] not in (None, origin):
            raise InputError(f"{folder}: holds a run from other weights than {start_from}; expected a new folder")
        origin = resumed["origin"]
    training, held_out = training_and_held_out(
        renders or folder / "renders", config.objects, config.seed, progress, config.proportions, config.deformation
    )

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(config.seed)
    model = Trainee(config)
    if resumed is not None:
        model.load_state_dict(resumed["model"])
    elif start is None:
        initialise(model, training, config.seed)
    else:
        without_read_outs = model.load_state_dict(start, strict=False).missing_keys
        if without_read_outs:
            fit_read_outs(model, training, config.seed)
    model.to(device)
    model.precision = choose_precision(device.type) if resumed is None else resumed["precision"]
    average = Trainee(config).to(device)
    average.precision = model.precision
    average.load_state_dict(model.state_dict())
    optimiser = _optimiser(model, config)
    step = 0
    smooth: dict[str, float] = {}
    if resumed is not None:
        average.load_state_dict(resumed["average"])
        optimiser.load_state_dict(resumed["optimiser"])
        step, smooth = resumed["step"], resumed["smooth"]
    earlier = _log_until(folder / "log.jsonl", step)
    began = time.monotonic() - (json.loads(earlier[-1])["seconds"] if earlier else 0)
    write_atomic(folder / "log.jsonl", "".join(earlier).encode())
    ends = np.cumsum([stage.steps for stage in config.stages])
    while step < config.steps:
        k = int(np.searchsorted(ends, step, side="right"))
        stage = config.stages[k]
        through = (step - (ends[k] - stage.steps)) / stage.steps
        weight = stage.correspondence[0] + through * (stage.correspondence[1] - stage.correspondence[0])
        rng = np.random.default_rng([config.seed, 2, step])
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        batch = _to(sample_batch(training, rng, stage.objects, stage.views, stage.side, stage.scale), device)
        for group in optimiser.param_groups:
            group["lr"] = _learning_rate(config, step, stage.side)
        loss, figures = losses(model, batch, stage, weight, config, generator)
        optimiser.zero_grad()
        loss.backward()
        norm = float(nn.utils.clip_grad_norm_(model.parameters(), 1.0))
        if not math.isfinite(norm):
            raise InputError(f"{folder}: step {step + 1} has gradients of size {norm}; expected a lower learning rate")
        optimiser.step()
        _update_average(average, model, min(config.average, (1 + step) / (10 + step)))
        step += 1
        for name, value in (figures | dict(gradient=norm)).items():
            smooth[name] = 0.95 * smooth.get(name, value) + 0.05 * value
        if step % log_every == 0 or step == config.steps:
            row = dict(step=step, seconds=round(time.monotonic() - began), side=stage.side, weight=round(weight, 3))
            row |= {name: round(value, 4) for name, value in smooth.items()}
            if step % (10 * log_every) == 0 or step == config.steps:
                row |= {name: round(value, 4) for name, value in held_out_accuracy(average, held_out).items()}
            with (folder / "log.jsonl").open("a") as log_file:
                log_file.write(json.dumps(row) + "\n")
            log("  ".join(f"{name} {value}" for name, value in row.items()))
        if step % checkpoint_every == 0 or step == config.steps:
            state = dict(model=model.state_dict(), average=average.state_dict(), step=step, smooth=smooth)
            state |= dict(optimiser=optimiser.state_dict(), origin=origin, precision=model.precision)
            torch.save(state, checkpoint_file.with_suffix(".part"))
            checkpoint_file.with_suffix(".part").replace(checkpoint_file)
    return export_checkpoint(average.cpu(), held_out, config, folder / "zsp-tiny.safetensors")


def claim_folder(folder: Path, settings: dict, earlier: dict | None = None) -> None:
    """Make `folder` and write `settings` to its config.json. InputError where other ones are there.

    `earlier` holds what runs did whose config.json does not say it yet.
    """
    folder.mkdir(parents=True, exist_ok=True)
    settings, path = json.loads(json.dumps(settings)), folder / "config.json"
    if path.exists():
        found = (earlier or {}) | decode(read_bytes(path, "configuration"), dict, path)
        differ = sorted(name for name in settings.keys() | found.keys() if settings.get(name) != found.get(name))
        if differ:
            name = differ[0]
            raise InputError(
                f"{path}: holds a run of another configuration, {name} is {found.get(name)}, expected "
                f"{settings.get(name)} or a new folder"
            )
    write_atomic(path, (json.dumps(settings, indent=1) + "\n").encode())


def keep_freed_memory() -> None:
    """Have glibc keep, for the rest of this process, what a training step frees; elsewhere do nothing.

    Otherwise every step asks the kernel for fresh pages: steps of 16 crops of 224 px took 7.1 s that way and 2.8 s
    this way, of 24 crops of 128 px 1.4 and 1.1 s (medians of six on two cores).
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        never_map, never_trim = (-4, 0), (-1, 2**31 - 1)  # M_MMAP_MAX, M_TRIM_THRESHOLD
        for option in (never_map, never_trim):
            libc.mallopt(*option)


def starting_weights(config: TrainingConfig, source: str | Path) -> dict[str, Tensor]:
    """Weights of a `Trainee` to go on from: the average of a checkpoint of `train`, or an exported backbone.

    The latter is a .safetensors file, or "zsp-tiny"; it has no read-outs, and its mean key, folded into a bias, is 0.
    InputError where there is none, or one of another shape.
    """
    path = _weights_file(source)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise InputError(f"{source}: {what}, expected a checkpoint of `train`, exported .safetensors, or zsp-tiny")
    if path.suffix != ".safetensors":
        return _load(config, path)["average"]
    trainee, backbone = Trainee(config), load_backbone(path, "cpu").model
    sizes = ("depth", "embed_dim", "num_heads", "patch_size", "image_size")
    found, expected = ({name: getattr(model, name) for name in sizes} for model in (backbone, trainee.backbone))
    if found != expected:
        raise InputError(f"{source}: a network of another shape, {found}, expected {expected}")
    trainee.backbone.load_state_dict(backbone.state_dict())
    _rescale_input(trainee.backbone, (IMAGENET_MEAN, IMAGENET_STD), (MEAN, STD))
    return {name: value for name, value in trainee.state_dict().items() if not name.startswith("geometry")}


def _weights_file(source: str | Path) -> Path:
    return TINY if str(source) == "zsp-tiny" else Path(source).expanduser()


@torch.no_grad()
def fit_read_outs(model: Trainee, renders: RenderSet, seed: int, objects: int = 6, side: int = 128) -> None:
    """Set the read-outs by least squares on crops of `side` pixels; the foreground's targets are logits of -2 and 2.

    From random values, zsp-tiny's geometry loss was 1.4 over the first 50 steps, and 0.7 with this.
    """
    batch = sample_batch(renders, np.random.default_rng([seed, 4]), objects, VIEWS, side, (0.6, 1.0))
    on_object = ~batch.surface[..., 0].isnan()
    foreground = 4.0 * on_object.flatten()[:, None] - 2
    out = model.backbone.forward_training(batch.images, model.key_block)

    def fitted(x: Tensor, y: Tensor) -> Tensor:
        x, y = F.pad(x.double(), (0, 1), value=1.0), y.double()
        return torch.linalg.solve(x.T @ x + torch.eye(x.shape[1]), x.T @ y)

    for read_out, features in ((model.geometry_of_tokens, out.tokens[:, 1:]), (model.geometry_of_keys, out.key_input)):
        geometry = fitted(features[on_object], batch.geometry[on_object])
        weight = torch.cat([geometry, fitted(features.flatten(0, 1), foreground)], 1).T
        read_out.weight.copy_(weight[:, :-1])
        read_out.bias.copy_(weight[:, -1])


def _load(config: TrainingConfig, path: Path) -> dict:
    """A checkpoint of a network like `config`'s. InputError where it is damaged, or of another shape."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        parts = {name: state[name] for name in ("model", "average", "optimiser", "step")}
        parts |= dict(smooth=state.get("smooth", {}), origin=state.get("origin"), precision=state["precision"])
    except Exception as error:  # torch raises whatever its unpickler stumbles over
        raise InputError(f"{path}: damaged, or no checkpoint of `train`") from error
    try:
        Trainee(config).load_state_dict(parts["average"])
    except RuntimeError as error:
        shape = f"{config.depth} blocks, {config.embed_dim} wide"
        raise InputError(f"{path}: of a network of another shape, expected one of {shape}") from error
    return parts


@torch.no_grad()
def _rescale_input(backbone: VisionTransformer, old: tuple, new: tuple) -> None:
    """Rescale the patch embedding: what took (rgb - mean) / std by `old` (mean, std) takes pictures scaled by `new`."""
    (mean, std), (new_mean, new_std) = (
        [torch.as_tensor(values).expand(3).view(1, 3, 1, 1) for values in scaling] for scaling in (old, new)
    )
    proj = backbone.patch_embed.proj
    proj.bias += (proj.weight * (new_mean - mean) / std).sum((1, 2, 3))
    proj.weight *= new_std / std


def _log_until(path: Path, step: int) -> list[str]:
    """The log's lines up to `step`: what came after the checkpoint will be done, and logged, again."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [line for line in lines if line.endswith("\n") and json.loads(line)["step"] <= step]


def _optimiser(model: Trainee, config: TrainingConfig) -> torch.optim.Optimizer:
    """AdamW; no weight decay on biases, norms and embeddings."""
    plain = [p for name, p in model.named_parameters() if p.ndim <= 1 or name.endswith(("pos_embed", "cls_token"))]
    chosen = {id(p) for p in plain}
    decayed = [p for p in model.parameters() if id(p) not in chosen]
    groups = [dict(params=decayed, weight_decay=config.weight_decay), dict(params=plain, weight_decay=0.0)]
    return torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, 0.98), fused=True)


@torch.no_grad()
def _update_average(average: Trainee, model: Trainee, decay: float) -> None:
    mine, theirs = list(average.parameters()), list(model.parameters())
    torch._foreach_lerp_(mine, theirs, 1 - decay)
    average.key_mean.copy_(model.key_mean)


@torch.no_grad()
def export_checkpoint(model: Trainee, renders: RenderSet, config: TrainingConfig, path: Path) -> Path:
    """Write the backbone as float16 safetensors that any DINO code loads, and return the path.

    Two exact changes: the mean key of every block is folded into its key bias (softmax attention does not see a
    constant added to all keys, and cosine similarity of the keys becomes meaningful), and the trainer's input scaling
    is folded into the patch embedding, so that the model expects ImageNet statistics.
    """
    backbone = VisionTransformer(224, 8, config.embed_dim, config.depth, config.num_heads)
    backbone.load_state_dict(model.backbone.state_dict())
    rgb = torch.from_numpy(renders.rgb[:24, ::3].reshape(-1, *renders.rgb.shape[2:])).permute(0, 3, 1, 2)
    images = (F.interpolate(rgb.float() / 255, (224, 224), mode="bilinear") - MEAN) / STD
    dim = config.embed_dim
    x, _ = backbone.embed(images)
    for block, activations in zip(backbone.blocks, backbone.run_blocks(x), strict=True):
        block.attn.qkv.bias[dim : 2 * dim] -= activations.key[:, 1:].mean((0, 1))
    _rescale_input(backbone, (MEAN, STD), (IMAGENET_MEAN, IMAGENET_STD))
    metadata = dict(name=Path(path).stem, patch_size=8, image_size=224, num_heads=config.num_heads)
    metadata |= dict(key_block=config.key_block, saliency_heads=",".join(map(str, range(config.num_heads))))
    weights = {name: value.half().contiguous() for name, value in backbone.state_dict().items()}
    save_file(weights, path, metadata={name: str(value) for name, value in metadata.items()})
    Path(path).chmod(0o644)  # safetensors makes files that only their owner reads
    return path
