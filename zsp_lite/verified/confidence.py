r"""Calibrated probabilities: how likely is the rotation of each hypothesis within 30 degrees of the
truth?

The score S is a conditional logit (McFadden 1974), with one more alternative: that none of the
poses is right. Of the different poses (see `modes`) of an estimate, pose k has the probability

    p_k = (1 - \lambda h) \exp(-a (S_1 - S_k)) / (\exp(b) + \sum_j \exp(-a (S_1 - S_j))),
    \log a = \alpha . x,   b = \beta . x.

x is what is known about the estimate beside the scores (see `evidence`). Its most important entry
is the span: how far around the target its views go. Where the views show one side only, the best
pose turns that side to the reference, and whether the reference shows a hidden side that looks
alike cannot be known. \lambda is the chance of such a hidden side. h is the hidden share of the
circle around the target, from where no view is within 60 degrees, divided by the hidden share of a
single view. The p_k sum to less than 1; the rest is the probability that no pose is right. The
confidence of an estimate is p_1. `viz.reliability` measures how well such probabilities are
calibrated.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from zsp_lite.estimates import Hypothesis
from zsp_lite.metrics import SAME_ANGLE
from zsp_lite.verified.verification import VIEWPOINT_SIGMA

# A pose with more than this share of the best pose's probability is nearly as probable. It and the
# next two are chosen, not fitted.
_TIE_RATIO = float(np.exp(-1))
# A pose is flagged if in both directions a smaller share of its points lies on an observed surface.
_MIN_OVERLAP = 0.05
# A pose is flagged if in both directions its similarity term is smaller. Poses, right or wrong,
# have 0.06 and more; views that share no side have 0.01.
_MIN_SIMILARITY = 0.02


def evidence(
    # Angle in degrees that the target views span around the target (see `azimuths.view_span`).
    span: float,
    n_views: int,
    # Angle in degrees from the reference's camera to the nearest target view's, under the best
    # pose.
    nearest: float,
    # Standard deviation of the target views' similarity to the reference; small if the features
    # distinguish no sides.
    view_std: float,
    # Part of the best score from overlap, silhouettes and free space; small if shapes do not fit.
    shape_fit: float,
) -> Float[np.ndarray, "6"]:
    """Return the vector x, which begins with a constant."""
    nearness = np.exp(-((nearest / VIEWPOINT_SIGMA) ** 2))
    return np.array([1.0, span / 360, np.log(n_views), nearness, view_std, shape_fit])


@dataclass(frozen=True)
class Calibration:
    r"""The coefficients \alpha and \beta of x, and \lambda, fitted on validation categories.

    docs/rebuild.md names the revision with the code of the fit.
    """

    scale: tuple[float, ...] = (-0.40, 1.46, 0.025, -0.93, 2.90, -0.063)  # \alpha
    none: tuple[float, ...] = (0.55, -2.87, 0.72, 0.61, -28.5, -0.501)  # \beta
    unseen: float = 0.313  # \lambda

    def probabilities(
        self, deficit: Float[np.ndarray, " m"], x: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, " m"]:
        """Return the probabilities of poses by their `deficit` S_1 - S_k; 0 if it is infinite."""
        odds = np.exp(-np.exp(x @ self.scale) * deficit)
        return (1 - self.unseen * hidden_share(x[1])) * odds / (np.exp(x @ self.none) + odds.sum())


def hidden_share(span: float) -> float:
    """Return h for views whose `span` is a share of the circle around the target, in [0, 1]."""
    # A single view sees 60 degrees to both sides and leaves 240 degrees hidden. Views that span an
    # angle leave that much less: h = (240 - 360 * span) / 240.
    return max(0.0, 1 - 1.5 * span)


def modes(angle: Float[np.ndarray, "m m"]) -> Int[np.ndarray, " m"]:
    """Return each hypothesis's mode: the nearest mode within 30 degrees, or a new one of its own.

    Hypotheses are sorted, best first. A mode is the number of its best hypothesis.
    """
    mode_of = []
    for i, row in enumerate(angle):
        # The modes of better hypotheses that are within 30 degrees.
        near = [j for j in range(i) if mode_of[j] == j and row[j] < SAME_ANGLE]
        mode_of.append(min(near, key=row.__getitem__, default=i))
    return np.array(mode_of)


def reliability_flags(
    hypotheses: Sequence[Hypothesis], angle: Float[np.ndarray, "m m"]
) -> tuple[tuple[str, ...], bool]:
    """Say why the best hypothesis may be wrong, a line per reason, and whether it is one of two."""
    flags = []

    # The best hypotheses of all modes that are about as probable as the first.
    enough = _TIE_RATIO * hypotheses[0].confidence
    tied = [k for k, one in enumerate(hypotheses) if one.mode == k and one.confidence > enough]
    probabilities = [hypotheses[k].confidence for k in tied]
    # One of two is meant if the two are together more probable than not, and if they are so far
    # apart that no rotation is within 30 degrees of both.
    one_of_two = bool(
        len(tied) == 2 and sum(probabilities) > 0.5 and angle[tied[0], tied[1]] > 2 * SAME_ANGLE
    )
    if len(tied) > 1:
        shown = " and ".join(f"{one:.2f}" for one in probabilities)
        start = f"{len(tied)} poses more than 30"
        if one_of_two:
            start = f"one of two: poses {angle[tied[0], tied[1]]:.0f}"
        flags.append(
            f"{start} degrees apart explain the views about equally well "
            f"(probabilities {shown}): the object may be symmetric"
        )

    terms = hypotheses[0].terms
    if terms:  # a pose that combines several estimates has no terms
        if max(terms["forward_overlap"], terms["reverse_overlap"]) < _MIN_OVERLAP:
            flags.append("no view confirms the pose: nearly no point lies on an observed surface")
        if max(terms["forward_similarity"], terms["reverse_similarity"]) < _MIN_SIMILARITY:
            flags.append(
                "no view confirms the pose: features of points that coincide are not similar"
            )
    return tuple(flags), one_of_two
