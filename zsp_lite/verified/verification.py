r"""The score of a pose: a weighted sum of nine terms that compare it with everything that the views
show.

    S(T) = \sum_k w_k \phi_k(T)

Four terms project the n reference points into the V target views (`forward_*`), four project the
target points into the reference view (`reverse_*`, then V = 1), and one compares views as a whole.

Point i, moved by T and projected into view v, has depth z and falls on a pixel with measured depth
d of weight m (the soft mask, 0 where the depth is unknown), at distance r from the silhouette. With
\delta = z - d (positive behind the surface), \sigma = 0.25 and \rho = 0.5, all lengths in working
units:

    a_iv = m \exp(-\delta^2 / (2 \sigma^2))           it lies on the measured surface
    b_iv = m clip(-(\delta + \sigma) / \rho, 0, 1)    it lies in front of it, in observed free space
    c_iv = min(r / \rho, 1)                           it lies outside the silhouette
    s_iv    double-centred feature similarity of the point's patch to the foreground patch at the
            pixel; without one, s_iv = a_iv = 0

A point behind the surface is occluded, and one on a pixel of unknown depth can be anywhere: neither
counts against the pose. With point weights q_i that sum to 1 (equal for the reference,
`surface_weights` for the targets) and \kappa = 0.5, the terms of one direction are

    similarity  = \sum_i q_i (\sum_v a_iv s_iv) / (\sum_v a_iv + \kappa)
    overlap     = \sum_i q_i min(\sum_v a_iv, 1)
    silhouette  = \sum_i q_i (1/V) \sum_v c_iv
    free_space  = \sum_i q_i (1/V) \sum_v b_iv

and the ninth, with l_v the feature similarity of target view v to the reference
(`scene.view_similarity`) and \theta_v the angle by which T rotates the reference's camera against
that of view v, is

    viewpoint   = \sum_v (l_v - mean(l)) \exp(-(\theta_v / 45 degrees)^2).

It is the paper's criterion for the best view (sec. 4.2), used as evidence for a pose.

The weights w are those of a conditional logit (McFadden 1974): among the hypotheses of a pair, the
probability that one is correct is proportional to \exp(S). docs/rebuild.md names the revision with
the code of the fit.
"""

from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from zsp_lite.verified.poses import Poses, exp_
from zsp_lite.verified.scene import Scene, project_points

# The symbols of the module's docstring; chosen, not fitted.
_SURFACE_SIGMA = 0.25  # sigma, working units
_MAX_VIOLATION = 0.5  # rho, working units: distance over which b and c rise to 1
VIEWPOINT_SIGMA = 45.0  # degrees, where the exponential falls to 1/e
_SIMILARITY_PRIOR = 0.5  # kappa
# So many projected points are scored at a time: intermediate results stay in the processor's cache.
_CHUNK = 250_000


@dataclass(frozen=True)
class ScoreCoefficients:
    """The weight of each term, in nats. The defaults were fitted on training categories."""

    forward_similarity: float = 13.3
    forward_overlap: float = 5.3
    forward_silhouette: float = -14.2
    forward_free_space: float = -21.3
    reverse_similarity: float = 18.5
    reverse_overlap: float = 23.7
    reverse_silhouette: float = -5.4
    reverse_free_space: float = -16.6
    viewpoint: float = 18.2

    def score(self, terms: Float[Tensor, "m 9"]) -> Float[Tensor, " m"]:
        """Return the scores of m poses: the weighted sums of their terms, higher is better."""
        return terms @ torch.tensor(astuple(self), dtype=torch.float32)

    def of_shape(self) -> "ScoreCoefficients":
        """Return the same weights, but 0 for `_FEATURE_TERMS`: what remains compares shapes."""
        return replace(self, **dict.fromkeys(_FEATURE_TERMS, 0.0))


TERM_NAMES = tuple(field.name for field in fields(ScoreCoefficients))
# Terms that compare features; the others compare shapes.
_FEATURE_TERMS = ("forward_similarity", "reverse_similarity", "viewpoint")
WEIGHTS = ScoreCoefficients()


def score_terms(
    scene: Scene, poses: Poses, stride: tuple[int, int] = (1, 1)
) -> Float[Tensor, "m 9"]:
    """Compute the terms of every pose, columns as in `TERM_NAMES`, on every n-th point.

    `stride` has the n of the reference points and that of the target points.
    """
    source = scene.reference_points[:: stride[0]]
    target = scene.target_points[:: stride[1]]
    source_weights = torch.ones(len(source))
    target_weights = scene.target_weight[:: stride[1]]
    # Entry (i, j) of `similarity` is at i * columns + j of its flat array. Reference points are
    # rows i, and the patches that they fall on columns j; for target points it is the reverse.
    n, columns = scene.similarity.shape
    row_starts = torch.arange(0, n, stride[0]) * columns
    target_columns = scene.target_column[:: stride[1]]
    per_pose = len(source) * len(scene.target_cameras) + len(target)
    size = max(_CHUNK // per_pose, 1)
    chunks = []
    for first in range(0, len(poses), size):
        chunk = poses[first : first + size]
        seen = project_points(scene.target_maps, chunk, source)
        forward = _averages(scene, seen, row_starts, patch_stride=1, point_weights=source_weights)
        seen = project_points(scene.reference_maps, chunk.inverse(), target)
        reverse = _averages(scene, seen, target_columns, columns, target_weights)
        chunks.append(torch.stack([*forward, *reverse], dim=1))
    # The angle includes rotation about the line of sight, because it changes features, too.
    angle = scene.view_angles(poses)
    viewpoint = torch.exp(-((angle / VIEWPOINT_SIGMA) ** 2)) @ scene.view_similarity
    return torch.cat([torch.cat(chunks), viewpoint[:, None]], dim=1)


def _averages(
    scene: Scene,
    projection: tuple[Tensor, ...],
    offset: Int[Tensor, " n"],
    patch_stride: int,
    point_weights: Float[Tensor, " n"],
) -> Iterator[Float[Tensor, " m"]]:
    """Yield similarity, overlap, silhouette and free space, each averaged for every pose, with a,
    b, c and s of each projected point as in the module's docstring.

    The similarity of point i to patch j is at index `offset[i] + patch_stride * j`.
    """
    depth, surface_depth, weight, silhouette_distance, patch = projection
    # Intermediate results are overwritten in place, because new arrays would leave the cache.
    delta = depth - surface_depth
    surface = exp_(delta.square().mul_(-0.5 / _SURFACE_SIGMA**2)).mul_(weight)
    free_space = delta.add_(_SURFACE_SIGMA).div_(-_MAX_VIOLATION).clamp_(0, 1).mul_(weight)
    silhouette = (silhouette_distance / _MAX_VIOLATION).clamp_max_(1)
    index = patch.clamp_min(0).mul_(patch_stride).add_(offset.int())
    similarity = scene.similarity.reshape(-1).index_select(0, index.flatten()).view(index.shape)
    # Without a foreground patch at the pixel, s = a = 0.
    surface.mul_(patch >= 0)
    q = point_weights / point_weights.sum()
    total = surface.sum(dim=1)
    yield (surface.mul_(similarity).sum(dim=1) / (total + _SIMILARITY_PRIOR)) @ q
    yield total.clamp_max(1) @ q
    yield (silhouette @ q).mean(dim=1)
    yield (free_space @ q).mean(dim=1)
