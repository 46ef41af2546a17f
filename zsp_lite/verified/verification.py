"""A pose put to the test of everything that was seen: does it predict what each view shows, and only that?

Forward (f_), the reference's points are projected into every target view; in reverse (r_), the targets' points into
the reference. Four terms each, kept apart, averaged over the points, the targets' by the surface they stand for:
sim    how alike in features a point is to what the views show where it lies on a surface that they saw
seen   the share of points that lie on a seen surface
off    how far points fall outside the silhouettes
front  how far they float before the surfaces seen there, in space that a view saw to be free
And one of the pictures as wholes:
view   how alike the reference and the target views are that are little turned against it, under the pose
A point behind a seen surface is hidden, and one where the depth is unknown may be anywhere: neither is held against
the pose.
"""

from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from zsp_lite.verified.maps import Seen, look_up
from zsp_lite.verified.poses import Poses, angles
from zsp_lite.verified.scene import Scene

# In working units, shares of the object's spread: the width of "on the surface", and where an offence costs in full.
TOUCH = 0.25
FULL = 0.5
SAME_SIDE = 45.0  # degrees of rotation between two cameras at which a view's likeness counts 1/e
# Weight at which a point's similarity counts half: a glimpse in one view is less than the sight of three.
_GLIMPSE = 0.5
# Lookups at a time; what they need then stays in the processor's cache.
_CHUNK = 250_000


@dataclass(frozen=True, eq=False)
class Terms:
    """The terms of m poses (see above): of sim, seen and view the more the better, of off and front the less."""

    f_sim: Float[Tensor, " m"]
    f_seen: Float[Tensor, " m"]
    f_off: Float[Tensor, " m"]
    f_front: Float[Tensor, " m"]
    r_sim: Float[Tensor, " m"]
    r_seen: Float[Tensor, " m"]
    r_off: Float[Tensor, " m"]
    r_front: Float[Tensor, " m"]
    view: Float[Tensor, " m"]

    def __getitem__(self, index) -> "Terms":
        """The terms of the poses at an index array, slice or mask."""
        return Terms(*(getattr(self, name)[index] for name in TERMS))

    def table(self) -> Float[Tensor, "m terms"]:
        """One column per term, in the order of `TERMS`."""
        return torch.stack([getattr(self, name) for name in TERMS], dim=1)

    def of(self, index: int) -> dict[str, float]:
        """The terms of one pose by name."""
        return {name: float(getattr(self, name)[index]) for name in TERMS}


TERMS = tuple(field.name for field in fields(Terms))


@dataclass(frozen=True)
class Weights:
    """What each term is worth in the score, in nats: e^score is in proportion to a pose's chances among others.

    The defaults are a conditional logit, fitted on objects of training categories by `benchmark.tuning` and rounded.
    """

    f_sim: float = 60.0
    f_seen: float = 5.0
    f_off: float = -25.0
    f_front: float = -20.0
    r_sim: float = 20.0
    r_seen: float = 35.0
    r_off: float = -10.0
    r_front: float = -30.0
    view: float = 20.0

    def score(self, terms: Terms) -> Float[Tensor, " m"]:
        """The weighted sum of the terms, the higher the better."""
        return terms.table() @ torch.tensor(astuple(self), dtype=torch.float32)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What n points under m poses met in v views, and how it counts: what to draw.

    seen: what the projections met.  touch: weight with which the point lies on the surface seen there.
    off, front: from 0, no offence, to 1.  alike: similarity to the patch there, 0 where there is none.
    """

    seen: Seen
    touch: Float[Tensor, "m v n"]
    off: Float[Tensor, "m v n"]
    front: Float[Tensor, "m v n"]
    alike: Float[Tensor, "m v n"]

    def terms(self, share: Float[Tensor, " n"]) -> Iterator[Float[Tensor, " m"]]:
        """sim, seen, off and front: averages over views, then over points that count by their shares."""
        share = share / share.sum()
        touch = torch.where(self.seen.patch < 0, 0, self.touch)
        total = touch.sum(dim=1)
        yield ((touch * self.alike).sum(dim=1) / (total + _GLIMPSE)) @ share
        yield total.clamp_max(1) @ share
        yield self.off.mean(dim=1) @ share
        yield self.front.mean(dim=1) @ share


def forward(scene: Scene, poses: Poses, rows: Int[Tensor, " n"] | None = None) -> Evidence:
    """The reference's points (`rows` of them; default all) in all target views."""
    rows = torch.arange(len(scene.reference_points)) if rows is None else rows
    seen = look_up(scene.target_maps, poses.linear, poses.translation, scene.reference_points[rows])
    return _weigh(scene, seen, rows * scene.similarity.shape[1], 1)


def reverse(scene: Scene, poses: Poses, chosen: Int[Tensor, " n"] | None = None) -> Evidence:
    """The targets' points (the `chosen`; default all) in the reference view."""
    chosen = torch.arange(len(scene.target_points)) if chosen is None else chosen
    back = poses.inverse()
    seen = look_up(scene.reference_maps, back.linear, back.translation, scene.target_points[chosen])
    return _weigh(scene, seen, scene.target_column[chosen], scene.similarity.shape[1])


def verify(scene: Scene, poses: Poses, every: tuple[int, int] = (1, 1)) -> Terms:
    """The terms of every pose, from every so manieth point of the reference and of the targets."""
    rows = torch.arange(0, len(scene.reference_points), every[0])
    chosen = torch.arange(0, len(scene.target_points), every[1])
    size = max(_CHUNK // (len(rows) * len(scene.target_maps) + len(chosen)), 1)
    even, shares = torch.ones(len(rows)), scene.target_share[chosen]
    parts = []
    for first in range(0, len(poses), size):
        some = poses[first : first + size]
        parts.append((*forward(scene, some, rows).terms(even), *reverse(scene, some, chosen).terms(shares)))
    return Terms(*(torch.cat(term) for term in zip(*parts)), same_side(scene, poses))


def same_side(scene: Scene, poses: Poses) -> Float[Tensor, " m"]:
    """The view term: what the method chooses the best view by (sec. 4.2), as evidence for a pose among others.

    Each target view's likeness to the reference, less their mean, counts by how little the pose turns its camera
    against the reference's, about the line of sight too: features change with it. With one target view it is 0.
    """
    away = angles(poses.rotation, scene.target_maps.rotation.transpose(1, 2))
    return torch.exp(-((away / SAME_SIDE) ** 2)) @ scene.likeness


def _weigh(scene: Scene, seen: Seen, point: Int[Tensor, " n"], patch_stride: int) -> Evidence:
    """point: where each point's similarities begin in the table; patch_stride: from there to the next patch's."""
    behind = seen.depth - seen.surface
    touch = seen.weight * torch.exp_(behind.square().mul_(-0.5 / TOUCH**2))
    front = seen.weight * behind.add_(TOUCH).div_(-FULL).clamp_(0, 1)
    index = (seen.patch.clamp_min(0) * patch_stride).add_(point)
    alike = scene.similarity.reshape(-1).index_select(0, index.flatten()).view(index.shape)
    return Evidence(seen, touch, (seen.off / FULL).clamp_max_(1), front, alike.masked_fill_(seen.patch < 0, 0))
