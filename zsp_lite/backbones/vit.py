"""A vision transformer in the layout of the public DINO checkpoints (Caron et al. 2021).

The method needs three things of it (Goodwin et al., section 4.1 and supplement): the *keys* of one block
as descriptors of the patches, the *attention* of the last block's CLS token as saliency, and the CLS
output as one global feature. `VisionTransformer.extract` returns these three and does no work beyond them.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.errors import InputError


@dataclass(frozen=True)
class Tokens:
    """What the method reads from one forward pass over a batch of images; N patches in row-major order."""

    keys: Float[Tensor, "batch n dim"]  # raw keys of the patches, heads concatenated
    attention: Float[Tensor, "batch heads n"]  # last block, CLS to patches; softmax over all 1 + N tokens
    cls: Float[Tensor, "batch dim"]  # normalised CLS output
    grid: tuple[int, int]  # (rows, columns), rows * columns == N


@dataclass(frozen=True)
class TrainingTokens:
    """Everything a loss may want from one forward pass, with gradients."""

    tokens: Float[Tensor, "batch tokens dim"]  # normalised output of the last block, CLS first
    keys: Float[Tensor, "batch n dim"]  # raw keys of the patches at the key block
    key_input: Float[Tensor, "batch n dim"]  # the normalised patch tokens that those keys are a linear map of
    cls_logits: Float[Tensor, "batch heads tokens"]  # last block, CLS to all, scaled, no softmax; float32
    grid: tuple[int, int]


class Attention(nn.Module):
    def __init__(self, dim: int, heads: int):
        super().__init__()
        self.heads = heads
        self.scale = (dim // heads) ** -0.5
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def split_heads(self, x: Float[Tensor, "batch n dim"]) -> Float[Tensor, "batch heads n head_dim"]:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)

    def forward(
        self,
        q: Float[Tensor, "batch m dim"],
        k: Float[Tensor, "batch n dim"],
        v: Float[Tensor, "batch n dim"],
    ) -> Float[Tensor, "batch m dim"]:
        """Attend from each query to all keys and project; heads are slices of the last axis."""
        q, k, v = self.split_heads(q), self.split_heads(k), self.split_heads(v)
        if torch.is_grad_enabled() and q.device.type == "cpu":
            # Forward and backward in bfloat16: 30 ms this way, softmax included, 74 ms through the fused call
            # (24 x 257 tokens). Without gradients the fused call wins, and never stores the attention matrix.
            with torch.autocast("cpu", enabled=False):
                out = ((q * self.scale) @ k.transpose(-1, -2)).softmax(-1) @ v
        else:
            out = F.scaled_dot_product_attention(q, k, v)
        return self.proj(out.transpose(1, 2).flatten(2))

    def cls_logits(
        self, q: Float[Tensor, "batch m dim"], k: Float[Tensor, "batch n dim"]
    ) -> Float[Tensor, "batch heads n"]:
        """Scaled logits of the first query (the CLS token) against all keys, in float32."""
        q, k = self.split_heads(q[:, :1]), self.split_heads(k)
        with torch.autocast(q.device.type, enabled=False):
            return ((q.float() * self.scale) @ k.float().transpose(-1, -2))[:, :, 0]


class Mlp(nn.Module):
    def __init__(self, dim: int, hidden: int):
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, dim)

    def forward(self, x: Float[Tensor, "batch n dim"]) -> Float[Tensor, "batch n dim"]:
        return self.fc2(F.gelu(self.fc1(x)))


class Block(nn.Module):
    """Pre-norm transformer block in three steps, `project`, attention, `finish`: callers can look between."""

    def __init__(self, dim: int, heads: int):
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=1e-6)
        self.attn = Attention(dim, heads)
        self.norm2 = nn.LayerNorm(dim, eps=1e-6)
        self.mlp = Mlp(dim, 4 * dim)

    def project(self, x: Float[Tensor, "batch n dim"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Normalised input, queries, keys and values, each (batch, n, dim) with heads concatenated."""
        normed = self.norm1(x)
        return normed, *self.attn.qkv(normed).chunk(3, dim=-1)

    def finish(
        self, x: Float[Tensor, "batch n dim"], attended: Float[Tensor, "batch n dim"]
    ) -> Float[Tensor, "batch n dim"]:
        """The two residual additions: what attention gathered, then the MLP."""
        x = x + attended
        return x + self.mlp(self.norm2(x))

    def forward(self, x: Float[Tensor, "batch n dim"]) -> Float[Tensor, "batch n dim"]:
        _, q, k, v = self.project(x)
        return self.finish(x, self.attn(q, k, v))

    def forward_cls(self, x: Float[Tensor, "batch n dim"]) -> tuple[Tensor, Tensor, Tensor]:
        """The block as seen by CLS: CLS (batch, 1, dim), keys (batch, n, dim), logits (batch, heads, n).

        One query instead of n: queries, attention, projection and MLP of the patches are never computed.
        """
        dim = x.shape[-1]
        weight, bias = self.attn.qkv.weight, self.attn.qkv.bias
        normed = self.norm1(x)
        q = F.linear(normed[:, :1], weight[:dim], bias[:dim])
        k, v = F.linear(normed, weight[dim:], bias[dim:]).chunk(2, dim=-1)
        return self.finish(x[:, :1], self.attn(q, k, v)), k, self.attn.cls_logits(q, k)


