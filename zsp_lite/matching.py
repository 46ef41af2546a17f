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

import threading
import warnings
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap, Grid, average_pool, bin_indices
from zsp_lite.matchers import MATCHERS, Matcher
from zsp_lite.threads import one_thread

Keys = FeatureMap | Float[Tensor, "_ _ _"] | Float[np.ndarray, "_ _ _"]

_filters = threading.Lock()  # of warnings: threads would restore each other's


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
    return similarities(ref, [target])[0]


def similarities(
    ref: Keys, targets: list[Keys], binning: bool = True
) -> list[Float[Tensor, "n1 n2"]]:
    """Compute `similarity` of one reference with several targets, or `key_similarities` without
    `binning`."""
    if not binning:
        return key_similarities(ref, targets)
    keys1 = _keys(ref)
    inverse_norm1 = _inverse_norm(keys1)
    results = []
    for target in targets:
        keys2 = _keys(target)
        products = keys1.flatten(0, 1) @ keys2.flatten(0, 1).T  # (H1 W1, H2 W2)
        summed = _bin_products(products.view(*keys1.shape[:2], *keys2.shape[:2]))
        # In place: the matrices are the largest arrays of the method.
        cosines = summed.view(products.shape).mul_(inverse_norm1[:, None])
        results.append(cosines.mul_(_inverse_norm(keys2)))
    return results


def key_similarities(ref: Keys, targets: list[Keys]) -> list[Float[Tensor, "n1 n2"]]:
    """Compute the cosine similarities of the keys themselves, without log-binning (see
    `similarities`)."""
    reference, *others = [
        F.normalize(_keys(features).flatten(0, 1), dim=1) for features in (ref, *targets)
    ]
    return [reference @ other.T for other in others]


def nearest_neighbours(
    sim: Float[Tensor, "n1 n2"] | Float[np.ndarray, "n1 n2"],
) -> tuple[Int[Tensor, " n1"], Int[Tensor, " n2"]]:
    """Find each row's most similar column and each column's most similar row (the argmins of eq.
    2)."""
    sim = torch.as_tensor(sim)
    return sim.argmax(dim=1), sim.argmax(dim=0)


