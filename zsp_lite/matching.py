"""Semantic correspondences between two images from cyclical distances (sec. 4.1, eq. 2, and
supplement).

`similarity` is the cosine of log-binned descriptors. `cyclical_distances` follows each patch to its
nearest neighbour in the other image and back. `match` takes the 2K patches of smallest cyclical
distance and selects K by k-means.

Why `similarity` needs no descriptors: a descriptor is a concatenation, so the product of two
descriptors is a sum over bins of products of keys. Each of these products is an entry of one matrix
S of all keys against all keys, shifted by the bin's offset in both images. With J_s[S](r1, c1, r2,
c2) = sum over i in (-1, 0, 1) of S(r1 + s i, c1, r2 + s i, c2), J_s' the same for columns, and P
the 3x3 average pooling in both images, the sum is J_1 J_1' S + (J_3 J_3' - 1) P S: a dozen
additions of S to itself.
"""

import pkgutil
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist
from torch import Tensor

from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap, Grid, average_pool, bin_indices, descriptors
from zsp_lite.io.threads import one_thread

Keys = FeatureMap | Float[Tensor, "_ _ _"] | Float[np.ndarray, "_ _ _"]
Similarities = Float[Tensor, "n1 n2"] | Float[np.ndarray, "n1 n2"]
Mask = Bool[Tensor, "_ _"] | Bool[np.ndarray, "_ _"]
_ROUNDS = 300  # of k-means at most; a few are enough
Matched = tuple[Int[Tensor, " _"], Float[Tensor, " _"]]  # partner and score of each patch


@runtime_checkable
class Matcher(Protocol):
    """A way to match patches. Any callable with this signature is accepted.

    A matcher that takes the nearest neighbour if it is clearly better than the second nearest
    (Lowe's ratio test):

        def ratio_test(similarity, foreground1, foreground2):
            distance = (2 - 2 * similarity).clamp_min(0).sqrt()
            distance[:, ~foreground2] = torch.inf
            (first, second), (partner, _) = (part.T for part in distance.topk(2, largest=False))
            score = (second - first).masked_fill(~foreground1, -torch.inf)
            return partner, score

        ZeroShotPose(backbone, matcher=ratio_test)
    """

    def __call__(
        self,
        similarity: Float[Tensor, "n1 n2"],
        foreground1: Bool[Tensor, " n1"],
        foreground2: Bool[Tensor, " n2"],
        /,
    ) -> Matched:
        """Match the patches of image 1 with those of image 2, given the cosines between their
        descriptors.

        Returns for each patch of image 1 the index of its partner in image 2, and the score of the
        match, higher is better; -inf for no match.
        """
        ...


@dataclass(frozen=True, eq=False)
class Matches:
    """K corresponding patches of two images, best first; K may be 0."""

    reference: Int[np.ndarray, "k 2"]  # (K, 2) row and column on the reference's patch grid
    target: Int[np.ndarray, "k 2"]  # (K, 2) row and column on the target's patch grid
    similarity: Float[np.ndarray, " k"]  # (K,) cosine of the two descriptors
    # (K,) cyclical distance d(u, u') >= 0 in patches; for another matcher, minus its score
    distance: Float[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.reference)


def similarity(ref: Keys, target: Keys) -> Float[Tensor, "n1 n2"]:
    """Compute the cosine similarity of the log-binned descriptors of all pairs of patches.

    Args:
        ref: Feature map, or keys (H1, W1, D), of the reference.
        target: Feature map, or keys (H2, W2, D), of the target.

    Returns:
        (H1 * W1, H2 * W2) cosines, patches in row-major order. Descriptors of length 0 have
        similarity 0.
    """
    keys1 = _keys(ref)
    keys2 = _keys(target)
    products = keys1.flatten(0, 1) @ keys2.flatten(0, 1).T  # (H1 W1, H2 W2)
    summed = _bin_products(products.view(*keys1.shape[:2], *keys2.shape[:2]))
    # In place: the matrices are the largest arrays of the method.
    cosines = summed.view(products.shape).mul_(_inverse_norm(keys1)[:, None])
    return cosines.mul_(_inverse_norm(keys2))


