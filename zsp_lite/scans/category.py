r"""All objects of a category in one common frame, without labels: synchronisation of the hypotheses
of many pairs.

Here a pair is a pair of objects (a, b) with a few hypotheses: similarities from the world of a to
that of b, with probabilities. They are what the verified solver found for one frame of a in views
of b, or what all frames of both tell together (see `judge`). Two objects may have several pairs.

One pair often cannot tell the front from the back; all pairs mostly can (Birdal et al.,
Synchronizing probability measures on rotations, CVPR 2020). Sought is a similarity x -> s_i Q_i x +
t_i from the world of each object i to a common frame. Hypothesis h of a pair, of rotation H_h,
agrees with the rotations if Q_a = Q_b H_h. With \theta_h the angle between the two, they maximise

    \sum_{pairs} \log(\epsilon + \sum_h p_h \exp(\kappa (\cos\theta_h - 1))),

the logarithm of a mixture of von Mises-Fisher densities and a uniform one, which limits the cost of
a wrong pair.

1. Search, from many random spanning trees of hypotheses: set one object after the other to the best
   rotation that a hypothesis proposes, given all others (iterated conditional modes; Besag 1986).
2. Averaging on the rotation group (Hartley et al., Rotation averaging, IJCV 2013): each rotation in
   turn becomes the mean of the proposals, weighted by how well they agree (expectation
   maximisation); so do the logarithms of the scales, and the places.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import softmax

from zsp_lite.alignment import Sim3, nearest_rotation
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate
from zsp_lite.metrics import SAME_ANGLE, rotation_angle

# The values down to `_AVERAGING_SWEEPS` are chosen, not fitted.
# \kappa of the objective: a hypothesis 20 degrees off counts 1/e of one that agrees.
KAPPA = 16.0
# \epsilon of the objective, where a sure hypothesis that agrees counts 1.
FLOOR = 0.1
# All pairs of a category are solved below this number of objects, since pairs grow as its square;
# from it on, each object is the reference of a few.
_ALL_PAIRS_BELOW = 12
_PAIRS_PER_OBJECT = 6
_STARTS = 48  # of the search, of which the best result is kept
_SEARCH_SWEEPS = 8  # over all objects
_AVERAGING_SWEEPS = 30
# Coefficients of the logit in `_judge`: of the margin, of the case that no rotation is right, and
# of the share of agreeing pairs in this case. Fitted on validation categories to sets of
# three and four objects (docs/rebuild.md).
_MARGIN = 2.52
_NONE = -0.93
_NONE_AGREEING = -3.03

_Poses = Float[np.ndarray, "*_ 4 4"]  # matrices of similarities


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

    @cached_property
    def disagreements(self) -> dict[tuple[str, str], float]:
        """Median angle between the alignment and the best hypotheses of each pair of objects, by
        (reference, target); only angles above 30 degrees, largest first."""
        angles = defaultdict(list)
        for pair in self.pairs:
            ends = pair.reference, pair.target
            angles[ends].append(rotation_angle(self.between(*ends).R, pair.sim3s[0].R))
        medians = {ends: float(np.median(several)) for ends, several in angles.items()}
        worst_first = sorted(medians, key=medians.get, reverse=True)
        return {ends: medians[ends] for ends in worst_first if medians[ends] > SAME_ANGLE}

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
        per_object = n - 1 if n < _ALL_PAIRS_BELOW else _PAIRS_PER_OBJECT
    if per_object >= n - 1:
        return list(combinations(sorted(names), 2))
    # The objects stand in a random circle. Each has those as partners that are some steps before
    # and after it.
    rng = np.random.default_rng(0)
    circle = [sorted(names)[k] for k in rng.permutation(n)]
    # The first connects all objects. Half of the circle would be one partner, not two.
    steps = [1, *(2 + rng.permutation((n - 1) // 2 - 1)).tolist()]
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
    to_centre = [_to_centre(name, pairs) for name in names]
    votes = _collect(pairs, names, to_centre)
    own = [_Votes(*(column[votes.here == i] for column in votes)) for i in range(len(names))]

    # The two steps of the module's docstring.
    rng = np.random.default_rng(0)
    found = _search(own, np.stack([_random_tree(votes, names, rng) for _ in range(_STARTS)]))
    poses = found[sum(one.scores(one.options(found))[:, 0] for one in own).argmax()]
    for _ in range(_AVERAGING_SWEEPS):
        for i, one in enumerate(own):
            poses[i] = one.mean(one.options(poses))

    # The first object is the frame, and the mean log scale is zero.
    poses = np.linalg.inv(poses[0] @ to_centre[0].matrix) @ poses
    poses[:, :3] /= np.exp(np.log(_split(poses)[0]).mean())
    objects = [_judge(one, poses, shift) for one, shift in zip(own, to_centre)]
    return CategoryAlignment(dict(zip(names, objects)), tuple(pairs))


def _to_centre(name: str, pairs: Sequence[PairHypotheses]) -> Sim3:
    """Return the translation that moves an object to the origin of its world."""
    centres = [pair.centre for pair in pairs if pair.reference == name]
    centres += [pair.sim3s[0].apply(pair.centre) for pair in pairs if pair.target == name]
    return Sim3(1.0, np.eye(3), -np.median(centres, axis=0))


def agreement(
    turns: Float[np.ndarray, "*b m 3 3"], others: Float[np.ndarray, "*b h 3 3"]
) -> Float[np.ndarray, "*b m h"]:
    r"""Return \exp(\kappa (\cos\theta - 1)) of each rotation with each other one; \cos\theta =
    (trace - 1) / 2."""
    traces = np.einsum("...mij,...hij->...mh", turns, others)
    return np.exp(KAPPA / 2 * (traces - 3))


class _Votes(NamedTuple):
    """Hypotheses, each in both directions: k similarities from the world of one object to that of
    another, both objects at the origin.

    The methods are for the votes on one object.
    """

    here: Int[np.ndarray, " k"]  # the object that a similarity starts from
    there: Int[np.ndarray, " k"]  # the object that it leads to
    pair: Int[np.ndarray, " k"]
    probability: Float[np.ndarray, " k"]
    matrix: _Poses

    def options(self, poses: _Poses) -> _Poses:
        """Return the present pose of the object, and those that the votes propose, given poses
        (..., objects, 4, 4)."""
        proposed = poses.take(self.there, -3) @ self.matrix
        return np.concatenate([poses.take(self.here[:1], -3), proposed], -3)

    def by_pair(self) -> Float[np.ndarray, "d k"]:
        """Return the probabilities, in the rows of their pairs."""
        return (self.pair == np.unique(self.pair)[:, None]) * self.probability

    def scores(self, options: _Poses) -> Float[np.ndarray, "*b o"]:
        """Return the part of the objective that depends on the object, for each option."""
        rotations = _split(options)[1]
        agreeing = agreement(rotations, rotations[..., 1:, :, :]) @ self.by_pair().T
        return np.log(FLOOR + agreeing).sum(-1)

    def mean(self, options: _Poses) -> Float[np.ndarray, "4 4"]:
        """Return the mean of the votes, weighted by the probability that each is its pair's right
        one."""
        scales, rotations = _split(options)
        agreeing = self.by_pair() * agreement(rotations[:1], rotations[1:])
        weight = (agreeing / (FLOOR + agreeing.sum(axis=1, keepdims=True))).sum(0)
        weight /= weight.sum()
        rotation = nearest_rotation(np.tensordot(weight, rotations[1:], 1)[None])[0][0]
        scale = np.exp(weight @ np.log(scales[1:]))
        return Sim3(scale, rotation, weight @ options[1:, :3, 3]).matrix


def _collect(
    pairs: Sequence[PairHypotheses], names: Sequence[str], to_centre: Sequence[Sim3]
) -> _Votes:
    """Return the votes of all pairs."""
    rows = []
    for k, pair in enumerate(pairs):
        a = names.index(pair.reference)
        b = names.index(pair.target)
        for sim3, probability in zip(pair.sim3s, pair.probabilities):
            forward = to_centre[b] @ sim3 @ to_centre[a].inverse()
            rows.append((a, b, k, probability, forward.matrix))
            rows.append((b, a, k, probability, forward.inverse().matrix))
    return _Votes(*map(np.array, zip(*rows)))


def _split(poses: _Poses) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n 3 3"]]:
    """Return the scales and the rotations of similarities."""
    scales = np.cbrt(np.linalg.det(poses[..., :3, :3]))
    return scales, poses[..., :3, :3] / scales[..., None, None]


def _random_tree(votes: _Votes, names: Sequence[str], rng: np.random.Generator) -> _Poses:
    """Place one object after the other by a hypothesis that leads to it, drawn by its probability;
    InputError if none leads to the rest."""
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    placed = np.arange(len(names)) == 0
    # With Gumbel noise, the highest rank is a draw by the probabilities.
    rank = np.log(votes.probability) + rng.gumbel(size=len(votes.pair))
    while not placed.all():
        leading = placed[votes.there] & ~placed[votes.here]
        if not leading.any():
            raise InputError(
                f"pairs connect {placed.sum()} of {len(names)} objects with {names[0]}, expected "
                "all"
            )
        k = np.argmax(np.where(leading, rank, -np.inf))
        poses[votes.here[k]] = poses[votes.there[k]] @ votes.matrix[k]
        placed[votes.here[k]] = True
    return poses


def _search(own: Sequence[_Votes], poses: _Poses) -> _Poses:
    """Improve the poses (starts, objects, 4, 4) by the votes on one object after the other."""
    for _ in range(_SEARCH_SWEEPS):
        for i, votes in enumerate(own):
            options = votes.options(poses)
            best = votes.scores(options).argmax(axis=1)
            poses[:, i] = options[np.arange(len(poses)), best]
    return poses


def _judge(votes: _Votes, poses: _Poses, to_centre: Sim3) -> AlignedObject:
    """Return an object's pose and its best other one, all others fixed, with probabilities."""
    options = votes.options(poses)
    rotations = _split(options)[1]
    scores = votes.scores(options)
    different = rotation_angle(rotations[0], rotations) > SAME_ANGLE
    others = np.where(different, scores, -np.inf)
    surest = np.unique(votes.pair, return_index=True)[1]  # most probable vote of each pair

    # A conditional logit of three cases: this rotation is right, the other one is, or none. The
    # pairs of an object err together, so the margin counts by the root of their number. That none
    # is right is less probable if more of the object's pairs agree.
    margin = (scores[0] - others.max()) / np.sqrt(len(surest))
    none = _NONE + _NONE_AGREEING * (1 - different[1:][surest].mean())
    probability, other, _ = softmax([0.0, -_MARGIN * margin, none]).tolist()
    # The probabilities of a single pair say more.
    if len(surest) == 1:
        probability = float(votes.probability[0])
        other = float(votes.probability[others[1:].argmax()]) if different.any() else 0.0

    # The alternative is turned about the object's centre.
    pose = Sim3.from_matrix(options[0])
    alternative = None
    if different.any():
        alternative = Sim3(pose.scale, rotations[others.argmax()], pose.t) @ to_centre
    return AlignedObject(pose @ to_centre, -to_centre.t, probability, alternative, other)
