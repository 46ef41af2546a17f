"""A head that predicts where on its object each patch lies: coordinates with the object's front, left and top as axes.

A small transformer reads a backbone's frozen features of one image. It was trained with the object coordinates of
renders of training categories. On an object of an unseen category its prediction is coarse, and what it takes for the
front may be wrong; two objects of one category can still be compared by it (see `verified.verification`, term
`orientation`).
"""

from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from zsp_lite.backbones.checkpoints import load_weights, read_checkpoint

SUFFIX = "-positions.safetensors"  # after the stem of the backbone's file, in the same folder
WIDTH, DEPTH, HEADS = 160, 2, 4


class PositionHead(nn.Module):
    """Transformer that predicts the coordinates of the patches of a photo-informed transformer.

    Args:
        dim: Channels of the keys and of the CLS output.
        channels: Channels of the photo network's features.
    """

    def __init__(self, dim: int, channels: int):
        super().__init__()
        self.key, self.photo = nn.Linear(dim, WIDTH), nn.Linear(channels, WIDTH)
        self.place, self.image = nn.Linear(2, WIDTH), nn.Linear(dim, WIDTH)
        block = nn.TransformerEncoderLayer(WIDTH, HEADS, 2 * WIDTH, 0.1, F.gelu, batch_first=True, norm_first=True)
        self.blocks = nn.TransformerEncoder(block, DEPTH, enable_nested_tensor=False)
        self.out = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 3))

    def forward(
        self,
        keys: Float[Tensor, "b n dim"],
        photo: Float[Tensor, "b n channels"],
        places: Float[Tensor, "b n 2"],
        image: Float[Tensor, "b dim"],
        foreground: Bool[Tensor, "b n"],
    ) -> Float[Tensor, "b n 3"]:
        """Predict coordinates.

        Args:
            keys: Keys of the patches.
            photo: Features of the photo network.
            places: (row, column) of the patches' centres (see `patch_places`).
            image: CLS output of each image.
            foreground: Patches that are attended to. Coordinates are predicted for all.

        Returns:
            Coordinates: front +x, left +y, up +z, in units of the standard deviation of the object's surface.
        """
        key, photo, image = (F.layer_norm(x, x.shape[-1:]) for x in (keys, photo, image))
        places = _standardise(places, foreground[..., None])
        tokens = torch.cat([self.image(image)[:, None], self.key(key) + self.photo(photo) + self.place(places)], dim=1)
        hidden = F.pad(~foreground, (1, 0))  # the first token is always attended to
        return self.out(self.blocks(tokens, src_key_padding_mask=hidden)[:, 1:])


def _standardise(places: Float[Tensor, "b n 2"], foreground: Bool[Tensor, "b n 1"]) -> Float[Tensor, "b n 2"]:
    """Make places relative to the foreground's centre, in units of its standard deviation, averaged over both axes."""
    count = foreground.sum(dim=1, keepdim=True).clamp_min(1)
    centred = places - (places * foreground).sum(dim=1, keepdim=True) / count
    variance = (centred.square() * foreground).sum(dim=(1, 2), keepdim=True) / (2 * count)
    return centred / variance.sqrt().clamp_min(1e-3)


def patch_places(grid: tuple[int, int]) -> Float[Tensor, "n 2"]:
    """Return (row, column) of the centres of all patches; the image reaches from -1 to 1."""
    rows, columns = ((2 * torch.arange(n) + 1) / n - 1 for n in grid)
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"), dim=-1).flatten(0, 1)


def load_position_head(path: str | Path, dim: int, channels: int) -> PositionHead:
    """Load a head from its file. Raises InputError if the file is damaged or is for other numbers of channels."""
    head = PositionHead(dim, channels)
    load_weights(head, read_checkpoint(path)[0], Path(path).name)
    return head.eval().requires_grad_(False)