def similarities(
    ref: Keys, targets: list[Keys], binning: bool = True
) -> list[Float[Tensor, "n1 n2"]]:
    """Compute `similarity` of one reference with several targets, or `key_similarities` without
    `binning`."""
    if not binning:
        return key_similarities(ref, targets)
    return [similarity(ref, target) for target in targets]


def key_similarities(ref: Keys, targets: list[Keys]) -> list[Float[Tensor, "n1 n2"]]:
    """Compute the cosine similarities of the keys themselves, without log-binning (see
    `similarities`)."""
    reference, *others = [
        F.normalize(_keys(features).flatten(0, 1), dim=1) for features in (ref, *targets)
    ]
    return [reference @ other.T for other in others]


def nearest_neighbours(
    sim: Similarities,
) -> tuple[Int[Tensor, " n1"], Int[Tensor, " n2"]]:
    """Find each row's most similar column and each column's most similar row (the argmins of eq.
    2)."""
    sim = torch.as_tensor(sim)
    return sim.argmax(dim=1), sim.argmax(dim=0)


def cyclical_distances(
    sim: Similarities,
    grid1: Grid,
    grid2: Grid,
    fg1: Mask | None = None,
    fg2: Mask | None = None,
) -> Float[Tensor, "h1 w1"]:
    """Compute the cyclical distance map C_u = -d(u, u') (eq. 2): u's nearest neighbour is v, and
    v's is u'.

    Args:
        sim: (H1 * W1, H2 * W2) similarities.
        grid1: Rows and columns of image 1, in which the cycles start.
        grid2: Rows and columns of image 2.
        fg1: (H1, W1) foreground of image 1; None for all patches.
        fg2: (H2, W2) foreground of image 2; None for all patches.

    Returns:
        (H1, W1) negative distances in patches; -inf where u, v or u' is not foreground.
    """
    on1 = np.ones(grid1, dtype=bool) if fg1 is None else fg1
    on2 = np.ones(grid2, dtype=bool) if fg2 is None else fg2
    return _cycles(sim, on1, on2)[1].view(grid1)


def match(
    ref: FeatureMap,
    target: FeatureMap,
    k: int = 50,
    kmeans: bool = True,
    seed: int = 0,
    cycle_from: Literal["reference", "target"] = "reference",
    ref_foreground: Mask | None = None,
    target_foreground: Mask | None = None,
    sim: Float[Tensor, "n1 n2"] | None = None,
    matcher: str | Matcher = "cyclical",
    binning: bool = True,
) -> Matches:
    """Find at most k correspondences (sec. 4.1; supplement, "Number and diversity of
    correspondences").

    The 2k patches of smallest cyclical distance (ties: more similar first, then row-major) are
    clustered by k-means on their descriptors into k clusters. The most salient patch of each
    cluster is returned. With fewer than 2k valid cycles all of them are clustered; with at most k,
    all are returned, which may be none.

    Args:
        ref: Feature map of the reference.
        target: Feature map of the target.
        k: Number of matches.
        kmeans: False returns the k best patches without clustering.
        seed: Seed of k-means.
        cycle_from: Image in which cycles start and whose patches are clustered and compared in
            saliency. "reference" is the paper's; "target" follows the cycle step of the published
            code, with its masking.
        ref_foreground: (H1, W1) foreground of the reference; by default `ref.foreground()`.
        target_foreground: (H2, W2) foreground of the target.
        sim: (H1 * W1, H2 * W2) similarities, if they are computed already.
        matcher: "cyclical" ranks by cyclical distance; or another name, or a `Matcher`.
        binning: Compare and cluster log-binned descriptors; False takes the keys themselves.
    """
    if sim is None:
        (sim,) = similarities(ref, [target], binning)
    start = ref
    end = target
    on_start = torch.as_tensor(ref.foreground() if ref_foreground is None else ref_foreground)
    on_end = torch.as_tensor(
        target.foreground() if target_foreground is None else target_foreground
    )
    published = cycle_from == "target"
    if published:
        start, end = end, start
        on_start, on_end = on_end, on_start
        sim = sim.T

    if matcher == "cyclical":
        partner, score = _cycles(sim, on_start, on_end, published)
    else:
        partner, score = _matched_by(matcher, sim, on_start.flatten(), on_end.flatten())
    cosine = sim.gather(1, partner[:, None])[:, 0].numpy()
    score = score.numpy()
    partner = partner.numpy()

    # The finite scores, highest first.
    order = np.lexsort((-cosine, -score))
    order = order[np.isfinite(score[order])]
    if kmeans and len(order) > k:
        order = _most_salient(start, order[: 2 * k], k, seed, binning)
    chosen = order[:k]
    u = np.stack(np.unravel_index(chosen, start.grid), axis=-1)
    v = np.stack(np.unravel_index(partner[chosen], end.grid), axis=-1)
    reference, matched = (v, u) if published else (u, v)
    return Matches(reference, matched, cosine[chosen], -score[chosen])


