"""Alignment of two point clouds by keypoints picked on both.

See "Labelling pose for evaluation" in the paper's supplement: at least four keypoints are picked in the same order on
the clouds of the reference sequence and of another sequence, and aligned by Umeyama's method with scale.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.errors import InputError

MIN_KEYPOINTS = 4


@dataclass(frozen=True, eq=False)
class Alignment:
    """Alignment of the reference sequence with another sequence."""

    sim3: Sim3  # from the world of the reference sequence to that of the sequence
    # Distance of each transformed keypoint from its pick, relative to the spread of the picks (their standard
    # deviation, averaged over the axes), so that objects of any size can be compared.
    residuals: Float[np.ndarray, " n"]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.square(self.residuals).mean()))


def align_picks(reference: ArrayLike, picks: ArrayLike) -> Alignment:
    """Align keypoints (n, 3) of the reference sequence, n >= 4, and of another one by Umeyama's method with scale.

    InputError if the numbers differ or are below 4, a keypoint is not finite, or all are equal or collinear.
    """
    reference, picks = (np.asarray(points, dtype=np.float64) for points in (reference, picks))
    if len(reference) != len(picks) or len(picks) < MIN_KEYPOINTS:
        found = f"{len(picks)} keypoints picked and {len(reference)} on the reference"
        raise InputError(f"{found}, expected equally many, at least {MIN_KEYPOINTS}")
    sim3 = umeyama(reference, picks)
    distance = np.linalg.norm(sim3.apply(reference) - picks, axis=1)
    return Alignment(sim3, distance / np.sqrt(picks.var(axis=0).mean()))