class PatchEmbed(nn.Module):
    def __init__(self, patch_size: int, dim: int):
        super().__init__()
        self.patch_size = patch_size
        self.proj = nn.Conv2d(3, dim, kernel_size=patch_size, stride=patch_size)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch n dim"]:
        # The convolution's windows do not overlap, so it is one matrix product, which a CPU does faster.
        p = self.patch_size
        patches = images.unflatten(3, (-1, p)).unflatten(2, (-1, p)).permute(0, 2, 4, 1, 3, 5)
        return F.linear(patches.flatten(3).flatten(1, 2), self.proj.weight.flatten(1), self.proj.bias)


class VisionTransformer(nn.Module):
    """ViT with the state-dict keys and shapes of a DINO checkpoint (loads one with strict=True).

    image_size is the side in pixels at which the position embedding is stored; other inputs interpolate it.
    Raises InputError where the sizes do not divide each other.
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
        if min(image_size, patch_size, embed_dim, depth, num_heads) < 1 or image_size % patch_size:
            raise InputError(
                f"VisionTransformer: sizes must be positive and image_size a multiple of patch_size, got "
                f"image_size {image_size}, patch_size {patch_size}, depth {depth}"
            )
        if embed_dim % num_heads:
            raise InputError(f"VisionTransformer: embed_dim {embed_dim} is no multiple of {num_heads} heads")
        self.image_size, self.patch_size, self.embed_dim = image_size, patch_size, embed_dim
        self.depth, self.num_heads = depth, num_heads
        self.cls_token = nn.Parameter(torch.zeros(1, 1, embed_dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + (image_size // patch_size) ** 2, embed_dim))
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
        """The stored embedding, or its bicubic interpolation where the input's patch grid is another."""
        side = math.isqrt(self.pos_embed.shape[1] - 1)
        if grid == (side, side):
            return self.pos_embed
        stored = self.pos_embed[:, 1:].unflatten(1, (side, side)).permute(0, 3, 1, 2)
        # DINO adds 0.1 against rounding, and interpolate() then samples with that scale, not the exact ratio;
        # the same here, since released features were computed so.
        scale = tuple((cells + 0.1) / side for cells in grid)
        resized = F.interpolate(stored, scale_factor=scale, mode="bicubic", align_corners=False)
        return torch.cat([self.pos_embed[:, :1], resized.flatten(2).transpose(1, 2)], dim=1)

    def embed(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[Tensor, tuple[int, int]]:
        """Input of the first block (batch, 1 + n, dim) and the patch grid."""
        p = self.patch_size
        if images.ndim != 4 or images.shape[1] != 3 or any(side < p or side % p for side in images.shape[2:]):
            raise InputError(f"images: expected (B, 3, H, W), H and W multiples of {p}, got {tuple(images.shape)}")
        grid = (images.shape[2] // p, images.shape[3] // p)
        patches = self.patch_embed(images)
        x = torch.cat([self.cls_token.expand(len(images), -1, -1).to(patches.dtype), patches], dim=1)
        return x + self.position_embedding(grid), grid

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch tokens dim"]:
        """Normalised output tokens, CLS first."""
        x, _ = self.embed(images)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)

    def extract(self, images: Float[Tensor, "batch 3 height width"], key_block: int = 9) -> Tokens:
        """Keys of block `key_block` (0-based), last CLS attention and CLS output, in one forward."""
        key_block = self._checked(key_block)
        x, grid = self.embed(images)
        for index, block in enumerate(self.blocks[:-1]):
            _, q, k, v = block.project(x)
            if index == key_block:
                keys = k[:, 1:]
            x = block.finish(x, block.attn(q, k, v))
        cls, last_keys, logits = self.blocks[-1].forward_cls(x)
        if key_block == self.depth - 1:
            keys = last_keys[:, 1:]
        return Tokens(keys, logits.softmax(-1)[:, :, 1:], self.norm(cls)[:, 0], grid)

    def forward_training(self, images: Float[Tensor, "batch 3 height width"], key_block: int = 9) -> TrainingTokens:
        """All output tokens, keys of block `key_block` and the last block's CLS logits, with gradients."""
        key_block = self._checked(key_block)
        x, grid = self.embed(images)
        for index, block in enumerate(self.blocks):
            normed, q, k, v = block.project(x)
            if index == key_block:
                keys, key_input = k[:, 1:], normed[:, 1:]
            if index == self.depth - 1:
                logits = block.attn.cls_logits(q, k)
            x = block.finish(x, block.attn(q, k, v))
        return TrainingTokens(self.norm(x), keys, key_input, logits, grid)

    def _checked(self, key_block: int) -> int:
        if not 0 <= key_block < self.depth:
            raise InputError(f"key_block: expected 0 to {self.depth - 1}, got {key_block}")
        return key_block
