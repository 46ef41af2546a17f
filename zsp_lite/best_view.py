"""Which target view to align with: the paper's correspondence score and its three alternatives (sec. 4.2, table 3).

Each score is a plain function of what it needs; `VIEW_SELECTORS` gives all four the same argument, a
`ViewPair`. The view with the highest score is chosen.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float

from zsp_lite.features import FeatureMap
from zsp_lite.matching import Matches, cyclical_distances

Mask = Bool[torch.Tensor, "rows cols"] | Bool[np.ndarray, "rows cols"]

# A match that could not be made counts like one between orthogonal descriptors.
_ORTHOGONAL = 2**0.5


@dataclass(frozen=True, eq=False)
class ViewPair:
    """A target view beside the reference: all that a selector may look at."""

    reference: FeatureMap
    target: FeatureMap
    reference_foreground: Bool[torch.Tensor, "rows cols"]
    target_foreground: Bool[torch.Tensor, "rows cols"]
    similarity: Float[torch.Tensor, "reference target"]
    matches: Matches
    k: int


def correspondence_score(matches: Matches, k: int) -> float:
    """Eq. 3, "CorrespondSim": the sum over the K matches of -d, d the L2 distance of normalised descriptors.

    With fewer than k matches, each missing one counts as orthogonal, d = sqrt(2): otherwise a view with
    hardly any foreground in common would win by having little to sum.
    """
    return score_from_cosines(torch.as_tensor(matches.similarity), k)


def score_from_cosines(cosines: Float[torch.Tensor, " n"], k: int) -> float:
    """`correspondence_score` of matches whose descriptors have these cosines."""
    distances = (2 - 2 * cosines).clamp_min(0).sqrt()
    return -float(distances.sum()) - max(k - len(cosines), 0) * _ORTHOGONAL


def global_score(reference: FeatureMap, target: FeatureMap) -> float:
    """ "GlobalSim": cosine of the two images' global features."""
    first, second = torch.as_tensor(reference.global_feature), torch.as_tensor(target.global_feature)
    return float(F.cosine_similarity(first, second, dim=0))


def mask_iou(first: Mask, second: Mask) -> float:
    """Intersection over union of two masks of one shape, 0 where both are empty. "SaliencyIoU" of two foregrounds."""
    first, second = torch.as_tensor(first, dtype=torch.bool), torch.as_tensor(second, dtype=torch.bool)
    return float((first & second).sum() / (first | second).sum().clamp_min(1))


def cyclical_iou(
    similarity: Float[torch.Tensor, "reference target"],
    reference_foreground: Bool[torch.Tensor, "rows cols"],
    target_foreground: Bool[torch.Tensor, "target_rows target_cols"],
    threshold: float = 1.5,
) -> float:
    """ "CyclicalDistIoU": IoU of the target's foreground and its patches that cycle through the reference back
    to within `threshold` patches of themselves.

    The paper does not give its threshold; 1.5 patches takes a return to the patch itself or to one of its
    eight neighbours. (The published code compares a rescaled map with the saliency without thresholding either.)
    """
    distances = cyclical_distances(
        similarity.T,
        tuple(target_foreground.shape),
        tuple(reference_foreground.shape),
        target_foreground,
        reference_foreground,
    )
    return mask_iou(distances >= -threshold, target_foreground)


VIEW_SELECTORS: dict[str, Callable[[ViewPair], float]] = {
    "correspond": lambda c: correspondence_score(c.matches, c.k),
    "global": lambda c: global_score(c.reference, c.target),
    "saliency": lambda c: mask_iou(c.reference_foreground, c.target_foreground),
    "cyclical": lambda c: cyclical_iou(c.similarity, c.reference_foreground, c.target_foreground),
}
