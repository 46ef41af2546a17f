"""Best view selection: the paper's correspondence score and its three alternatives (sec. 4.2, table
3)."""

from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float

from zsp_lite.features import FeatureMap
from zsp_lite.matching import Matches, cyclical_distances
from zsp_lite.views import ViewMatch

_NEIGHBOUR = 1.5  # patches; the eight neighbours of a patch are nearer


@runtime_checkable
class ViewSelector(Protocol):
    """A score of how well a target view suits the reference. Any callable with this signature is
    accepted.

    A selector that counts the matches whose descriptors are close:

        def close_matches(one):
            return float((one.matches.similarity > 0.8).sum())

        ZeroShotPose(backbone, view_selector=close_matches)
    """

    def __call__(self, one: ViewMatch, /) -> float:
        """Score a target view; the view of highest score is selected."""
        ...


def correspondence_score(matches: Matches, k: int) -> float:
    """Score the matches of a view (eq. 3, "CorrespondSim"): the sum of -d over the k matches.

    d is the L2 distance of normalised descriptors. A missing match counts as orthogonal, d =
    sqrt(2). Otherwise a view with few matches would win by having few terms to sum.
    """
    return score_from_cosines(torch.as_tensor(matches.similarity), k)


def score_from_cosines(cosines: Float[torch.Tensor, " n"], k: int) -> float:
    """Compute `correspondence_score` from the cosines of at most k matches."""
    distances = (2 - 2 * cosines).clamp_min(0).sqrt()
    return -float(distances.sum()) - max(k - len(cosines), 0) * 2**0.5


def global_score(reference: FeatureMap, target: FeatureMap) -> float:
    """Compute the cosine of the two images' global features ("GlobalSim")."""
    return float(F.cosine_similarity(reference.global_feature, target.global_feature, dim=0))


def mask_iou(
    first: Bool[torch.Tensor, "rows cols"], second: Bool[torch.Tensor, "rows cols"]
) -> float:
    """Compute the intersection over union of two masks, 0 if both are empty ("SaliencyIoU" of two
    foregrounds)."""
    return float((first & second).sum() / (first | second).sum().clamp_min(1))


def cyclical_iou(
    similarity: Float[torch.Tensor, "reference target"],
    reference_foreground: Bool[torch.Tensor, "rows cols"],
    target_foreground: Bool[torch.Tensor, "target_rows target_cols"],
) -> float:
    """Compute "CyclicalDistIoU": the IoU of the target's foreground and its patches of small
    cyclical distance.

    The distance is that of a cycle from a target patch through the reference back to the target.
    The paper gives no threshold. Here the cycle returns to the patch itself or to one of its eight
    neighbours.
    """
    grids = tuple(target_foreground.shape), tuple(reference_foreground.shape)
    distances = cyclical_distances(similarity.T, *grids, target_foreground, reference_foreground)
    return mask_iou(distances >= -_NEIGHBOUR, target_foreground)


VIEW_SELECTORS: dict[str, ViewSelector] = {
    "correspond": lambda one: correspondence_score(one.matches, one.k),
    "global": lambda one: global_score(one.reference.features, one.target.features),
    "saliency": lambda one: mask_iou(one.reference.foreground, one.target.foreground),
    "cyclical": lambda one: cyclical_iou(
        one.similarity, one.reference.foreground, one.target.foreground
    ),
}