def cyclical_distances(
    sim: Float[Tensor, "n1 n2"] | Float[np.ndarray, "n1 n2"],
    grid1: Grid,
    grid2: Grid,
    fg1: Bool[Tensor, "h1 w1"] | Bool[np.ndarray, "h1 w1"] | None = None,
    fg2: Bool[Tensor, "h2 w2"] | Bool[np.ndarray, "h2 w2"] | None = None,
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
    sim = torch.as_tensor(sim)
    on1 = torch.ones(grid1, dtype=torch.bool) if fg1 is None else torch.as_tensor(fg1)
    on2 = torch.ones(grid2, dtype=torch.bool) if fg2 is None else torch.as_tensor(fg2)
    return _cycles(sim, on1.to(sim.device), on2.to(sim.device))[0].view(grid1)


def match(
    ref: FeatureMap,
    target: FeatureMap,
    k: int = 50,
    kmeans: bool = True,
    seed: int | np.random.Generator = 0,
    cycle_from: Literal["reference", "target"] = "reference",
    ref_foreground: Bool[Tensor, "h1 w1"] | Bool[np.ndarray, "h1 w1"] | None = None,
    target_foreground: Bool[Tensor, "h2 w2"] | Bool[np.ndarray, "h2 w2"] | None = None,
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
        seed: Seed or generator of k-means.
        cycle_from: Image in which cycles start and whose patches are clustered and compared in
            saliency. "reference" is the paper's; "target" follows the cycle step of the published
            code, with its masking.
        ref_foreground: (H1, W1) foreground of the reference; by default `ref.foreground()`.
        target_foreground: (H2, W2) foreground of the target.
        sim: (H1 * W1, H2 * W2) similarities, if they are computed already.
        matcher: "cyclical" ranks by cyclical distance; or a name in `MATCHERS`, or a `Matcher`.
        binning: Compare and cluster log-binned descriptors; False takes the keys themselves.
    """
    if sim is None:
        (sim,) = similarities(ref, [target], binning)
    if ref_foreground is None:
        ref_foreground = ref.foreground()
    if target_foreground is None:
        target_foreground = target.foreground()
    on_start = torch.as_tensor(ref_foreground)
    on_end = torch.as_tensor(target_foreground)

    # Both stages are about the image in which cycles start.
    forward = cycle_from == "reference"
    start = ref
    end = target
    if not forward:
        start = target
        end = ref
        on_start, on_end = on_end, on_start
        sim = sim.T
    ranked = _rank(sim, on_start, on_end, matcher, published=not forward)
    chosen = _select(ranked, start, k, kmeans, seed, binning)

    u = np.stack(np.unravel_index(chosen, start.grid), axis=-1)
    v = np.stack(np.unravel_index(ranked.partner[chosen], end.grid), axis=-1)
    reference, matched = (u, v) if forward else (v, u)
    return Matches(reference, matched, ranked.similarity[chosen], -ranked.score[chosen])


class _Ranked(NamedTuple):
    """What a matcher says of each patch of one image."""

    score: Float[np.ndarray, " n1"]  # higher is better; not finite without a match
    partner: Int[np.ndarray, " n1"]  # index of a patch of the other image
    similarity: Float[np.ndarray, " n1"]  # of the patch and its partner


def _rank(
    sim: Float[Tensor, "n1 n2"],
    on_start: Bool[Tensor, "h1 w1"],
    on_end: Bool[Tensor, "h2 w2"],
    matcher: str | Matcher,
    published: bool,
) -> _Ranked:
    """Find the partner of each patch of the first image, and the score of the two."""
    if matcher == "cyclical":
        score, partner = _cycles(sim, on_start, on_end, published)
    else:
        if isinstance(matcher, str):
            matcher = MATCHERS[matcher]
        # Copies, since a matcher may overwrite what it gets, such as the similarities of the
        # background.
        partner, score = matcher(sim.clone(), on_start.flatten().clone(), on_end.flatten().clone())
        partner = torch.as_tensor(partner).cpu()
        score = torch.as_tensor(score).cpu()
        if not len(partner) == len(score) == len(sim):
            found = f"{len(partner)} partners and {len(score)} scores"
            raise InputError(
                f"the matcher returned {found}, expected one for each of {len(sim)} patches"
            )
    cosines = sim.gather(1, partner[:, None])[:, 0]
    return _Ranked(score.numpy(), partner.numpy(), cosines.numpy())


def _select(
    ranked: _Ranked,
    features: FeatureMap,
    k: int,
    kmeans: bool,
    seed: int | np.random.Generator,
    binning: bool,
) -> Int[np.ndarray, " m"]:
    """Select at most k patches, best first: those of the highest scores, or of twice as many the
    most salient of each cluster."""
    order = np.lexsort((-ranked.similarity, -ranked.score))
    order = order[np.isfinite(ranked.score[order])]
    if not kmeans or len(order) <= k:
        return order[:k]
    order = order[: 2 * k]
    clusters = _cluster(_gram(features, order, binning), k, np.random.default_rng(seed))
    saliency = features.saliency.flatten().numpy()[order]
    by_cluster = np.lexsort((-saliency, clusters))  # the most salient of each cluster first
    first = np.unique(clusters[by_cluster], return_index=True)[1]
    return order[np.sort(by_cluster[first])]


def _cycles(
    sim: Float[Tensor, "n1 n2"],
    on1: Bool[Tensor, "h1 w1"],
    on2: Bool[Tensor, "h2 w2"],
    published: bool = False,
) -> tuple[Float[Tensor, " n1"], Int[Tensor, " n1"]]:
    """Compute the scores of `cyclical_distances`, and each foreground patch's nearest neighbour; 0
    for the others.

    Only the foreground's neighbours, and of the patches of image 2 only theirs, are searched for.
    """
    columns = on1.shape[1]
    on1 = on1.flatten()
    on2 = on2.flatten()
    # Patches by their index: u on the foreground, its neighbour v (`forth`), and v's u' (`back`).
    u = on1.nonzero()[:, 0]
    forth = sim[u].argmax(dim=1)
    reached, position = forth.unique(return_inverse=True)
    back = sim[:, reached].argmax(dim=0)[position]
    row = back // columns
    column = back % columns
    offset = torch.stack([u // columns - row, u % columns - column])
    distance = offset.to(torch.float32).square().sum(0).sqrt()
    # The published code does not check that u' is foreground, and discards every u' in row 0 or
    # column 0: it marks "no cycle" by index 0, and looks for the mark in each coordinate.
    returned = (row > 0) & (column > 0) if published else on1[back]
    valid = on2[forth] & returned
    score = torch.full((len(sim),), -torch.inf, device=sim.device)
    score[u] = torch.where(valid, -distance, -torch.inf)
    neighbour = torch.zeros(len(sim), dtype=torch.long, device=sim.device)
    neighbour[u] = forth
    return score, neighbour


def _keys(features: Keys) -> Float[Tensor, "h w d"]:
    """Get the keys as a float32 tensor."""
    keys = features.keys if isinstance(features, FeatureMap) else features
    return torch.as_tensor(keys).to(torch.float32)


def _bin_products(products: Float[Tensor, "h1 w1 h2 w2"]) -> Float[Tensor, "h1 w1 h2 w2"]:
    """Sum the products of keys over the 17 bins, as the module's docstring explains."""

    def columns(x: Tensor) -> Tensor:
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
            index = (torch.arange(last + 1, device=x.device) + shift).clamp(0, last)
            shifted = shifted.index_select(axis, index)
        total.add_(shifted)
    return total


def _inverse_norm(keys: Float[Tensor, "h w d"]) -> Float[Tensor, " n"]:
    """Compute 1 / length of each patch's log-binned descriptor."""
    index = bin_indices(tuple(keys.shape[:2])).to(keys.device)
    raw = keys.square().sum(-1).flatten()
    pooled = average_pool(keys, (0, 1)).square().sum(-1).flatten()
    squared = raw[index[:9]].sum(0) + pooled[index[9:]].sum(0)
    return squared.clamp_min(torch.finfo(squared.dtype).tiny).rsqrt()


def _gram(
    features: FeatureMap, index: Int[np.ndarray, " m"], binning: bool = True
) -> Float[np.ndarray, "m m"]:
    """Compute the cosines between the descriptors of a few patches, which are few enough to
    build."""
    keys = features.keys.double()
    index = torch.from_numpy(index)
    descriptors = keys.flatten(0, 1)[index]
    if binning:
        bins = bin_indices(features.grid)[:, index]  # (17, m)
        near = keys.flatten(0, 1)[bins[:9]]
        far = average_pool(keys, (0, 1)).flatten(0, 1)[bins[9:]]
        descriptors = torch.cat([near, far]).transpose(0, 1).flatten(1)  # (m, 17 D)
    descriptors = F.normalize(descriptors, dim=1)
    # Rounded, because greedy k-means++ has exact ties (of two points that are each other's nearest,
    # either lowers the sum of squares by the same amount), which rounding errors would break
    # differently each time.
    return (descriptors @ descriptors.T).round(decimals=6).numpy()


def _cluster(
    gram: Float[np.ndarray, "m m"], k: int, rng: np.random.Generator
) -> Int[np.ndarray, " m"]:
    """Cluster m points, given by their inner products, by k-means; returns their labels."""
    # Imported here: it takes a second, and the verified solver does not cluster.
    from sklearn.cluster import KMeans
    from sklearn.exceptions import ConvergenceWarning

    with one_thread(), _filters, warnings.catch_warnings():
        # Eigenvectors scaled by the roots of their eigenvalues are m points in m dimensions of the
        # same inner products, hence the same distances: k-means on them is k-means on the
        # descriptors of 17 D dimensions, but faster.
        values, vectors = np.linalg.eigh(gram)
        points = vectors * np.sqrt(np.maximum(values, 0.0))
        # Equal descriptors (a uniform surface) leave clusters empty: that gives fewer matches and
        # needs no warning.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return KMeans(k, n_init=1, random_state=int(rng.integers(2**31))).fit(points).labels_
