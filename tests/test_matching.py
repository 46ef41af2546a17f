"""Similarity against materialised descriptors, cyclical distances against loops, what `match`
promises, and the other matchers against their definitions, worked out another way."""

import numpy as np
import ot
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.cluster import KMeans
from torch.testing import assert_close

from zsp_lite import matching
from zsp_lite.features import FeatureMap, log_bin
from zsp_lite.matchers import MATCHERS, SOFTMAX_TEMPERATURE, dual_softmax, sinkhorn
from zsp_lite.matching import cyclical_distances, key_similarities, match, similarity

sides = st.integers(1, 8)
seeds = st.integers(0, 2**32 - 1)


def descriptors(keys: torch.Tensor) -> torch.Tensor:
    """The normalised log-binned descriptors of all patches, (H * W, 17 * D)."""
    return F.normalize(log_bin(keys[None])[0].flatten(0, 1), dim=1)


def feature_map(seed: int, grid=(9, 9), channels: int = 16, saliency=None) -> FeatureMap:
    """Random features."""
    generator = torch.Generator().manual_seed(seed)
    keys = torch.randn(*grid, channels, generator=generator)
    saliency = torch.rand(grid, generator=generator) if saliency is None else saliency
    return FeatureMap(keys, saliency, keys.mean((0, 1)))


def cycles_by_loops(sim: np.ndarray, grid1, grid2, fg1, fg2, published=False) -> np.ndarray:
    """Return -d(u, u') of equation 2, -inf off the foreground.

    Published cycles return to any patch but those of the first row and column, also off the
    foreground.
    """
    result = np.full(grid1, -np.inf)
    for u in range(sim.shape[0]):
        v = int(np.argmax(sim[u]))
        back = int(np.argmax(sim[:, v]))
        places = [divmod(u, grid1[1]), divmod(back, grid1[1])]
        returned = min(places[1]) > 0 if published else fg1[places[1]]
        if fg1[places[0]] and returned and fg2[divmod(v, grid2[1])]:
            result[places[0]] = -np.hypot(*np.subtract(*places))
    return result


@settings(max_examples=40)
@given(sides, sides, sides, sides, seeds)
def test_similarity_is_the_cosine_of_materialised_descriptors(h1, w1, h2, w2, seed):
    generator = torch.Generator().manual_seed(seed)
    ref = torch.randn(h1, w1, 5, generator=generator) + 0.5
    target = torch.randn(h2, w2, 5, generator=generator)
    expected = descriptors(ref.double()) @ descriptors(target.double()).T
    assert_close(similarity(ref, target).double(), expected, atol=1e-5, rtol=0)


def test_similarity_takes_maps_tensors_and_arrays():
    ref, target = feature_map(0, (4, 6)), feature_map(1, (5, 3))
    sim = similarity(ref, target)
    assert_close(similarity(ref.keys.numpy().astype(np.float64), target.keys), sim)


def test_descriptors_without_length_are_similar_to_nothing():
    assert not similarity(torch.zeros(4, 4, 3), torch.ones(4, 4, 3)).any()


@settings(max_examples=40)
@given(sides, sides, sides, sides, seeds)
def test_cyclical_distances_follow_equation_2(h1, w1, h2, w2, seed):
    rng = default_rng(seed)
    sim = rng.normal(size=(h1 * w1, h2 * w2))
    fg1, fg2 = rng.random((h1, w1)) < 0.7, rng.random((h2, w2)) < 0.7
    expected = cycles_by_loops(sim, (h1, w1), (h2, w2), fg1, fg2)
    cyclical = cyclical_distances(sim, (h1, w1), (h2, w2), fg1, fg2)
    assert_allclose(cyclical.numpy(), expected, rtol=1e-6)


