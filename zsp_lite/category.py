r"""All objects of a category in one common frame, without labels: synchronisation of the hypotheses
of many pairs.

Here a pair is a pair of objects (a, b) with a few hypotheses: similarities from the world of a to
that of b, with probabilities, of a frame of a that the verified solver found in views of b, or of
all that was seen of both (see `judge`). Two objects may have several.

One pair often cannot tell the front from the back; all pairs mostly can (Birdal et al.,
Synchronizing probability measures on rotations, CVPR 2020). Sought is a similarity x -> s_i Q_i x +
t_i from the world of each object i to a common frame. Hypothesis h of a pair, of rotation H_h,
agrees with the rotations if Q_a = Q_b H_h. With \theta_h the angle between the two, they maximise

    \sum_{pairs} \log(\epsilon + \sum_h p_h \exp(\kappa (\cos\theta_h - 1))),

the logarithm of a mixture of von Mises-Fisher densities and a uniform one, which limits the cost of
a wrong pair.

1. Search: many chains set one object after the other to a rotation that a hypothesis proposes,
   sampled by its probability given all others (Gibbs sampling; Geman and Geman 1984), at a
   temperature that falls to zero.
2. Averaging on the rotation group (Hartley et al., Rotation averaging, IJCV 2013): each rotation in
   turn becomes the mean of the proposals, weighted by how well they agree (expectation
   maximisation).
3. Scales, linear in their logarithms, then translations: least absolute deviations over the
   hypotheses that agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from zsp_lite.alignment import Sim3, nearest_rotation
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate
from zsp_lite.metrics import SAME_ANGLE, rotation_angle

# \kappa of the objective: a hypothesis 20 degrees off counts 1/e of one that agrees.
KAPPA = 16.0
# \epsilon of the objective, where a sure hypothesis that agrees counts 1.
FLOOR = 0.1
# All pairs of a category are solved below this number of objects, since pairs grow as its square;
# from it on, each object is the reference of a few.
ALL_PAIRS_BELOW = 12
PAIRS_PER_OBJECT = 6
_CHAINS = 48  # chains of the search, of which the best one is kept
# Temperature of each sweep over all objects: a slow fall, then coordinate ascent.
_TEMPERATURES = (*np.geomspace(1, 0.3, 12), 0.0, 0.0, 0.0, 0.0)
_PROPOSERS = 8  # pairs of an object that propose rotations in a step, which bounds its time
_AVERAGING_SWEEPS = 6  # sweeps over all objects
_REWEIGHTINGS = 10  # steps of the least absolute deviations
# Weight of hypotheses that disagree, so that every object gets a scale and a translation.
_WEAK = 1e-3
# Coefficients of the logit in `_judge`: of the margin, of the case that no rotation is right, and
# of the share of agreeing pairs in this case. tools/judge.py fits them on validation
# categories to sets of three and four objects.
MARGIN = 2.71
NONE = -0.59
NONE_AGREEING = -2.93

_Rotations = Float[np.ndarray, "t n 3 3"]  # of n objects in each of t chains
_Candidates = Float[np.ndarray, "t c 3 3"]  # for the rotation of one object
_Proposals = Float[np.ndarray, "t d m 3 3"]  # of m hypotheses of each of d pairs of one object


@dataclass(frozen=True, eq=False)
class PairHypotheses:
    """Candidate similarities from the world of one object to that of another, with their
    probabilities."""

    reference: str  # name of the object that the similarities start from
    target: str  # name of the object that they lead to
    sim3s: tuple[Sim3, ...]  # most probable first
    probabilities: Float[np.ndarray, " m"]
    centre: Float[np.ndarray, "3"]  # a point amid the reference object, in its world


@dataclass(frozen=True, eq=False)
class AlignedObject:
    """Pose of one object in the common frame of its category."""

    sim3: Sim3  # from the object's world to the common frame
    centre: Float[np.ndarray, "3"]  # of the object, in its world
    # probability that the rotation is within 30 degrees of the one that most objects agree with
    probability: float
    # next best pose, more than 30 degrees off, all other objects fixed; None without one
    alternative: Sim3 | None
    alternative_probability: float  # probability that the alternative is the right one


@dataclass(frozen=True, eq=False)
class CategoryAlignment:
    """All objects of a category in one frame: that of the first object, with a mean log scale of
    zero."""

    objects: dict[str, AlignedObject]  # by name, sorted
    pairs: tuple[PairHypotheses, ...]  # the hypotheses that were synchronised
    # by (reference, target): median angle between the alignment and the best hypothesis of each
    # pair of frames; only angles above 30 degrees, largest first
    disagreements: dict[tuple[str, str], float]

    def between(self, reference: str, target: str) -> Sim3:
        """Return the similarity from the world of one object to that of another."""
        return self.objects[target].sim3.inverse() @ self.objects[reference].sim3


def partners(names: Sequence[str], per_object: int | None) -> list[tuple[str, str]]:
    """Choose the pairs of objects that a category is aligned by.

    Each object has at least `per_object` partners; None for all others, or from twelve objects on,
    for six.
    """
    n = len(names)
    if per_object is None:
        per_object = n - 1 if n < ALL_PAIRS_BELOW else PAIRS_PER_OBJECT
    if per_object >= n - 1:
        return list(combinations(sorted(names), 2))
    # The objects stand in a random circle. Each has those as partners that are some steps before
    # and after it.
    rng = np.random.default_rng(0)
    circle = [sorted(names)[k] for k in rng.permutation(n)]
    steps = [1, *(2 + rng.permutation(n // 2 - 1)).tolist()]  # the first connects all objects
    steps = steps[: (per_object + 1) // 2]
    pairs = {tuple(sorted((circle[k], circle[(k + step) % n]))) for k in range(n) for step in steps}
    return sorted(pairs)


def world_hypotheses(reference: str, target: str, estimate: PoseEstimate) -> PairHypotheses:
    """Convert the hypotheses of the verified solver to similarities between the worlds of two
    objects, by name."""
    sim3s = tuple(estimate.between_worlds(one.sim3, one.view) for one in estimate.hypotheses)
    probabilities = np.array([one.confidence for one in estimate.hypotheses])
    view = estimate.reference_view
    centre = view.frame.camera.to_world(
        np.median(view.measured_points[0][view.known_foreground], axis=0)
    )
    return PairHypotheses(reference, target, sim3s, probabilities, centre)


def synchronise(pairs: Sequence[PairHypotheses]) -> CategoryAlignment:
    """Find the similarities from the objects' worlds to one frame that agree best with the
    hypotheses of all pairs.

    Two objects may have several pairs. The order does not matter. InputError if the pairs do not
    connect all objects.
    """
    pairs = sorted(pairs, key=lambda pair: (pair.reference, pair.target, pair.centre.tolist()))
    names = sorted({name for pair in pairs for name in (pair.reference, pair.target)})
    ends = np.array([[names.index(pair.reference), names.index(pair.target)] for pair in pairs])
    order = _connected(names, ends)

    # The three steps of the module's docstring.
    nodes = _build_nodes(pairs, ends)
    rotations = _search(nodes, order, np.random.default_rng(0))
    scales, translations, centres = _scales_and_translations(pairs, ends, rotations)

    # How sure each object's rotation is, and its best alternative.
    best = np.stack([pair.sim3s[0].R for pair in pairs])
    off = rotation_angle(rotations[ends[:, 0]], rotations[ends[:, 1]] @ best)
    objects = {}
    for i, name in enumerate(names):
        sim3 = Sim3(scales[i], rotations[i], translations[i])
        agreeing = off[(ends == i).any(axis=1)] < SAME_ANGLE
        probability, turned, other = _judge(nodes[i], rotations, i, float(agreeing.mean()))
        if len(pairs) == 1:  # its own probabilities say more
            probability, other, *_ = (*pairs[0].probabilities.tolist(), 0.0)
        alternative = None
        if turned is not None:  # about the object's centre
            shift = sim3.apply(centres[i]) - scales[i] * turned @ centres[i]
            alternative = Sim3(scales[i], turned, shift)
        objects[name] = AlignedObject(sim3, centres[i], probability, alternative, other)
    return CategoryAlignment(objects, tuple(pairs), _disagreements(names, ends, off))


def _connected(names: Sequence[str], ends: Int[np.ndarray, "e 2"]) -> Int[np.ndarray, " n"]:
    """Order the objects so that each has a pair with an earlier one; InputError if this is
    impossible."""
    links = coo_array((np.ones(len(ends)), ends.T), [len(names)] * 2)
    order = breadth_first_order(links.tocsr(), 0, directed=False, return_predecessors=False)
    if len(order) < len(names):
        raise InputError(
            f"pairs connect {len(order)} of {len(names)} objects with {names[0]}, expected all"
        )
    return order


def _disagreements(
    names: Sequence[str], ends: Int[np.ndarray, "e 2"], off: Float[np.ndarray, " e"]
) -> dict[tuple[str, str], float]:
    """Return the median angle of each pair of objects that disagrees, largest first."""
    angles = {}
    for a, b in ends:
        of_both = (ends == (a, b)).all(axis=1)
        angles[names[a], names[b]] = float(np.median(off[of_both]))
    worst_first = sorted(angles, key=angles.get, reverse=True)
    return {key: angles[key] for key in worst_first if angles[key] > SAME_ANGLE}


@dataclass(frozen=True, eq=False)
class _Node:
    """One object, and what the hypotheses of its pairs say about its rotation."""

    neighbour: Int[np.ndarray, " d"]  # the other object of each pair
    turn: Float[np.ndarray, "d m 3 3"]  # proposes Q = Q_neighbour @ turn
    weight: Float[np.ndarray, "d m"]  # probabilities; 0 where padded

    def proposals(self, rotations: _Rotations) -> _Proposals:
        """Return the rotations that the hypotheses propose."""
        return rotations[:, self.neighbour][:, :, None] @ self.turn

    def agreement(
        self, candidates: _Candidates, proposals: _Proposals
    ) -> Float[np.ndarray, "t c d m"]:
        r"""Return \exp(\kappa (\cos\theta - 1)) of candidates and proposals; \cos\theta = (trace -
        1) / 2."""
        t, c = candidates.shape[:2]
        trace = candidates.reshape(t, c, 9) @ proposals.reshape(t, -1, 9).swapaxes(1, 2)
        return np.exp(KAPPA / 2 * (trace - 3)).reshape(t, c, *self.weight.shape)

    def score(self, candidates: _Candidates, proposals: _Proposals) -> Float[np.ndarray, "t c"]:
        """Return the part of the objective that depends on this object, for candidates of its
        rotation."""
        agreement = self.agreement(candidates, proposals)
        return np.log(np.einsum("tcdm,dm->tcd", agreement, self.weight) + FLOOR).sum(axis=2)

    def mean(
        self, present: Float[np.ndarray, "t 3 3"], proposals: _Proposals
    ) -> Float[np.ndarray, "t 3 3"]:
        """Return the mean of the proposals, weighted by the probability that each is the pair's
        right one."""
        weight = self.weight * self.agreement(present[:, None], proposals)[:, 0]
        weight /= weight.sum(axis=2, keepdims=True) + FLOOR
        return nearest_rotation(np.einsum("tdm,tdmij->tij", weight, proposals))[0]


def _build_nodes(pairs: Sequence[PairHypotheses], ends: Int[np.ndarray, "e 2"]) -> list[_Node]:
    """Sort the hypotheses of e pairs by object."""
    most = max(len(pair.sim3s) for pair in pairs)
    rows: list[list[tuple]] = [[] for _ in range(ends.max() + 1)]
    for (a, b), pair in zip(ends, pairs):
        turn = np.array([one.R for one in pair.sim3s], np.float32)
        turn = np.resize(turn, (most, 3, 3))  # padded by repetition
        weight = np.pad(pair.probabilities, (0, most - len(pair.sim3s))).astype(np.float32)
        rows[a].append((b, turn, weight))
        rows[b].append((a, turn.swapaxes(1, 2), weight))
    return [_Node(*(np.array(column) for column in zip(*row))) for row in rows]


def _search(
    nodes: list[_Node], order: Int[np.ndarray, " n"], rng: np.random.Generator
) -> Float[np.ndarray, "n 3 3"]:
    """Return the rotations that maximise the objective, relative to the first object's."""
    rotations = np.tile(np.eye(3, dtype=np.float32), (_CHAINS, len(nodes), 1, 1))  # (t, n, 3, 3)
    # In this order, each object has a pair with an earlier one.
    for k, i in enumerate(order[1:], 1):
        earlier = np.isin(nodes[i].neighbour, order[:k])
        known = _Node(nodes[i].neighbour[earlier], nodes[i].turn[earlier], nodes[i].weight[earlier])
        _sample(known, rotations, int(i), 1.0, rng)
    for temperature in _TEMPERATURES:
        for i in rng.permutation(len(nodes)).tolist():
            _sample(nodes[i], rotations, i, temperature, rng)
    for _ in range(_AVERAGING_SWEEPS):
        for i, node in enumerate(nodes):
            rotations[:, i] = node.mean(rotations[:, i], node.proposals(rotations))
    scores = [
        node.score(rotations[:, i, None], node.proposals(rotations)) for i, node in enumerate(nodes)
    ]
    best = rotations[np.sum(scores, axis=0)[:, 0].argmax()].astype(np.float64)
    return nearest_rotation(best[0].T @ best)[0]


