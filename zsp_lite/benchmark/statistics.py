"""Bootstrap intervals of figures over pairs.

Pairs that share an object are not independent: `object_draws` resamples objects, and its draws give
the intervals of this project. Draws are weights: a row for each bootstrap replicate, a column for
each pair.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from zsp_lite.io.files import stable_hash

Draws = Float[np.ndarray, "resamples n"]
RESAMPLES = 2000  # number of bootstrap replicates
_FEWEST_OBJECTS = 3  # two objects have one pair in each direction: nothing to resample


def object_draws(objects: ArrayLike, categories: ArrayLike = "") -> Draws:
    """Draw bootstrap weights (resamples, n) of pairs by resampling the objects (n, 2) that the
    pairs are made of. Categories (n,) are those of the pairs, by default one.

    In each replicate the objects of a category are drawn with replacement, and the weight of a pair
    is the product of its two objects' multiplicities: the pigeonhole bootstrap (Owen 2007) with one
    set of objects on both sides. If the errors depend little on the objects, the intervals are too
    wide: the estimated variance is then up to three times the true one. Every category keeps its
    total weight. Pairs of fewer than three objects are resampled themselves.
    """
    objects = np.asarray(objects, dtype=str)
    categories = np.broadcast_to(np.asarray(categories, dtype=str), len(objects))
    weights = np.empty((RESAMPLES, len(objects)))  # a column for each pair
    for category in np.unique(categories):
        # A seed for each category: its draws do not depend on the other categories.
        rng = np.random.default_rng([0, stable_hash(category)])
        members = np.nonzero(categories == category)[0]
        names, sides = np.unique(objects[members], return_inverse=True)
        first, second = sides.reshape(-1, 2).T
        drawn = np.zeros((RESAMPLES, len(members)))
        # A draw without both objects of any pair has no weight at all and is repeated.
        empty = np.arange(RESAMPLES)
        while len(empty):
            if len(names) < _FEWEST_OBJECTS:
                drawn[empty] = multiplicities(len(members), rng, len(empty))
            else:
                counts = multiplicities(len(names), rng, len(empty))
                drawn[empty] = counts[:, first] * counts[:, second]
            empty = np.flatnonzero(drawn.sum(axis=1) == 0)
        weights[:, members] = drawn * (len(members) / drawn.sum(axis=1, keepdims=True))
    return weights


def interval_of(replicates: Float[np.ndarray, "*figures resamples"]) -> list:
    """Return the ends of the 95 % percentile bootstrap interval of each figure."""
    ends = np.percentile(replicates, [2.5, 97.5], axis=-1)
    return np.moveaxis(ends, 0, -1).tolist()


def multiplicities(
    n: int, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Int[np.ndarray, "resamples n"]:
    """Count how often each of n items is drawn if n are drawn with replacement."""
    # The items of replicate r are counted from r * n on.
    draws = rng.integers(n, size=(resamples, n)) + n * np.arange(resamples)[:, None]
    return np.bincount(draws.ravel(), minlength=resamples * n).reshape(resamples, n)
