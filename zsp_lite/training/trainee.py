"""The network that is trained: the backbone with two linear heads, and its initial values."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.backbones.efficientnet import EfficientNetLite0
from zsp_lite.backbones.photo_informed import DETAIL, PhotoProjection
from zsp_lite.backbones.precision import Precision, autocast, choose_precision
from zsp_lite.backbones.vit import TrainingTokens, VisionTransformer
from zsp_lite.training.batches import MEAN, PATCH_SIZE, STD, sample_batch
from zsp_lite.training.recipe import TrainingConfig
from zsp_lite.training.renders import VIEWS, RenderSet


class Trainee(nn.Module):
    """Backbone with two linear heads, which only training uses, and the running mean of its keys.

    The heads predict geometry (see `geometry_loss`) from the output tokens and from the input of the keys' projection.

    With `config.photo_share` > 0 the tokens can also receive the features of a photo network, which is not trained.

    Attributes:
        layer: Block whose keys are trained, counted from 0.
        precision: Precision of the backbone's matrix products. Default: the fast one on the images' device.
    """

    def __init__(self, config: TrainingConfig):
        super().__init__()
        self.layer = config.layer
        self.precision: Precision | None = None
        size = config.embed_dim, config.depth, config.num_heads
        self.backbone = VisionTransformer(224, PATCH_SIZE, *size)
        self.geometry_of_tokens = nn.Linear(config.embed_dim, 5)
        self.geometry_of_keys = nn.Linear(config.embed_dim, 5)
        self.register_buffer("key_mean", torch.zeros(config.embed_dim))
        if config.photo_share:
            self.photo_projection = PhotoProjection(config.embed_dim)
            self.register_buffer("photo_key_mean", torch.zeros(config.embed_dim))
            self._photo_network = [EfficientNetLite0().requires_grad_(False)]  # in a list: not part of the state dict

    def forward(self, images: Float[Tensor, "batch 3 side side"], photo: bool = False) -> TrainingTokens:
        """Run the backbone on images that are normalised by `batches.MEAN` and `batches.STD`.

        Args:
            images: Images; with `photo`, of `photo_informed.DETAIL` times the side of the crops.
            photo: Whether the tokens receive the features of the photo network.
        """
        device, added = images.device.type, None
        if photo:
            with torch.no_grad():
                features = self._photo_network[0].features((images * STD + MEAN).clamp(0, 1))
            images, added = F.avg_pool2d(images, DETAIL), self.photo_projection(features)
        with autocast(device, self.precision or choose_precision(device)):
            return self.backbone.forward_training(images, self.layer, added)

    def centred(
        self, keys: Float[Tensor, "batch n dim"], update_mean: bool = False, photo: bool = False
    ) -> Float[Tensor, "batch n dim"]:
        """Subtract the running mean of keys with or without photo features.

        `export_checkpoint` folds the mean at 224 px into the key bias.
        """
        keys, running = keys.float(), self.photo_key_mean if photo else self.key_mean
        if update_mean:
            mean = keys.detach().mean((0, 1))
            running.copy_(mean if not running.any() else 0.95 * running + 0.05 * mean)
        return keys - running


def as_trainee(backbone: VisionTransformer, config: TrainingConfig, renders: RenderSet, side: int = 96) -> Trainee:
    """Wrap a backbone as a trainee, so that `held_out_accuracy` and `export_checkpoint` accept it.

    The mean key is computed from crops of `side` pixels of at most six objects of `renders`.
    """
    device = next(backbone.parameters()).device
    trainee = Trainee(config).to(device)
    trainee.backbone = backbone
    crops = sample_batch(renders, np.random.default_rng(7), min(6, len(renders)), VIEWS, side, (0.85, 1.0)).images
    with torch.no_grad():
        trainee.centred(backbone.forward_training(crops.to(device), trainee.layer).keys, update_mean=True)
    return trainee


@torch.no_grad()
def initialise(model: Trainee, renders: RenderSet, seed: int) -> None:
    """Set the initial values of a run from random weights.

    Linear layers are Xavier-initialised, with smaller residual branches; position embeddings are sines and cosines. The
    patch embedding whitens the patches of the training crops, with damping so that noise is not amplified: a random
    linear embedding would pass on little more than the mean brightness.
    """
    backbone, dim, p = model.backbone, model.backbone.embed_dim, model.backbone.patch_size
    generator = torch.Generator().manual_seed(seed)
    for name, module in backbone.named_modules():
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight, generator=generator)
            if name.endswith(("proj", "fc2")):
                module.weight *= 1.5 * (2 * backbone.depth) ** -0.5
    nn.init.normal_(backbone.cls_token, std=0.02, generator=generator)
    backbone.pos_embed.zero_()
    backbone.pos_embed[0, 1:] = 0.25 * _sine_cosine_embedding(dim, backbone.image_size // p)
    rng = np.random.default_rng([seed, 1])
    images = torch.cat([sample_batch(renders, rng, 15, VIEWS, 96, (0.4, 1.0)).images for _ in range(4)])
    patches = F.unfold(images, p, stride=p).transpose(1, 2).flatten(0, 1)
    patches = patches - patches.mean(0)
    variance, axes = torch.linalg.eigh(patches.T @ patches / len(patches))
    kept = min(dim, len(variance))
    whiten = (axes[:, -kept:] / (variance[-kept:] + 0.02).sqrt()).T
    mixing = torch.linalg.qr(torch.randn(dim, dim, generator=generator))[0][:, :kept]
    backbone.patch_embed.proj.weight.copy_((0.5 * mixing @ whiten).view(dim, 3, p, p))
    backbone.patch_embed.proj.bias.zero_()


@torch.no_grad()
def fit_heads(model: Trainee, renders: RenderSet, seed: int, objects: int = 6, side: int = 128) -> None:
    """Fit the heads by least squares on crops of `side` pixels; foreground targets are logits of -2 and 2.

    With random heads, the geometry loss of zsp-tiny was 1.4 on average over the first 50 steps, with fitted ones 0.7.
    """
    batch = sample_batch(renders, np.random.default_rng([seed, 4]), objects, VIEWS, side, (0.6, 1.0))
    on_object = ~batch.surface[..., 0].isnan()
    foreground = 4.0 * on_object.flatten()[:, None] - 2
    out = model.backbone.forward_training(batch.images, model.layer)

    def least_squares(x: Tensor, y: Tensor) -> Tensor:
        x, y = F.pad(x.double(), (0, 1), value=1.0), y.double()
        return torch.linalg.solve(x.T @ x + torch.eye(x.shape[1]), x.T @ y)

    for head, features in ((model.geometry_of_tokens, out.tokens[:, 1:]), (model.geometry_of_keys, out.key_input)):
        geometry = least_squares(features[on_object], batch.geometry[on_object])
        weight = torch.cat([geometry, least_squares(features.flatten(0, 1), foreground)], 1).T
        head.weight.copy_(weight[:, :-1])
        head.bias.copy_(weight[:, -1])


def _sine_cosine_embedding(dim: int, side: int, span: float = 12.0) -> Float[Tensor, "n dim"]:
    """Position embedding of a grid of side x side patches, row by row."""
    centre = (torch.arange(side) + 0.5) / side * span
    wave = torch.exp(-math.log(60) * torch.arange(dim // 4) / (dim // 4))
    y, x = torch.meshgrid(centre, centre, indexing="ij")
    return torch.cat([f(p[..., None] * wave) for p in (y, x) for f in (torch.sin, torch.cos)], -1).flatten(0, 1)
