"""Alignment of two point clouds by keypoints picked on both.

See "Labelling pose for evaluation" in the paper's supplement: at least four keypoints are picked in the same order on
the clouds of the reference sequence and of another sequence, and aligned by Umeyama's method with scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.errors import InputError

MIN_KEYPOINTS = 4


@dataclass(frozen=True, eq=False)
class Alignment:
    """Alignment of the reference sequence with another sequence.

    Attributes:
        sim3: Similarity from the world of the reference sequence to that of the sequence.
        residuals: (n,) distance of each transformed keypoint from its pick, relative to the spread of the picks (their
            standard deviation, averaged over the axes), so that objects of any size can be compared.
    """

    sim3: Sim3
    residuals: Float[np.ndarray, " n"]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.square(self.residuals).mean()))


def align_picks(reference: ArrayLike, picks: ArrayLike, names: Sequence[str] = ()) -> Alignment:
    """Align keypoints by Umeyama's method with scale.

    Args:
        reference: (n, 3) keypoints on the reference sequence, n >= 4.
        picks: (n, 3) the same keypoints on another sequence.
        names: Names of the keypoints, for error messages.

    Raises:
        InputError: The numbers differ or are below 4, two keypoints are at one place, or all are collinear.
    """
    reference, picks = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (reference, picks))
    if len(reference) != len(picks) or len(picks) < MIN_KEYPOINTS:
        raise InputError(
            f"{len(picks)} keypoints picked and {len(reference)} on the reference, expected equally many, "
            f"at least {MIN_KEYPOINTS}"
        )
    for points, owner in ((reference, "reference"), (picks, "sequence")):
        _check_distinct(points, owner, names)
    sim3 = umeyama(reference, picks)
    distance = np.linalg.norm(sim3.apply(reference) - picks, axis=1)
    return Alignment(sim3, distance / np.sqrt(picks.var(axis=0).mean()))


def _check_distinct(points: Float[np.ndarray, "n 3"], owner: str, names: Sequence[str]) -> None:
    if not np.isfinite(points).all():
        raise InputError(f"keypoints of the {owner} are not finite: {points.tolist()}")
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    first, second = np.unravel_index(distance.argmin(), distance.shape)
    if distance[first, second] < 1e-9:
        same = [names[i] if i < len(names) else f"number {i + 1}" for i in (first, second)]
        raise InputError(f"keypoints {same[0]} and {same[1]} of the {owner} are the same point, expected two points")
