"""Ways to choose, for each patch of one image, a partner in the other (supplement, "Design of correspondence method").

A matcher is a function `(similarity (n1, n2), on1 (n1,), on2 (n2,)) -> (partner (n1,), score (n1,))`: for each patch
of the first image the index of its partner in the second, and how good a match that is, -inf for none. The masks say
which patches are the object. `matching.match` keeps the best scores and thins them by k-means; "cyclical", the
paper's own, lives there. Your own function of this form goes where a name would.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

Matcher = Callable[
    [Float[Tensor, "n1 n2"], Bool[Tensor, " n1"], Bool[Tensor, " n2"]], tuple[Int[Tensor, " n1"], Float[Tensor, " n1"]]
]

# Neither is given in the paper. 0.1 is what LoFTR (Sun et al. 2021) divides its similarities by before a dual softmax,
# 0.05 the entropy weight of SCOT (Liu et al. 2020), the optimal transport that the paper cites.
SOFTMAX_TEMPERATURE = 0.1
TRANSPORT_REGULARISATION = 0.05
TRANSPORT_STEPS = 100


def mutual(
    similarity: Float[Tensor, "n1 n2"], on1: Bool[Tensor, " n1"], on2: Bool[Tensor, " n2"]
) -> tuple[Int[Tensor, " n1"], Float[Tensor, " n1"]]:
    """Mutual nearest neighbours among the objects' patches, scored by their similarity."""

    def choose(sim: Tensor) -> tuple[Tensor, Tensor]:
        best, partner = sim.max(dim=1)
        returned = sim.argmax(dim=0)[partner]
        return partner, best.masked_fill(returned != torch.arange(len(sim), device=sim.device), -torch.inf)

    return _among_objects(choose, similarity, on1, on2)


def dual_softmax(
    similarity: Float[Tensor, "n1 n2"],
    on1: Bool[Tensor, " n1"],
    on2: Bool[Tensor, " n2"],
    temperature: float = SOFTMAX_TEMPERATURE,
) -> tuple[Int[Tensor, " n1"], Float[Tensor, " n1"]]:
    """The product of both softmaxes: the chance that each patch is the other's choice (Cheng et al. 2021)."""

    def choose(sim: Tensor) -> tuple[Tensor, Tensor]:
        sharp = sim / temperature
        # Added logarithms keep the order where the product of small chances would underflow.
        best, partner = (sharp.log_softmax(0) + sharp.log_softmax(1)).max(dim=1)
        return partner, best

    return _among_objects(choose, similarity, on1, on2)


def optimal_transport(
    similarity: Float[Tensor, "n1 n2"],
    on1: Bool[Tensor, " n1"],
    on2: Bool[Tensor, " n2"],
    regularisation: float = TRANSPORT_REGULARISATION,
    steps: int = TRANSPORT_STEPS,
) -> tuple[Int[Tensor, " n1"], Float[Tensor, " n1"]]:
    """The plan that moves an even mass from one object's patches to the other's at cost 1 - similarity.

    (Liu et al. 2020.) A patch's partner is where most of its mass goes, the score that mass.
    """

    def choose(sim: Tensor) -> tuple[Tensor, Tensor]:
        best, partner = sinkhorn(1 - sim, regularisation, steps).max(dim=1)
        return partner, best

    return _among_objects(choose, similarity, on1, on2)


def sinkhorn(cost: Float[Tensor, "n1 n2"], regularisation: float, steps: int) -> Float[Tensor, "n1 n2"]:
    """Entropy-regularised transport plan between uniform masses (Cuturi 2013); its rows sum to 1 / n1, in the limit.

    regularisation: the entropy's weight, in the unit of the cost.  steps: of scaling rows and columns.
    """
    # Costs less their minimum: the plan is the same, and its kernel does not underflow.
    kernel = torch.exp((cost.min() - cost.to(torch.float64)) / regularisation)
    n1, n2 = kernel.shape
    rows, columns = kernel.new_ones(n1), kernel.new_ones(n2)
    for _ in range(steps):
        rows = 1 / (n1 * (kernel @ columns)).clamp_min(torch.finfo(kernel.dtype).tiny)
        columns = 1 / (n2 * (rows @ kernel)).clamp_min(torch.finfo(kernel.dtype).tiny)
    return rows[:, None] * kernel * columns


MATCHERS: dict[str, Matcher] = {
    "mutual": mutual,
    "dual softmax": dual_softmax,
    "optimal transport": optimal_transport,
}


def _among_objects(
    choose: Callable[[Tensor], tuple[Tensor, Tensor]], similarity: Tensor, on1: Tensor, on2: Tensor
) -> tuple[Tensor, Tensor]:
    """`choose` on the objects' patches alone, its answer in terms of all patches."""
    partner = torch.zeros(len(on1), dtype=torch.long, device=similarity.device)
    score = torch.full((len(on1),), -torch.inf, dtype=torch.float64, device=similarity.device)
    if on1.any() and on2.any():
        chosen, found = choose(similarity[on1][:, on2])
        partner[on1] = on2.nonzero()[:, 0][chosen]
        score[on1] = found.to(torch.float64)
    return partner, score