def test_matches_are_cycles_with_their_similarity_and_distance():
    ref, target = feature_map(0), feature_map(1, (7, 10))
    sim = similarity(ref, target).numpy()
    on_ref, on_target = torch.ones(9, 9, dtype=torch.bool), np.ones((7, 10), dtype=bool)
    on_ref[2:7, :6], on_target[1:6, 2:] = False, False
    cycles = cycles_by_loops(sim, ref.grid, target.grid, on_ref.numpy(), on_target)
    matches = match(ref, target, k=8, ref_foreground=on_ref, target_foreground=on_target)
    assert len(matches) == 8
    u = matches.reference @ (9, 1)
    v = sim[u].argmax(1)
    assert_array_equal(matches.target @ (10, 1), v)
    assert_array_equal(matches.similarity, sim[u, v])
    assert_allclose(-matches.distance, cycles[tuple(matches.reference.T)])
    assert (np.diff(matches.distance) >= 0).all()


def test_without_binning_bare_keys_are_matched_and_clustered():
    ref, target = feature_map(3), feature_map(4)
    (sim,) = key_similarities(ref, [target])
    bare, binned, computed = (
        match(ref, target, k=20, binning=binning, sim=some).reference
        for binning, some in ((False, sim), (True, sim), (False, None))
    )
    assert_array_equal(computed, bare)
    assert not np.array_equal(bare, binned)


def test_without_kmeans_the_k_best_cycles_are_taken_ties_by_similarity():
    ref, target = feature_map(2), feature_map(3)
    everything = match(ref, target, k=81, kmeans=False)  # all of 9 x 9 patches
    keys = list(zip(everything.distance, -everything.similarity))
    assert keys == sorted(keys)
    assert_array_equal(match(ref, target, k=7, kmeans=False).reference, everything.reference[:7])