def _sample(
    node: _Node, rotations: _Rotations, i: int, temperature: float, rng: np.random.Generator
) -> None:
    """Draw the rotation of object i, in place, from its present one and the proposals of a few
    pairs."""
    t = len(rotations)
    proposers = rng.permutation(len(node.neighbour))[:_PROPOSERS]
    proposals = node.proposals(rotations)
    proposed = proposals[:, proposers].reshape(t, -1, 3, 3)
    candidates = np.concatenate([rotations[:, i, None], proposed], axis=1)
    score = node.score(candidates, proposals)
    # With Gumbel noise, the largest score is a sample of the softmax of the scores.
    score += temperature * rng.gumbel(size=score.shape)
    rotations[:, i] = candidates[np.arange(t), score.argmax(axis=1)]


def _judge(
    node: _Node, rotations: Float[np.ndarray, "n 3 3"], i: int, agreeing: float
) -> tuple[float, Float[np.ndarray, "3 3"] | None, float]:
    """Return the probability of an object's rotation, the best other one, all others fixed, and its
    probability."""
    proposals = node.proposals(rotations[None])
    others = proposals.reshape(-1, 3, 3)
    others = others[rotation_angle(others, rotations[i]) > SAME_ANGLE]
    margin, best = np.inf, None  # how much worse the best other rotation is
    if len(others):
        candidates = np.concatenate([rotations[None, i], others])
        present, *scores = node.score(candidates[None], proposals)[0].tolist()
        margin, best = present - max(scores), others[np.argmax(scores)]
    # A conditional logit of three cases: this rotation is right, the other one is, or none. The
    # pairs of an object err together, so the margin counts by the root of their number. That none
    # is right is less probable if more of the object's pairs agree.
    other = np.exp(-MARGIN * margin / np.sqrt(len(node.neighbour)))
    none = np.exp(NONE + NONE_AGREEING * agreeing)
    total = 1 + other + none
    return float(1 / total), best, float(other / total)


