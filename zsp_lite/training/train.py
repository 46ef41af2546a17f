"""Training of the embedded backbone with supervision by a renderer.

`train` runs one of the configurations of `zsp_lite.training.recipe`. An exponential average of the weights is evaluated
and exported.
"""

import copy
import hashlib
import logging
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import UInt8
from torch import Tensor

from zsp_lite.backbones.photo_informed import DETAIL
from zsp_lite.backbones.precision import choose_precision
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_arrays
from zsp_lite.training.batches import Batch, sample_batch
from zsp_lite.training.export import export_checkpoint, export_photo_input, starting_weights, weights_file
from zsp_lite.training.loop import Task, claim_folder, run
from zsp_lite.training.objectives import attention_loss, correspondence_loss, geometry_loss, view_loss
from zsp_lite.training.recipe import Stage, TrainingConfig
from zsp_lite.training.renders import VIEWS, RenderSet, models_digest, training_and_held_out
from zsp_lite.training.trainee import Trainee, fit_heads, initialise

logger = logging.getLogger(__name__)


def losses(
    model: Trainee,
    batch: Batch,
    stage: Stage,
    weight: float,
    config: TrainingConfig,
    generator: torch.Generator,
    photo: bool = False,
) -> tuple[Tensor, dict[str, float]]:
    """Compute the weighted sum of the objectives on one batch.

    Args:
        model: Network to train; its running mean of the keys is updated.
        batch: Crops with their geometry.
        stage: Weights of the geometry, attention and view losses.
        weight: Weight of the correspondence loss.
        config: Temperatures and numbers of queries.
        generator: Draws the queries.
        photo: Whether the tokens receive the features of the photo network.

    Returns:
        The sum, and a dictionary of all losses and accuracies.
    """
    out = model(batch.images, photo)
    on_object = ~batch.surface[..., 0].isnan()
    geometry = 0.5 * sum(
        geometry_loss(head(features.float()), batch.geometry, on_object)
        for head, features in ((model.geometry_of_tokens, out.tokens[:, 1:]), (model.geometry_of_keys, out.key_input))
    )
    attention, iou = attention_loss(out.cls_logits.float(), batch.coverage)
    keys = model.centred(out.keys, True, photo)
    match, accuracy = correspondence_loss(
        F.normalize(keys, dim=-1), batch.surface, batch.objects, stage.radius, config.temperature, config.queries,
        generator,
    )  # fmt: skip
    total = weight * match + stage.helpers * (geometry + attention)
    figures = {"match": match, "geometry": geometry, "attention": attention}
    accuracies = {"accuracy": accuracy, "iou": iou}
    if stage.view:
        figures["view"], accuracies["view_accuracy"] = view_loss(
            keys.unflatten(1, out.grid), on_object, batch.objects, config.view_temperature, config.view_queries,
            generator, config.log_binned,
        )  # fmt: skip
        total = total + stage.view * figures["view"]
    return total, {name: value.item() for name, value in ({"loss": total} | figures).items()} | accuracies


@torch.no_grad()
def held_out_accuracy(
    model: Trainee, renders: RenderSet, side: int = 128, objects: int = 24, photo: bool = False
) -> dict[str, float]:
    """Measure a network on objects on which it was not trained. The crops are the same in every call.

    Args:
        model: Network with the running mean of its keys.
        renders: Held-out objects of training categories.
        side: Side of the crops in pixels.
        objects: Largest number of objects.
        photo: Whether the tokens receive the features of the photo network.

    Returns:
        Fraction of patches whose nearest descriptor in the other views is a match ("held_out_accuracy"), fraction of
        views whose most similar view of the other instance is from the same side ("held_out_view_accuracy"), and mean
        IoU of saliency > 0.05 with the mask ("held_out_iou").
    """
    rng, generator = np.random.default_rng(7), torch.Generator().manual_seed(7)
    hits, views, ious = [], [], []
    device = next(model.parameters()).device
    for first in range(0, min(objects, len(renders)), 2):
        members = np.arange(first, min(first + 2, len(renders)))
        batch = sample_batch(renders, rng, len(members), VIEWS, side, (0.85, 1.0), members, DETAIL if photo else 1)
        batch = batch.to(device)
        out = model(batch.images, photo)
        keys, on_object = model.centred(out.keys, photo=photo), ~batch.surface[..., 0].isnan()
        descriptors = F.normalize(keys, dim=-1)
        hits.append(correspondence_loss(descriptors, batch.surface, len(members), 0.15, 0.1, 256, generator)[1])
        views.append(view_loss(keys.unflatten(1, out.grid), on_object, len(members), 0.03, 10**6, generator)[1])
        ious.append(attention_loss(out.cls_logits.float(), batch.coverage)[1])
    means = {"held_out_accuracy": hits, "held_out_view_accuracy": views, "held_out_iou": ious}
    return {name: float(np.mean(values)) for name, values in means.items()}


