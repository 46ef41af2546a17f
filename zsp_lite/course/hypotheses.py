"""What the lesson on hypotheses computes beside the library: a full turn of a pose, and the answers
of several objects."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from zsp_lite.metrics import SAME_ANGLE, rotation_angle
from zsp_lite.scans.category import PairHypotheses
from zsp_lite.verified.poses import Poses
from zsp_lite.verified.solver import Solution
from zsp_lite.verified.verification import ScoreCoefficients, score_terms

_Rotations = Mapping[str, Float[np.ndarray, "3 3"]]  # of objects, by their names


def full_turn(
    solution: Solution,
) -> tuple[Float[np.ndarray, " n"], Poses, Float[np.ndarray, " n"]]:
    """Turn the best pose of a solution by a full circle, in steps of 5 degrees, about the axis that
    leads to the second.

    Returns the angles in degrees, the turned poses, and their scores.
    """
    best = solution.poses[[0]]
    first, second = solution.poses.rotation[:2].double().numpy()
    axis = Rotation.from_matrix(second @ first.T).as_rotvec()
    degrees = np.arange(0, 365, 5.0)
    vectors = np.outer(np.radians(degrees), axis / np.linalg.norm(axis))
    turns = torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix()).float()
    # The turn is about the origin of the scene, which is amid the object.
    shift = (turns @ best.translation[..., None])[..., 0]
    turned = Poses(best.scale.expand(len(turns)), turns @ best.rotation, shift)
    scores = ScoreCoefficients().score(score_terms(solution.scene, turned))
    return degrees, turned, scores.numpy()


def draw_answers(every: Iterable[PairHypotheses], seed: int) -> list[PairHypotheses]:
    """Draw one answer for each ordered pair of objects, of those from several frames."""
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
        turn = surest.sim3s[0].R
        if surest.reference in placed:
            placed[surest.target] = placed[surest.reference] @ turn.T
        else:
            placed[surest.reference] = placed[surest.target] @ turn
    return {name: placed[name] for name in names}


def surest_right(
    answers: Sequence[PairHypotheses], truth: _Rotations
) -> dict[tuple[str, str], bool]:
    """Say of each ordered pair whether its surest answer is right.

    `truth` leads from the objects' worlds to a common frame.
    """
    return {
        (one.reference, one.target): bool(_angles(one, truth)[0] < SAME_ANGLE) for one in answers
    }


def fitting_right(
    answers: Sequence[PairHypotheses], truth: _Rotations, rotations: _Rotations
) -> dict[tuple[str, str], bool | None]:
    """Say of each ordered pair whether the answer that fits `rotations` is right; None if none
    fits."""
    right = {}
    for one in answers:
        away = _angles(one, rotations)
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
    """Whether rotations from the objects' worlds turn all objects the same way."""
    frames = np.stack([rotations[name] @ truth[name].T for name in truth])
    return bool((rotation_angle(frames[0], frames) < SAME_ANGLE).all())