def _matched_by(
    matcher: str | Matcher,
    sim: Float[Tensor, "n1 n2"],
    on_start: Bool[Tensor, " n1"],
    on_end: Bool[Tensor, " n2"],
) -> Matched:
    """Return what another matcher than "cyclical" finds, on the CPU."""
    if isinstance(matcher, str):
        matcher = pkgutil.resolve_name("zsp_lite.matchers:MATCHERS")[matcher]
    # Copies, since a matcher may overwrite what it gets, such as the similarities of the
    # background.
    partner, score = matcher(sim.clone(), on_start.clone(), on_end.clone())
    if not len(partner) == len(score) == len(sim):
        found = f"{len(partner)} partners and {len(score)} scores"
        raise InputError(
            f"the matcher returned {found}, expected one for each of {len(sim)} patches"
        )
    return torch.as_tensor(partner).cpu(), torch.as_tensor(score).cpu()


def _most_salient(
    features: FeatureMap,
    candidates: Int[np.ndarray, " m"],
    k: int,
    seed: int,
    binning: bool,
) -> Int[np.ndarray, " k"]:
    """Cluster patches into k clusters; return the most salient patch of each, in their order."""
    keys = features.keys.double()[None]
    if binning:
        (built,) = descriptors(keys, bin_indices(features.grid)[:, candidates])
    else:
        built = keys[0].flatten(0, 1)[candidates]
    built = F.normalize(built, dim=1)
    # Rounded, because greedy k-means++ has exact ties (of two points that are each other's nearest,
    # either lowers the sum of squares by the same amount), which rounding errors would break
    # differently each time.
    gram = (built @ built.T).round(decimals=6).numpy()
    clusters = _cluster(gram, k, seed)
    saliency = features.saliency.flatten().numpy()[candidates]
    by_cluster = np.lexsort((-saliency, clusters))  # the most salient of each cluster first
    first = np.unique(clusters[by_cluster], return_index=True)[1]
    return candidates[np.sort(by_cluster[first])]