class BackboneTraining(Task):
    """Training of the backbone on renders.

    Args:
        config: Configuration.
        training, held_out: Objects for training and for evaluation.
        start: Weights of a `Trainee` (see `starting_weights`). Default: random weights. Missing heads are fitted.
        backgrounds: See `sample_batch`.
    """

    max_gradient_norm = 1.0

    def __init__(
        self,
        config: TrainingConfig,
        training: RenderSet,
        held_out: RenderSet,
        start: dict[str, Tensor] | None = None,
        backgrounds: UInt8[np.ndarray, "m height width 3"] | None = None,
    ):
        super().__init__()
        self.backgrounds = backgrounds
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.config, self.training_set, self.held_out, self.steps = config, training, held_out, config.steps
        self.precision = choose_precision(device.type)
        torch.manual_seed(config.seed)
        model = Trainee(config)
        if start is None:
            initialise(model, training, config.seed)
        elif any(name.startswith("geometry") for name in model.load_state_dict(start, strict=False).missing_keys):
            fit_heads(model, training, config.seed)
        model.precision = self.precision
        self.model = model.to(device)
        self.average = copy.deepcopy(self.model)
        # No weight decay on biases, norms and embeddings.
        groups: tuple[list, list] = [], []
        for name, parameter in model.named_parameters():
            groups[parameter.ndim <= 1 or name.endswith(("pos_embed", "cls_token"))].append(parameter)
        groups = [{"params": group, "weight_decay": decay} for group, decay in zip(groups, (config.weight_decay, 0.0))]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, 0.98), fused=True)

    def schedule(self, step: int) -> dict[str, float]:
        self.set_learning_rate(self.config.learning_rate_at(step))
        return {"side": self.config.stage_at(step)[0].side, "weight": round(self._correspondence_weight(step), 3)}

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        stage, _ = self.config.stage_at(step)
        rng = np.random.default_rng([self.config.seed, 2, step, self.config.batch_seed])
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        photo = bool(rng.random() < self.config.photo_share)
        batch = sample_batch(
            self.training_set, rng, stage.objects, stage.views, stage.side, stage.scale,
            detail=DETAIL if photo else 1, backgrounds=self.backgrounds,
        ).to(self.model.key_mean.device)  # fmt: skip
        return losses(self.model, batch, stage, self._correspondence_weight(step), self.config, generator, photo)

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        decay = min(self.config.average, (1 + step) / (10 + step))
        torch._foreach_lerp_(list(self.average.parameters()), list(self.model.parameters()), 1 - decay)
        for mean, latest in zip(self.average.buffers(), self.model.buffers(), strict=True):
            mean.copy_(latest)

    def evaluate(self) -> dict[str, float]:
        figures = held_out_accuracy(self.average, self.held_out)
        if self.config.photo_share:
            informed = held_out_accuracy(self.average, self.held_out, photo=True)
            figures |= {f"photo_{name}": value for name, value in informed.items()}
        return figures

    def _correspondence_weight(self, step: int) -> float:
        stage, done = self.config.stage_at(step)
        first, last = stage.correspondence
        return first + done * (last - first)


def train(
    config: TrainingConfig,
    folder: Path,
    renders: Path | None = None,
    log: Callable[[str], None] = logger.info,
    log_every: int = 50,
    checkpoint_every: int = 250,
    start_from: str | Path | None = None,
    models: Path | None = None,
    backgrounds: Path | None = None,
) -> Path:
    """Train a backbone or resume its training, and export `folder`/zsp-tiny.safetensors.

    Args:
        config: Configuration of the run.
        folder: Receives config.json, log.jsonl and checkpoint.pt (see `loop.run`) and the exported weights. A run in it
            is resumed and gives the same result as an uninterrupted one.
        renders: Folder in which the renders are made or found, 1.4 MB per object. Default: `folder`/renders.
        log: Called with each line of the log as readable text.
        log_every: Steps between lines of the log; every tenth line has the figures of `held_out_accuracy`.
        checkpoint_every: Steps between checkpoints.
        start_from: Weights from which the run starts (see `starting_weights`). Default: random weights. To resume a
            run, the file is not needed any more.
        models: Folder of models from files that are trained on beside procedural objects (see `render_object`).
        backgrounds: File of photographs that `tools/backgrounds.py` made (see `sample_batch`).

    Returns:
        Path of the exported weights; those of the photo input are beside it, if the run trained it.

    Raises:
        InputError: If `folder` has a run with another configuration, other models, backgrounds or initial weights, or a
            damaged checkpoint; if `start_from` does not fit; if `backgrounds` is not such a file; if the training
            diverges.
    """
    folder = Path(folder)
    start, origin = None, None
    resumed = (folder / "checkpoint.pt").exists()
    if start_from is not None and not (resumed and not weights_file(start_from).exists()):
        start = starting_weights(config, start_from)
        origin = hashlib.sha256(b"".join(start[name].numpy().tobytes() for name in sorted(start))).hexdigest()
    photographs = None if backgrounds is None else read_backgrounds(backgrounds)
    sources = {}
    if photographs is not None:
        sources["backgrounds"] = hashlib.sha256(str(photographs.shape).encode() + photographs.tobytes()).hexdigest()
    if models is not None:
        sources["models"] = models_digest(models)
    claim_folder(folder, asdict(config) | sources)
    training, held_out = training_and_held_out(
        renders or folder / "renders", config.objects, config.seed, config.proportions, config.deformation, models
    )
    task = BackboneTraining(config, training, held_out, start, photographs)
    task.origin = origin
    run(task, folder, log, log_every, 10 * log_every, checkpoint_every)
    model = task.average.cpu()
    written = export_checkpoint(model, held_out, config, folder / "zsp-tiny.safetensors")
    if config.photo_share:
        export_photo_input(model, held_out, written, folder / "zsp-tiny-photo.safetensors")
    return written


def read_backgrounds(path: Path) -> UInt8[np.ndarray, "m height width 3"]:
    """Return the photographs of a file that `tools/backgrounds.py` made.

    Raises:
        InputError: The file is damaged, or its images are not uint8 of shape (m, H, W, 3) with at least one image.
    """
    (images,) = read_arrays(path, ("images",), "backgrounds")
    if images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] != 3 or images.size == 0:
        raise InputError(
            f"backgrounds {path}: images are {images.dtype} of shape {images.shape}, expected uint8 of (m, H, W, 3) "
            "with at least one image"
        )
    return images
