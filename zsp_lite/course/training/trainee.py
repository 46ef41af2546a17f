"""The network that is trained: a transformer with two linear heads, and its initial values.

The factors of the initial values are those of the training of `zsp-tiny` (docs/rebuild.md).
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.backbones.vit import TrainingTokens, VisionTransformer
from zsp_lite.course.training.batches import PATCH_SIZE, sample_batch
from zsp_lite.course.training.renders import RenderSet


class Trainee(nn.Module):
    """A transformer whose keys of block `layer` (from 0) are trained, and their running mean.

    Two linear heads, which only training uses, predict geometry from the output tokens and from the
    keys' input: a normal, the relative depth and a foreground logit.
    """

    def __init__(self, backbone: VisionTransformer, layer: int):
        super().__init__()
        self.backbone = backbone
        self.layer = layer
        self.geometry_of_tokens = nn.Linear(backbone.embed_dim, 5)
        self.geometry_of_keys = nn.Linear(backbone.embed_dim, 5)
        self.register_buffer("key_mean", torch.zeros(backbone.embed_dim))

    def forward(self, images: Float[Tensor, "batch 3 side side"]) -> TrainingTokens:
        """Run the transformer on images that are normalised by `batches.MEAN` and `batches.STD`."""
        return self.backbone.forward_training(images, self.layer)

    def centred(
        self, keys: Float[Tensor, "batch n dim"], update_mean: bool = False
    ) -> Float[Tensor, "batch n dim"]:
        """Subtract the running mean of the keys."""
        if update_mean:
            mean = keys.detach().mean((0, 1))
            # The first mean is taken as it is, later ones with a weight of 5 %.
            if self.key_mean.any():
                mean = 0.95 * self.key_mean + 0.05 * mean
            self.key_mean.copy_(mean)
        return keys - self.key_mean


@torch.no_grad()
def as_trainee(backbone: VisionTransformer, layer: int, renders: RenderSet, side: int) -> Trainee:
    """Wrap a transformer, with the mean of its keys on crops of `side` pixels.

    The crops show at most six objects, each nearly whole.
    """
    trainee = Trainee(backbone, layer)
    # Any seed would do.
    batch = sample_batch(
        renders, np.random.default_rng(7), min(6, len(renders.rgb)), side, (0.85, 1.0)
    )
    trainee.centred(trainee(batch.images).keys, update_mean=True)
    return trainee


@torch.no_grad()
def initial_backbone(
    renders: RenderSet, embed_dim: int, depth: int, num_heads: int
) -> VisionTransformer:
    """Make a transformer with the initial values of a training.

    Linear layers are Xavier-initialised, with smaller residual branches; position embeddings are
    sines and cosines. The patch embedding whitens the patches of the training crops, with damping
    so that noise is not amplified: a random linear embedding would pass on little more than the
    mean brightness.
    """
    p = PATCH_SIZE
    backbone = VisionTransformer(224, p, embed_dim, depth, num_heads)
    generator = torch.Generator().manual_seed(0)
    # Linear layers; "proj" and "fc2" end the residual branches.
    for name, module in backbone.named_modules():
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight, generator=generator)
            if name.endswith(("proj", "fc2")):
                module.weight *= 1.5 * (2 * backbone.depth) ** -0.5
    nn.init.normal_(backbone.cls_token, std=0.02, generator=generator)
    # The position of the CLS token, the first, stays zero.
    backbone.pos_embed.zero_()
    backbone.pos_embed[0, 1:] = 0.25 * _sine_cosine_embedding(embed_dim, backbone.image_size // p)

    # The patches (n, 3 p p) of some crops, and their principal axes by increasing variance.
    rng = np.random.default_rng([0, 1])
    batches = [sample_batch(renders, rng, objects=15, side=96, scale=(0.4, 1.0)) for _ in range(4)]
    images = torch.cat([batch.images for batch in batches])
    patches = F.unfold(images, p, stride=p).transpose(1, 2).flatten(0, 1)
    patches = patches - patches.mean(0)
    variance, axes = torch.linalg.eigh(patches.T @ patches / len(patches))
    # The embedding whitens the strongest axes, with a damping of 0.02, and mixes them by a random
    # orthogonal matrix.
    strongest = min(embed_dim, len(variance))
    whiten = (axes[:, -strongest:] / (variance[-strongest:] + 0.02).sqrt()).T
    mixing, _ = torch.linalg.qr(torch.randn(embed_dim, embed_dim, generator=generator))
    weight = 0.5 * mixing[:, :strongest] @ whiten
    backbone.patch_embed.proj.weight.copy_(weight.view(embed_dim, 3, p, p))
    backbone.patch_embed.proj.bias.zero_()
    return backbone


def _sine_cosine_embedding(dim: int, side: int) -> Float[Tensor, "n dim"]:
    """Return the position embedding of a grid of side x side patches, row by row."""
    # Frequencies from 1 down to nearly 1/60, for positions from 0 to 12: the fastest wave has about
    # two periods over the image.
    centre = (torch.arange(side) + 0.5) / side * 12
    frequency = torch.exp(-math.log(60) * torch.arange(dim // 4) / (dim // 4))
    y, x = torch.meshgrid(centre, centre, indexing="ij")
    y = y[..., None] * frequency
    x = x[..., None] * frequency
    return torch.cat([y.sin(), y.cos(), x.sin(), x.cos()], -1).flatten(0, 1)
