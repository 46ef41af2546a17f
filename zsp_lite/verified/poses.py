"""Batches of similarity transforms: fitted, compared and suppressed together as torch tensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from zsp_lite.metrics import rotation_angle

# Scales that the verified solver allows, in every stage; chosen, and narrower than those of the
# paper's solver, `alignment.SCALE_RANGE`. In working units (see `scene`) both point clouds have
# unit spread, so a scale differs from 1 only where the views show different parts of the two
# objects, or their proportions differ.
SCALE_RANGE = (0.5, 2.0)


@dataclass(frozen=True, eq=False)
class Poses:
    """m similarities `y = scale * rotation @ x + translation` in working units, float32."""

    scale: Float[Tensor, " m"]  # positive
    rotation: Float[Tensor, "m 3 3"]
    translation: Float[Tensor, "m 3"]

    def __len__(self) -> int:
        return len(self.scale)

    def __getitem__(self, index) -> "Poses":
        """Select poses by an index array, slice or mask."""
        return Poses(self.scale[index], self.rotation[index], self.translation[index])

    @property
    def linear(self) -> Float[Tensor, "m 3 3"]:
        """The linear parts, scale * rotation."""
        return self.scale[:, None, None] * self.rotation

    def apply(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "m n 3"]:
        """Transform every point by every pose."""
        return points @ self.linear.transpose(1, 2) + self.translation[:, None]

    def inverse(self) -> "Poses":
        """Return the inverse transforms."""
        rotation = self.rotation.transpose(1, 2)
        translation = (rotation @ self.translation[..., None])[..., 0]
        return Poses(1 / self.scale, rotation, -translation / self.scale[:, None])


def concatenate(batches: Sequence[Poses]) -> Poses:
    """Concatenate batches of poses."""
    parts = zip(*((batch.scale, batch.rotation, batch.translation) for batch in batches))
    return Poses(*map(torch.cat, parts))


def float_tensor(values) -> Tensor:
    """Convert an array, or nested lists, to a float32 tensor."""
    return torch.from_numpy(np.asarray(values, dtype=np.float32))


def exp_(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Compute exp(max(x, -80)) in place: processors are slow with numbers below exp(-87)."""
    return x.clamp_min_(-80).exp_()


def rotation_angles(
    first: Float[Tensor, "m 3 3"], second: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "m n"]:
    """Compute the angle in degrees between each rotation of one batch and each of the other."""
    return torch.from_numpy(rotation_angle(first[:, None].numpy(), second[None].numpy()))


def rotation_matrices(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Convert rotation vectors (axis times angle in radians) by Rodrigues' formula, in float32."""
    angle = vectors.norm(dim=-1, keepdim=True)
    x, y, z = (vectors / angle.clamp_min(1e-12)).unbind(-1)
    zero = torch.zeros_like(x)
    # (n, 3, 3): `cross @ v` is the cross product of the axis and v.
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(-1, 3, 3)
    sine = angle.sin()[..., None]
    cosine = angle.cos()[..., None]
    return torch.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)


def non_maximum_suppression(
    rotation: Float[Tensor, "m 3 3"], score: Float[Tensor, " m"], min_angle: float, max_count: int
) -> Int[Tensor, " kept"]:
    """Return the indices of at most `max_count` poses, best first, whose rotations differ by at
    least `min_angle` degrees."""
    order = torch.argsort(score, descending=True, stable=True)
    # (m, m): rows and columns are sorted by the scores, as `order` is.
    near = (rotation_angles(rotation[order], rotation[order]) < min_angle).numpy()
    selected = []
    for candidate in range(len(order)):
        if len(selected) < max_count and not near[candidate, selected].any():
            selected.append(candidate)
    return order[torch.tensor(selected, dtype=torch.long)]