def test_kmeans_keeps_the_most_salient_patch_of_each_group_of_like_patches():
    # Three regions, far apart in feature space, and two candidates in the middle of each.
    noise = torch.randn(27, 6, 3, generator=torch.Generator().manual_seed(0))
    keys = torch.eye(3)[torch.arange(27) // 9][:, None] + 0.02 * noise
    saliency = torch.full((27, 6), 0.1)
    for row, least, most in ((4, 1, 4), (13, 3, 0), (22, 2, 5)):
        saliency[row, least], saliency[row, most] = 0.5, 0.9
    features = FeatureMap(keys, saliency, torch.zeros(3))
    six = saliency > 0.2
    matches = match(features, features, k=3, ref_foreground=six, target_foreground=six)
    assert sorted(matches.reference.tolist()) == [[4, 4], [13, 0], [22, 5]]
    assert_array_equal(matches.target, matches.reference)
    assert_array_equal(matches.distance, 0)


@pytest.mark.parametrize("cycle_from", ["reference", "target"])
def test_without_foreground_there_are_no_matches(cycle_from):
    empty = feature_map(9, saliency=torch.zeros(9, 9))
    matches = match(empty, feature_map(10), cycle_from=cycle_from)
    assert matches.reference.shape == matches.target.shape == (0, 2)
    assert matches.similarity.shape == matches.distance.shape == (0,)


def test_equal_descriptors_everywhere_neither_warn_nor_fail(recwarn):
    uniform = FeatureMap(torch.ones(6, 6, 4), torch.ones(6, 6), torch.ones(4))
    assert 1 <= len(match(uniform, uniform, k=5)) <= 5
    assert not recwarn.list


def test_cycles_from_the_target_are_the_published_cycles_of_the_swapped_pair():
    ref, target = feature_map(11), feature_map(12, (8, 10))
    matches = match(ref, target, k=81, kmeans=False, cycle_from="target")
    sim = similarity(ref, target)
    on_target, on_ref = target.foreground(), ref.foreground()
    ends = (target.grid, ref.grid, on_target.numpy(), on_ref.numpy())
    cycles = cycles_by_loops(sim.T.numpy(), *ends, published=True)
    assert len(matches) == np.isfinite(cycles).sum() > 0
    assert_allclose(-matches.distance, cycles[tuple(matches.target.T)])
    forth = sim.argmax(0).numpy()
    assert_array_equal(matches.reference @ (9, 1), forth[matches.target @ (10, 1)])


def test_clusters_are_those_of_scikit_learn():
    for seed in range(20):
        # Neighbours in a row of 100 patches are alike.
        points = default_rng(seed).normal(size=(100, 60)).cumsum(0)
        gram = (points @ points.T).round(6)
        values, vectors = np.linalg.eigh(gram)
        kmeans = KMeans(50, n_init=1, random_state=default_rng(seed).integers(2**31))
        expected = kmeans.fit_predict(vectors * values.clip(0) ** 0.5)
        assert_array_equal(matching._cluster(gram, 50, seed), expected)


# Similarities of the 12 patches of one image and the 15 of another, and which patches are on the
# object: not every fourth of the first image, nor every third of the second.
SIMILARITIES = torch.rand(12, 15, generator=torch.Generator().manual_seed(0))
ON_FIRST = torch.arange(12) % 4 > 0
ON_SECOND = torch.arange(15) % 3 > 0


def test_the_transport_plan_is_that_of_pot():
    uniform = [np.full(n, 1 / n) for n in SIMILARITIES.shape]
    cost = 1 - SIMILARITIES.double()
    # So many steps that both have converged.
    steps = 5000
    expected = ot.sinkhorn(*uniform, cost.numpy(), reg=0.05, numItermax=steps, stopThr=1e-14)
    plan = sinkhorn(cost, regularisation=0.05, steps=steps)
    assert_allclose(plan.numpy(), expected, rtol=0, atol=1e-9)


def test_the_dual_softmax_is_the_product_of_two_softmaxes():
    logits = SIMILARITIES / SOFTMAX_TEMPERATURE
    product = logits.softmax(0) * logits.softmax(1)
    partner, score = dual_softmax(SIMILARITIES)
    assert_array_equal(partner, product.argmax(1))
    assert_allclose(score.exp().numpy(), product.max(1).values.numpy(), rtol=1e-4)


def test_mutual_neighbours_are_each_others_choice_among_the_objects_patches():
    partner, score = MATCHERS["mutual"](SIMILARITIES, ON_FIRST, ON_SECOND)
    # Patches off the object are less similar than all others.
    hidden = SIMILARITIES.clone()
    hidden[~ON_FIRST] = hidden[:, ~ON_SECOND] = -1
    for u in range(len(hidden)):
        v = int(hidden[u].argmax())
        if ON_FIRST[u] and int(hidden[:, v].argmax()) == u:
            assert partner[u] == v
            assert score[u] == SIMILARITIES[u, v]
        else:
            assert score[u] == -torch.inf


@pytest.mark.parametrize("name", MATCHERS)
def test_matched_patches_and_their_partners_are_on_the_object(name):
    partner, score = MATCHERS[name](SIMILARITIES, ON_FIRST, ON_SECOND)
    matched = score.isfinite()
    assert matched.any()
    assert ON_FIRST[matched].all()
    assert ON_SECOND[partner[matched]].all()
    _, without = MATCHERS[name](SIMILARITIES, ON_FIRST, torch.zeros_like(ON_SECOND))
    assert not without.isfinite().any()


@pytest.mark.parametrize("name", MATCHERS)
def test_every_matcher_finds_an_image_in_itself(name):
    features = feature_map(3)
    matches = match(features, features, k=10, matcher=name)
    assert len(matches) == 10
    assert_array_equal(matches.reference, matches.target)
    assert_allclose(matches.similarity, np.ones(10), atol=1e-5)


def test_plain_similarity_is_the_cosine_of_the_keys():
    first, second = feature_map(5), feature_map(6)
    (sim,) = key_similarities(first, [second])
    cosine = F.cosine_similarity(first.keys[2, 3], second.keys[4, 5], dim=0)
    # Patches are counted by rows of 9.
    assert_allclose(sim[2 * 9 + 3, 4 * 9 + 5], cosine, atol=1e-6)