def _scales_and_translations(
    pairs: Sequence[PairHypotheses],
    ends: Int[np.ndarray, "e 2"],
    rotations: Float[np.ndarray, "n 3 3"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Fit scales and translations to the hypotheses that agree with the rotations; return the
    objects' centres too."""
    # A row for each hypothesis (lambda, H, tau) of each pair (a, b), k in all.
    a, b = np.repeat(ends, [len(pair.sim3s) for pair in pairs], axis=0).T
    sim3s = [one for pair in pairs for one in pair.sim3s]
    turns = np.stack([one.R for one in sim3s])
    angle = np.radians(rotation_angle(rotations[a], rotations[b] @ turns))
    probability = np.concatenate([pair.probabilities for pair in pairs])
    weight = probability * (np.exp(KAPPA * (np.cos(angle) - 1)) + _WEAK)
    # The centre c of a, and y = lambda H c + tau, its place in the world of b.
    c = np.stack([pair.centre for pair in pairs for _ in pair.sim3s])
    y = np.stack([one.apply(centre) for one, centre in zip(sim3s, c)])

    # Each demands log s_a - log s_b = log(lambda), and t_a - t_b = s_b Q_b y - s_a Q_a c.
    of_a, of_b = np.eye(len(rotations))[a], np.eye(len(rotations))[b]  # (k, n)
    log_ratios = np.log([[one.scale] for one in sim3s])
    scales = np.exp(_least_absolute(of_a - of_b, log_ratios, weight))[:, 0]
    linear = scales[:, None, None] * rotations
    shift = np.einsum("kij,kj->ki", linear[b], y) - np.einsum("kij,kj->ki", linear[a], c)
    t = _least_absolute(of_a - of_b, shift, weight)

    # An object's centre is the weighted mean of where its pairs see it, in its own world.
    seen = np.concatenate([of_a, of_b]) * np.r_[weight, weight][:, None]  # (2 k, n)
    return scales, t - t[0], (seen / seen.sum(axis=0)).T @ np.r_[c, y]


def _least_absolute(
    incidence: Float[np.ndarray, "k n"],
    difference: Float[np.ndarray, "k e"],
    weight: Float[np.ndarray, " k"],
) -> Float[np.ndarray, "n e"]:
    """Minimise sum_k w_k |incidence_k x - difference_k| over x of mean zero, by iteratively
    reweighted squares."""
    scaled = weight
    for _ in range(_REWEIGHTINGS):
        weighted = incidence.T * scaled
        # The solution of least norm has the mean zero.
        x = np.linalg.lstsq(weighted @ incidence, weighted @ difference, rcond=None)[0]
        scaled = weight / (np.linalg.norm(incidence @ x - difference, axis=1) + 1e-9)
    return x