def _cycles(
    sim: Similarities,
    on1: Mask,
    on2: Mask,
    published: bool = False,
) -> Matched:
    """Find each patch's nearest neighbour, scored as in `cyclical_distances`, or as `published`,
    with the masks of that code."""
    forth, nearest = nearest_neighbours(sim)
    back = nearest[forth]  # u' of each u
    columns = on1.shape[1]
    row = back // columns
    column = back % columns
    u = torch.arange(len(forth))
    offset = torch.stack([u // columns - row, u % columns - column])
    distance = offset.to(torch.float32).square().sum(0).sqrt()
    on1 = torch.as_tensor(on1).flatten()
    # The published code does not check that u' is foreground, and discards every u' in row 0 or
    # column 0: it marks "no cycle" by index 0, and looks for the mark in each coordinate.
    returned = (row > 0) & (column > 0) if published else on1[back]
    valid = on1 & torch.as_tensor(on2).flatten()[forth] & returned
    return forth, torch.where(valid, -distance, -torch.inf)


def _keys(features: Keys) -> Float[Tensor, "h w d"]:
    """Get the keys as a float32 tensor on the CPU."""
    keys = features.keys if isinstance(features, FeatureMap) else features
    return torch.as_tensor(keys).to("cpu", torch.float32)


def _bin_products(products: Float[Tensor, "h1 w1 h2 w2"]) -> Float[Tensor, "h1 w1 h2 w2"]:
    """Sum the products of keys over the 17 bins, as the module's docstring explains."""

    def columns(x: Tensor) -> Tensor:
        """Exchange the rows and the columns of both images."""
        return x.permute(1, 0, 3, 2)

    # Every sum and average is separable: along the rows of both images (axes 0 and 2), then along
    # their columns.
    pooled = average_pool(products, (0, 2))
    near = columns(_joint_shifts(products, 1))
    far = average_pool(columns(_joint_shifts(pooled, 3)), (0, 2))
    centre = average_pool(columns(pooled), (0, 2))
    return columns(_joint_shifts(near, 1).add_(_joint_shifts(far, 3)).sub_(centre))


def _joint_shifts(x: Float[Tensor, "a b c d"], step: int) -> Float[Tensor, "a b c d"]:
    """Sum x shifted by -step, 0 and step along axes 0 and 2 together, each clamped at its
    border."""
    total = x.clone()
    for shift in (-step, step):
        shifted = x
        for axis in (0, 2):
            last = x.shape[axis] - 1
            index = (torch.arange(last + 1) + shift).clamp(0, last)
            shifted = shifted.index_select(axis, index)
        total.add_(shifted)
    return total


def _inverse_norm(keys: Float[Tensor, "h w d"]) -> Float[Tensor, " n"]:
    """Compute 1 / length of each patch's log-binned descriptor."""
    index = bin_indices(tuple(keys.shape[:2]))
    raw = keys.square().sum(-1).flatten()
    pooled = average_pool(keys, (0, 1)).square().sum(-1).flatten()
    squared = raw[index[:9]].sum(0) + pooled[index[9:]].sum(0)
    return squared.clamp_min(torch.finfo(squared.dtype).tiny).rsqrt()


def _cluster(gram: Float[np.ndarray, "m m"], k: int, seed: int) -> Int[np.ndarray, " m"]:
    """Cluster m points, given by their inner products, by k-means; returns their labels."""
    # With one thread, whose rounding decides ties the same way everywhere.
    with one_thread():
        # Eigenvectors scaled by the roots of their eigenvalues are m points in m dimensions of the
        # same inner products, hence the same distances: k-means on them is k-means on the
        # descriptors of 17 D dimensions, but faster.
        values, vectors = np.linalg.eigh(gram)
        points = vectors * np.sqrt(np.maximum(values, 0.0))
        points -= points.mean(0)  # for accuracy
        centres = points[_first_centres(points, k, seed)]
        labels = None
        for _ in range(_ROUNDS):
            found = cdist(centres, points).argmin(0)
            if np.array_equal(found, labels):
                break
            labels = found
            # Equal descriptors (a uniform surface) leave clusters empty: fewer matches.
            members = labels == np.unique(labels)[:, None]
            centres = (members / members.sum(1, keepdims=True)) @ points
        return labels


def _first_centres(points: Float[np.ndarray, "m d"], k: int, seed: int) -> list[np.int64]:
    """Choose k of the points as first centres by greedy k-means++, with scikit-learn's draws."""
    draw = np.random.RandomState(np.random.default_rng(seed).integers(2**31))
    once = np.ones(len(points))
    # Sums are formed as in scikit-learn, because rounding decides ties, of which there are many.
    squares = np.einsum("md,md->m", points, points)
    candidates = draw.choice(len(points), 1, p=once / len(points))
    nearest = np.full(len(points), np.inf)  # squared distances to the nearest centre
    centres = []
    while True:
        apart = squares[candidates, None] - 2 * points[candidates] @ points.T + squares
        closer = np.minimum(nearest, apart.clip(0))
        # The candidate that lowers the sum most becomes a centre.
        best = (closer @ once).argmin()
        nearest = closer[best]
        centres.append(candidates[best])
        if len(centres) == k:
            return centres
        shares = draw.uniform(size=2 + int(np.log(k)))
        candidates = np.searchsorted(nearest.cumsum(), shares * (nearest @ once))
        candidates = candidates.clip(max=len(points) - 1)
