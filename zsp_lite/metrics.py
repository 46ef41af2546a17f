"""Pose errors, and the paper's figures of them (sec. 5.1; supplement, "Choice of evaluation
metrics")."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from zsp_lite.errors import rotation_matrix

SAME_ANGLE = 30.0  # degrees, as in Acc30: nearer rotations are the same, a smaller error is right


def rotation_error(first: ArrayLike, second: ArrayLike) -> np.ndarray | float:
    """Compute the geodesic angle between rotations, exact near 0 and 180 degrees.

    The angle is the atan2 of the relative rotation's sine (its antisymmetric part) and cosine (its
    trace). An arccos of the trace loses all digits near 0 and 180.

    Args:
        first: Rotations (..., 3, 3), numpy or torch.
        second: Rotations (..., 3, 3), broadcast against `first`.

    Returns:
        Angles (...) in degrees in [0, 180]; a float for a single pair.

    Raises:
        InputError: For other shapes and matrices that are no rotations.
    """
    first = rotation_matrix("rotation_error: first", first)
    return rotation_angle(first, rotation_matrix("rotation_error: second", second))


def rotation_angle(
    first: Float[np.ndarray, "*a 3 3"], second: Float[np.ndarray, "*b 3 3"]
) -> np.ndarray | float:
    """Compute the angles of `rotation_error` without checks."""
    relative = np.swapaxes(first, -1, -2) @ second
    twice_sine = np.sqrt(
        np.square(relative[..., 2, 1] - relative[..., 1, 2])
        + np.square(relative[..., 0, 2] - relative[..., 2, 0])
        + np.square(relative[..., 1, 0] - relative[..., 0, 1])
    )
    twice_cosine = np.trace(relative, axis1=-2, axis2=-1) - 1
    return np.degrees(np.arctan2(twice_sine, twice_cosine))[()]


def vector_angle(
    first: Float[np.ndarray, "*a 3"], second: Float[np.ndarray, "*b 3"]
) -> np.ndarray | float:
    """Compute the angles in degrees between vectors of any length above 0."""
    sine = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.degrees(np.arctan2(sine, np.sum(np.multiply(first, second), axis=-1)))[()]


def accuracy(
    errors: ArrayLike, threshold: float, weights: ArrayLike | None = None
) -> np.ndarray | float:
    """Compute the percentages (...) of errors (..., n) in degrees strictly below a threshold; Acc30
    is threshold=30.

    Non-negative weights (..., n) are broadcast against the errors.
    """
    return 100 * weighted_mean(np.asarray(errors) < threshold, weights)


def median(errors: ArrayLike, weights: ArrayLike | None = None) -> np.ndarray | float:
    """Compute the medians (...) of errors (..., n), or of errors (n,) with non-negative weights
    (..., n).

    The weighted median halves the total weight. Where the half falls between two errors it is their
    mean, so that equal weights give the ordinary median.
    """
    errors = np.asarray(errors, np.float64)
    if weights is None:
        return np.median(errors, axis=-1)
    order = np.argsort(errors)
    cumulative = np.cumsum(np.take(weights, order, axis=-1), axis=-1)
    half = cumulative[..., -1:] / 2
    lower = (cumulative >= half).argmax(axis=-1)
    upper = (cumulative > half).argmax(axis=-1)
    ordered = errors[order]
    return ((ordered[lower] + ordered[upper]) / 2)[()]


def weighted_mean(values: ArrayLike, weights: ArrayLike | None) -> np.ndarray | float:
    """Compute the mean over the last axis, weighted unless `weights` is None."""
    if weights is None:
        return np.mean(values, axis=-1)
    return np.einsum("...n,...n", weights, values) / np.sum(weights, axis=-1)
