"""Alternatives to cyclical distances (supplement, "Design of correspondence method").

A `Matcher` selects, for each patch of one image, a partner in the other, and scores the match.
`matching.match` keeps the matches of highest score and selects among them by k-means; the paper's
matcher, "cyclical", is in `matching`.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from zsp_lite.matching import Matched, Matcher

# The paper gives none; LoFTR (Sun et al. 2021) divides its similarities by this before a dual
# softmax.
SOFTMAX_TEMPERATURE = 0.1


def mutual_nearest_neighbours(similarity: Float[Tensor, "m n"]) -> Matched:
    """Match mutual nearest neighbours, scored by their similarity."""
    best, partner = similarity.max(dim=1)
    returned = similarity.argmax(dim=0)[partner]
    return partner, best.masked_fill(returned != torch.arange(len(best)), -torch.inf)


def dual_softmax(similarity: Float[Tensor, "m n"]) -> Matched:
    """Match each patch with the partner of highest probability under a dual softmax (Cheng et al.
    2021).

    The score is the logarithm of the product of the softmax over rows and the softmax over columns.
    """
    sharp = similarity / SOFTMAX_TEMPERATURE
    # The sum of logarithms keeps the order where a product of small probabilities would underflow.
    score, partner = (sharp.log_softmax(0) + sharp.log_softmax(1)).max(dim=1)
    return partner, score


def optimal_transport(similarity: Float[Tensor, "m n"]) -> Matched:
    """Match each patch with the partner that receives most of its mass under optimal transport (Liu
    et al. 2020).

    The plan moves uniform mass between the patches at cost 1 - similarity. The score is the mass
    moved.
    """
    score, partner = sinkhorn(1 - similarity).max(dim=1)
    return partner, score


def sinkhorn(
    cost: Float[Tensor, "n1 n2"], regularisation: float = 0.05, steps: int = 100
) -> Float[Tensor, "n1 n2"]:
    """Compute the entropy-regularised transport plan between uniform masses (Cuturi 2013), in
    float64.

    The paper gives no weight of the entropy; the default is that of SCOT (Liu et al. 2020). The
    plan's columns sum to 1 / n2, its rows to 1 / n1 in the limit of many steps.
    """
    cost = cost.double()
    # Subtracting the minimum leaves the plan as it is and keeps the kernel from underflowing.
    kernel = torch.exp((cost.min() - cost) / regularisation)
    n1, n2 = kernel.shape
    rows = kernel.new_ones(n1)
    columns = kernel.new_ones(n2)
    for _ in range(steps):
        rows = 1 / (n1 * (kernel @ columns)).clamp_min(torch.finfo(kernel.dtype).tiny)
        columns = 1 / (n2 * (rows @ kernel)).clamp_min(torch.finfo(kernel.dtype).tiny)
    return rows[:, None] * kernel * columns


def on_foreground(choose: Callable[[Float[Tensor, "m n"]], Matched]) -> Matcher:
    """Make a matcher of a function that matches the foreground patches alone, given their
    similarities."""

    def matcher(similarity, foreground1, foreground2):
        partner = torch.zeros(len(foreground1), dtype=torch.long)
        score = torch.full((len(foreground1),), -torch.inf, dtype=torch.float64)
        if foreground1.any() and foreground2.any():
            chosen, found = choose(similarity[foreground1][:, foreground2])
            partner[foreground1] = foreground2.nonzero()[:, 0][chosen]
            score[foreground1] = found.to(torch.float64)
        return partner, score

    return matcher


MATCHERS: dict[str, Matcher] = {
    "mutual": on_foreground(mutual_nearest_neighbours),
    "dual softmax": on_foreground(dual_softmax),
    "optimal transport": on_foreground(optimal_transport),
}
