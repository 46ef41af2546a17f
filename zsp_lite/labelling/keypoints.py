"""From keypoints picked on two clouds to a pose label: the one piece that the notebook and the desktop share.

The supplement's "Labelling pose for evaluation": four or more keypoints of the reference's cloud, the same ones in the
same order on another sequence's, Umeyama with scale; the label keeps the rigid part.
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
    """How the reference's cloud lies on a sequence's: `sim3` takes the one's world points to the other's.

    residuals: distance from each moved keypoint to its pick, in shares of the picks' own spread (their standard
    deviation, averaged over the axes), so that 0.05 means the same on every object.
    """

    sim3: Sim3
    residuals: Float[np.ndarray, " n"]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.square(self.residuals).mean()))


def align_picks(reference: ArrayLike, picks: ArrayLike, names: Sequence[str] = ()) -> Alignment:
    """Umeyama with scale from the reference's keypoints (n, 3) to the same ones picked elsewhere (n, 3), n >= 4.

    names: of the keypoints, for errors. Raises InputError for unequal or too small numbers, for a keypoint picked
    twice at one place, and for keypoints on one line.
    """
    reference, picks = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (reference, picks))
    if len(reference) != len(picks) or len(picks) < MIN_KEYPOINTS:
        raise InputError(
            f"{len(picks)} keypoints picked and {len(reference)} on the reference, expected equally many, "
            f"at least {MIN_KEYPOINTS}"
        )
    for points, whose in ((reference, "reference"), (picks, "sequence")):
        _check_apart(points, whose, names)
    sim3 = umeyama(reference, picks)
    distance = np.linalg.norm(sim3.apply(reference) - picks, axis=1)
    return Alignment(sim3, distance / np.sqrt(picks.var(axis=0).mean()))


def _check_apart(points: Float[np.ndarray, "n 3"], whose: str, names: Sequence[str]) -> None:
    if not np.isfinite(points).all():
        raise InputError(f"keypoints of the {whose} are not finite: {points.tolist()}")
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    first, second = np.unravel_index(distance.argmin(), distance.shape)
    if distance[first, second] < 1e-9:
        called = [names[i] if i < len(names) else f"number {i + 1}" for i in (first, second)]
        raise InputError(f"keypoints {called[0]} and {called[1]} of the {whose} are one point, expected two")
