"""A vision transformer in the layout of the public DINO checkpoints (Caron et al. 2021).

The method uses three outputs (sections 4.1 and 5.3): the *keys* of one block as patch descriptors,
the *attention* of the last block's CLS token as saliency, and the CLS output token as global
feature.
"""

import math
from collections import OrderedDict
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.choices import Facet
from zsp_lite.errors import InputError, check_integer

# Largest side of an image, pixels: the time of attention grows with its fourth power.
MOST_INPUT = 2048


def nearest_multiple(size: int, patch_size: int) -> int:
    """Round an image size, 1 to `MOST_INPUT`, to a positive multiple of `patch_size`."""
    check_integer("image_size", size, 1, MOST_INPUT)
    return max(1, round(size / patch_size)) * patch_size


@dataclass(frozen=True)
class Tokens:
    """Outputs of a forward pass that the method uses; the n patches are in row-major order."""

    # Descriptors: the keys (or another facet) of one block, heads concatenated.
    keys: Float[Tensor, "batch n dim"]
    # Attention of the last block from CLS to the patches, by softmax over all 1 + n tokens.
    attention: Float[Tensor, "batch heads n"]
    cls: Float[Tensor, "batch dim"]  # CLS output token after the final normalisation
    grid: tuple[int, int]  # rows and columns of patches; their product is n


@dataclass(frozen=True)
class TrainingTokens:
    """Outputs of a forward pass that training losses use, with gradients."""

    # All output tokens after the final normalisation, CLS first.
    tokens: Float[Tensor, "batch tokens dim"]
    keys: Float[Tensor, "batch n dim"]  # keys of the patches in one block, heads concatenated
    # Normalised patch tokens of that block: the keys are linear in them.
    key_input: Float[Tensor, "batch n dim"]
    # Scaled attention logits of the last block from CLS to all tokens.
    cls_logits: Float[Tensor, "batch heads tokens"]


@dataclass(frozen=True)
class BlockActivations:
    """Intermediate results of one transformer block, CLS first."""

    normed: Float[Tensor, "batch tokens dim"]  # input after the first normalisation
    # Query, key and value are linear functions of `normed`, heads concatenated.
    query: Float[Tensor, "batch outputs dim"]
    key: Float[Tensor, "batch tokens dim"]
    value: Float[Tensor, "batch tokens dim"]
    token: Float[Tensor, "batch outputs dim"]  # output of the block, not normalised


class Attention(nn.Module):
    """Multi-head self-attention with one linear layer for queries, keys and values."""

    def __init__(self, dim: int, heads: int):
        super().__init__()
        self.heads = heads
        self.scale = (dim // heads) ** -0.5
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def split_heads(
        self, x: Float[Tensor, "batch n dim"]
    ) -> Float[Tensor, "batch heads n head_dim"]:
        """Split the last axis, along which the heads are concatenated."""
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)

    def forward(
        self,
        q: Float[Tensor, "batch m dim"],
        k: Float[Tensor, "batch n dim"],
        v: Float[Tensor, "batch n dim"],
    ) -> Float[Tensor, "batch m dim"]:
        """Attend from each query to all keys, and apply the output projection."""
        heads = F.scaled_dot_product_attention(
            self.split_heads(q), self.split_heads(k), self.split_heads(v)
        )
        # (batch, heads, m, head_dim) -> (batch, m, dim)
        return self.proj(heads.transpose(1, 2).flatten(2))

    def cls_logits(
        self, q: Float[Tensor, "batch m dim"], k: Float[Tensor, "batch n dim"]
    ) -> Float[Tensor, "batch heads n"]:
        """Return the scaled attention logits of the first query (the CLS token) for all keys."""
        q = self.split_heads(q[:, :1])
        k = self.split_heads(k)
        return ((q * self.scale) @ k.transpose(-1, -2))[:, :, 0]


class Block(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, dim: int, heads: int):
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=1e-6)
        self.attn = Attention(dim, heads)
        self.norm2 = nn.LayerNorm(dim, eps=1e-6)
        layers = {"fc1": nn.Linear(dim, 4 * dim), "gelu": nn.GELU(), "fc2": nn.Linear(4 * dim, dim)}
        self.mlp = nn.Sequential(OrderedDict(layers))

    def forward(
        self, x: Float[Tensor, "batch n dim"], outputs: int | None = None
    ) -> BlockActivations:
        """Compute the activations; queries and output for the first `outputs` tokens only.

        By default, they are computed for all tokens, which takes most of the time.
        """
        normed = self.norm1(x)
        if outputs is None:
            q, k, v = self.attn.qkv(normed).chunk(3, dim=-1)
        else:
            # One matrix holds the rows of the queries, the keys and the values, `dim` of each.
            dim = x.shape[-1]
            qkv = self.attn.qkv
            q = F.linear(normed[:, :outputs], qkv.weight[:dim], qkv.bias[:dim])
            k, v = F.linear(normed, qkv.weight[dim:], qkv.bias[dim:]).chunk(2, dim=-1)
        attended = x[:, :outputs] + self.attn(q, k, v)
        return BlockActivations(normed, q, k, v, attended + self.mlp(self.norm2(attended)))


