"""What the lesson on hypotheses computes beside the library, of the answers of several objects."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from zsp_lite.metrics import SAME_ANGLE, rotation_angle
from zsp_lite.scans.category import PairHypotheses

_Rotations = Mapping[str, Float[np.ndarray, "3 3"]]  # of objects, by their names


def draw_answers(every: Iterable[PairHypotheses], seed: int) -> list[PairHypotheses]:
    """Draw one answer for each ordered pair of objects, from those of its several frames."""
    answers: dict[tuple[str, str], list[PairHypotheses]] = {}
    for answer in every:
        answers.setdefault((answer.reference, answer.target), []).append(answer)
    rng = np.random.default_rng(seed)
    return [several[rng.integers(len(several))] for several in answers.values()]


def spanning_tree(answers: Sequence[PairHypotheses]) -> dict[str, Float[np.ndarray, "3 3"]]:
    """Place one object after the other by the surest answer that leads to it.

    Returns the rotation from each object's world to that of the first.
    """
    names = sorted({name for one in answers for name in (one.reference, one.target)})
    placed = {names[0]: np.eye(3)}
    while len(placed) < len(names):
        leading = [one for one in answers if (one.reference in placed) != (one.target in placed)]
        surest = max(leading, key=lambda one: one.probabilities[0])
        first, second, turn = surest.target, surest.reference, surest.sim3s[0].R
        if second in placed:
            first, second, turn = second, first, turn.T
        placed[second] = placed[first] @ turn
    return {name: placed[name] for name in names}


def right_answers(
    answers: Sequence[PairHypotheses], truth: _Rotations, rotations: _Rotations | None = None
) -> dict[tuple[str, str], bool | None]:
    """Say of each ordered pair whether its surest answer is right, or the one that fits
    `rotations`; None if none fits.

    `truth` leads from the objects' worlds to a common frame.
    """
    right = {}
    for one in answers:
        # Without rotations the first answer counts, which is the surest.
        away = _angles(one, rotations) if rotations else np.zeros(1)
        nearest = away.argmin()
        is_right = bool(_angles(one, truth)[nearest] < SAME_ANGLE)
        right[one.reference, one.target] = is_right if away[nearest] <= SAME_ANGLE else None
    return right


def _angles(answers: PairHypotheses, rotations: _Rotations) -> Float[np.ndarray, " m"]:
    """Return the angles in degrees between the answers of a pair and the rotation between its
    objects."""
    turns = np.stack([sim3.R for sim3 in answers.sim3s])
    return rotation_angle(turns, rotations[answers.target].T @ rotations[answers.reference])


def all_alike(truth: _Rotations, rotations: _Rotations) -> bool:
    """Whether rotations from the objects' worlds turn all objects the same way, judged by the
    `truth` of `right_answers`."""
    frames = np.stack([rotations[name] @ truth[name].T for name in truth])
    return bool((rotation_angle(frames[0], frames) < SAME_ANGLE).all())
