"""Many similarities at once: hypotheses as one torch batch, fitted, compared and thinned out together."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

# Scales that the solver allows, in every stage. In working units (see `scene`) both point clouds have unit spread, so
# a scale differs from 1 only where the views show different parts of the two objects, or their proportions differ.
SCALE_RANGE = (0.5, 2.0)


@dataclass(frozen=True, eq=False)
class Poses:
    """m similarities `y = scale * rotation @ x + translation`, in working units (see `scene.Scene`), float32."""

    scale: Float[Tensor, " m"]
    rotation: Float[Tensor, "m 3 3"]
    translation: Float[Tensor, "m 3"]

    def __len__(self) -> int:
        return len(self.scale)

    def __getitem__(self, index) -> "Poses":
        """The poses at an index array, slice or mask."""
        return Poses(self.scale[index], self.rotation[index], self.translation[index])

    @property
    def linear(self) -> Float[Tensor, "m 3 3"]:
        """scale * rotation."""
        return self.scale[:, None, None] * self.rotation

    def apply(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "m n 3"]:
        """Every point under every pose."""
        return points @ self.linear.transpose(1, 2) + self.translation[:, None]

    def inverse(self) -> "Poses":
        """The similarities that undo these."""
        back = self.rotation.transpose(1, 2)
        moved = (back @ self.translation[..., None])[..., 0]
        return Poses(1 / self.scale, back, -moved / self.scale[:, None])


def join(parts: Sequence[Poses]) -> Poses:
    """One batch of several."""
    return Poses(*(torch.cat([getattr(p, name) for p in parts]) for name in ("scale", "rotation", "translation")))


def nearest_rotation(covariance: Float[Tensor, "m 3 3"]) -> Float[Tensor, "m 3 3"]:
    """The rotation R that maximises trace(R.T @ covariance), covariance being sum of target @ source.T."""
    left, _, right = torch.linalg.svd(covariance)
    sign = torch.ones_like(covariance[..., 0])
    # Where the best orthogonal matrix is a mirror, the best rotation flips the direction that counts least.
    sign[..., 2] = (torch.linalg.det(left) * torch.linalg.det(right)).sign()
    return (left * sign[:, None]) @ right


def fit_poses(source: Float[Tensor, "m n 3"], target: Float[Tensor, "m n 3"]) -> Poses:
    """Umeyama's least squares for each of m point sets; a set without extent gives scale 0."""
    source_mean, target_mean = source.mean(1, keepdim=True), target.mean(1, keepdim=True)
    x, y = source - source_mean, target - target_mean
    covariance = y.transpose(1, 2) @ x
    rotation = nearest_rotation(covariance)
    scale = (rotation * covariance).sum((1, 2)) / x.square().sum((1, 2)).clamp_min(1e-12)
    moved = (rotation @ source_mean.transpose(1, 2))[..., 0]
    return Poses(scale, rotation, target_mean[:, 0] - scale[:, None] * moved)


def angles(first: Float[Tensor, "m 3 3"], second: Float[Tensor, "n 3 3"]) -> Float[Tensor, "m n"]:
    """Angle in degrees between each rotation of one batch and each of the other."""
    cosine = (first.flatten(1) @ second.flatten(1).T - 1) / 2
    return torch.rad2deg(torch.arccos(cosine.clamp(-1, 1)))


def suppress(
    rotation: Float[Tensor, "m 3 3"], score: Float[Tensor, " m"], angle: float, keep: int
) -> Int[Tensor, " kept"]:
    """Non-maximum suppression: at most `keep` indices, best score first, no two within `angle` degrees."""
    order = torch.argsort(score, descending=True, stable=True)
    near = (angles(rotation[order], rotation[order]) < angle).numpy()
    kept: list[int] = []
    for candidate in range(len(order)):
        if not near[candidate, kept].any():
            kept.append(candidate)
            if len(kept) == keep:
                break
    return order[torch.tensor(kept, dtype=torch.long)]