class PatchEmbed(nn.Module):
    """Linear embedding of non-overlapping patches."""

    def __init__(self, patch_size: int, dim: int):
        super().__init__()
        self.patch_size = patch_size
        self.proj = nn.Conv2d(3, dim, kernel_size=patch_size, stride=patch_size)

    def forward(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> Float[Tensor, "batch n dim"]:
        # The windows of the convolution do not overlap: one matrix product gives the same, and is
        # faster on a CPU.
        p = self.patch_size
        windows = images.unflatten(3, (-1, p)).unflatten(2, (-1, p))  # (b, 3, rows, p, columns, p)
        patches = windows.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2)  # (b, n, 3 p p)
        return F.linear(patches, self.proj.weight.flatten(1), self.proj.bias)


class VisionTransformer(nn.Module):
    """ViT with the state-dict keys and shapes of a DINO checkpoint (loads one with strict=True).

    The position embedding is stored for square images of `image_size` pixels and interpolated for
    other sizes.
    """

    def __init__(
        self,
        image_size: int = 224,
        patch_size: int = 8,
        embed_dim: int = 384,
        depth: int = 12,
        num_heads: int = 6,
    ):
        super().__init__()
        sizes = image_size, patch_size, embed_dim, depth, num_heads
        if min(sizes) < 1 or image_size % patch_size or embed_dim % num_heads:
            found = f"image_size, patch_size, embed_dim, depth and num_heads are {sizes}"
            raise InputError(
                f"VisionTransformer: {found}, expected positive multiples of patch_size and "
                "num_heads"
            )
        self.image_size = image_size
        self.patch_size = patch_size
        self.embed_dim = embed_dim
        self.depth = depth
        self.num_heads = num_heads
        self.cls_token = nn.Parameter(torch.zeros(1, 1, embed_dim))
        self.pos_embed = nn.Parameter(
            torch.zeros(1, 1 + (image_size // patch_size) ** 2, embed_dim)
        )
        self.patch_embed = PatchEmbed(patch_size, embed_dim)
        self.blocks = nn.ModuleList(Block(embed_dim, num_heads) for _ in range(depth))
        self.norm = nn.LayerNorm(embed_dim, eps=1e-6)
        nn.init.trunc_normal_(self.cls_token, std=0.02)
        nn.init.trunc_normal_(self.pos_embed, std=0.02)
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)

    def position_embedding(self, grid: tuple[int, int]) -> Float[Tensor, "1 tokens dim"]:
        """Return the stored embedding, or its bicubic interpolation for another patch grid."""
        side = math.isqrt(self.pos_embed.shape[1] - 1)
        if grid == (side, side):
            return self.pos_embed
        # The embedding of the patches as an image: (1, dim, side, side).
        stored = self.pos_embed[:, 1:].unflatten(1, (side, side)).permute(0, 3, 1, 2)
        # As in DINO's code, 0.1 is added so that rounding cannot lose a row, and interpolate()
        # samples with this scale instead of the exact ratio.
        scale = tuple((cells + 0.1) / side for cells in grid)
        resized = F.interpolate(stored, scale_factor=scale, mode="bicubic", align_corners=False)
        return torch.cat([self.pos_embed[:, :1], resized.flatten(2).transpose(1, 2)], dim=1)

    def embed(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> tuple[Tensor, tuple[int, int]]:
        """Return the first block's input (batch, 1 + n, dim) and the patch grid (rows, columns)."""
        grid = (images.shape[2] // self.patch_size, images.shape[3] // self.patch_size)
        patches = self.patch_embed(images)
        cls = self.cls_token.expand(len(images), -1, -1).to(patches.dtype)
        return torch.cat([cls, patches], dim=1) + self.position_embedding(grid), grid

    def forward(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> Float[Tensor, "batch tokens dim"]:
        """Return the normalised output tokens, CLS first."""
        x, _ = self.embed(images)
        for block in self.blocks:
            x = block(x).token
        return self.norm(x)

    def extract(
        self, images: Float[Tensor, "batch 3 height width"], layer: int = 9, facet: Facet = "key"
    ) -> Tokens:
        """Compute block `layer`'s descriptors, the CLS attention and the CLS output."""
        x, grid = self.embed(images)
        for index, block in enumerate(self.blocks):
            # In the last block, the method needs the keys of all tokens, but only the query and the
            # output of CLS, which is the first token.
            cls_only = index == self.depth - 1 and facet == "key"
            activations = block(x, outputs=1 if cls_only else None)
            x = activations.token
            if index == layer:
                descriptors = getattr(activations, facet)
        logits = block.attn.cls_logits(activations.query, activations.key)  # of the last block
        return Tokens(
            descriptors[:, 1:], logits.softmax(-1)[:, :, 1:], self.norm(x[:, :1])[:, 0], grid
        )

    def forward_training(
        self, images: Float[Tensor, "batch 3 height width"], layer: int
    ) -> TrainingTokens:
        """Compute what the losses of the training use, with the keys of block `layer`."""
        x, _ = self.embed(images)
        activations = []
        for block in self.blocks:
            activations.append(block(x))
            x = activations[-1].token
        chosen = activations[layer]
        last = activations[-1]
        logits = self.blocks[-1].attn.cls_logits(last.query, last.key)
        return TrainingTokens(
            self.norm(last.token), chosen.key[:, 1:], chosen.normed[:, 1:], logits
        )
