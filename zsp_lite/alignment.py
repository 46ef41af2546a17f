"""Rigid alignment with scale: Umeyama's least squares in RANSAC (paper eq. 4; supplement).

All trials of RANSAC are fitted by one batched SVD, so that a thousand of them take milliseconds.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from zsp_lite.errors import (
    InputError,
    check_magnitude,
    check_number,
    real_array,
    rotation_matrix,
)

# Range of the scale between two objects of a category whose scenes are both scaled to unit standard
# deviation. The paper gives none; without a range, RANSAC can shrink the source onto a dense part
# of the target.
SCALE_RANGE = (0.2, 5.0)
# Points are treated as collinear, which leaves the rotation about their line undetermined, below
# this ratio of the second to the first singular value of their covariance. It is above the rounding
# of float32 coordinates on a line.
_COLLINEAR = 1e-6
_BLOCK = 1_000_000  # residuals at a time: 24 MB of offsets


@dataclass(frozen=True, eq=False)
class Sim3:
    """Similarity transform `y = scale * R @ x + t`, from reference-camera points to target-camera
    points."""

    scale: float  # positive, unitless
    # rotation; the nearest one of what is given (see `errors.rotation_matrix`)
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]  # translation, in units of the target's scene

    def __post_init__(self):
        translation = real_array("Sim3: t", self.t, (3,)).copy()
        if not np.isfinite(translation).all() or not 0 < self.scale < np.inf:
            raise InputError(
                f"Sim3: scale is {self.scale} and t {translation}, expected finite numbers, "
                "scale above 0"
            )
        rotation = rotation_matrix("Sim3: R", real_array("Sim3: R", self.R, (3, 3)))
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "R", rotation)
        object.__setattr__(self, "t", translation)

    @classmethod
    def identity(cls) -> "Sim3":
        """Return the identity transform."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: Float[np.ndarray, "4 4"]) -> "Sim3":
        """Return the transform with this `matrix`."""
        scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
        return cls(scale, matrix[:3, :3] / scale, matrix[:3, 3])

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Homogeneous matrix for column vectors; its upper left block is `scale * R`."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.R
        matrix[:3, 3] = self.t
        return matrix

    def apply(self, points: ArrayLike) -> Float[np.ndarray, "*batch 3"]:
        """Transform points (..., 3)."""
        return self.scale * np.asarray(points, dtype=np.float64) @ self.R.T + self.t

    def inverse(self) -> "Sim3":
        """Return the inverse transform."""
        return Sim3(1 / self.scale, self.R.T, -(self.R.T @ self.t) / self.scale)

    def __matmul__(self, other: "Sim3") -> "Sim3":
        """Compose two transforms: `(a @ b).apply(x) == a.apply(b.apply(x))`."""
        return Sim3(self.scale * other.scale, self.R @ other.R, self.apply(other.t))


def umeyama(source: ArrayLike, target: ArrayLike, with_scale: bool = True) -> Sim3:
    """Fit the similarity that minimises sum |target - (scale * R @ source + t)|^2 (paper eq. 4;
    Umeyama 1991).

    Args:
        source: (N, 3) points, N >= 3, NumPy or torch.
        target: (N, 3) corresponding points.
        with_scale: False fixes the scale at 1.

    Returns:
        The best similarity. Its R is a rotation even where a reflection would fit better.

    Raises:
        InputError: Shapes are wrong or unequal, there are fewer than 3 points, values are not
            finite, or the points are all equal or collinear (which leaves the rotation about their
            line undetermined).
    """
    source, target = _point_pairs(source, target, minimum=3)
    scale_range = (0.0, np.inf) if with_scale else (1.0, 1.0)
    scale, rotation, translation, conditioning = umeyama_batch(
        source[None], target[None], scale_range
    )
    if conditioning[0] <= _COLLINEAR:
        raise InputError(
            f"the {len(source)} source or target points are all equal or collinear, expected "
            "points that span a plane"
        )
    return Sim3(scale[0], rotation[0], translation[0])


def nearest_rotation(
    covariance: Float[np.ndarray, "b 3 3"],
) -> tuple[Float[np.ndarray, "b 3 3"], Float[np.ndarray, "b 3"], Float[np.ndarray, " b"]]:
    """Solve the orthogonal Procrustes problem for rotations: argmax_R trace(R^T @ covariance)
    (Umeyama 1991).

    Returns the rotations, the covariances' singular values, and signs: -1 where a reflection would
    fit better.
    """
    left, singular, right = np.linalg.svd(covariance)
    rotation = left @ right
    # The best orthogonal matrix may be a reflection; flipping the last axis gives the best
    # rotation, det(R) = +1.
    sign = np.sign(np.linalg.det(rotation))
    mirrored = np.flatnonzero(sign < 0)
    rotation[mirrored] -= 2 * left[mirrored, :, 2:] * right[mirrored, 2:, :]
    return rotation, singular, sign


def umeyama_batch(
    source: Float[np.ndarray, "b n 3"],
    target: Float[np.ndarray, "b n 3"],
    scale_range: tuple[float, float] = (0.0, np.inf),
    weight: Float[np.ndarray, "b n"] | None = None,
) -> tuple[
    Float[np.ndarray, " b"],
    Float[np.ndarray, "b 3 3"],
    Float[np.ndarray, "b 3"],
    Float[np.ndarray, " b"],
]:
    """Fit similarities to a batch of point sets, without checks (see `umeyama`).

    Squared errors count by the `weight` of their points. The best rotation does not depend on the
    scale, and the error is quadratic in the scale: the best scale, clipped to the range, is the
    best within it. Returns scales, rotations, translations, and the ratio of the second to the
    first singular value of the covariance, 0 for collinear points.
    """
    if weight is None:
        source_mean = source.mean(axis=1)
        target_mean = target.mean(axis=1)
        weight = np.ones(source.shape[:2])
    else:
        weight = weight / weight.sum(axis=1, keepdims=True)
        source_mean = (weight[:, None] @ source)[:, 0]
        target_mean = (weight[:, None] @ target)[:, 0]
    centred = source - source_mean[:, None]
    weighted = weight[:, :, None] * centred
    covariance = (target - target_mean[:, None]).swapaxes(1, 2) @ weighted  # (b, 3, 3)
    rotation, singular, sign = nearest_rotation(covariance)
    variance = (weighted * centred).sum(axis=(1, 2))  # not divided by n, as the covariance
    trace = singular[:, 0] + singular[:, 1] + sign * singular[:, 2]
    scale = (trace / np.where(variance > 0, variance, 1)).clip(*scale_range)
    translation = target_mean - scale[:, None] * (rotation @ source_mean[:, :, None])[:, :, 0]
    conditioning = singular[:, 1] / np.where(singular[:, 0] > 0, singular[:, 0], 1)
    return scale, rotation, translation, conditioning


def ransac(
    source: ArrayLike,
    target: ArrayLike,
    threshold: float = 0.2,
    trials: int = 1000,
    sample_size: int = 4,
    seed: int | np.random.Generator = 0,
    scale_range: tuple[float, float] = (0.0, np.inf),
) -> tuple[Sim3, Bool[np.ndarray, " n"]]:
    """Fit a similarity to points with outliers: Umeyama's method in RANSAC (paper, sec. 4.3).

    Each trial fits the similarity to a random sample. The trial with the most inliers wins (ties:
    the smaller sum of their residuals), and the similarity is fitted again to its inliers.

    Args:
        source: (N, 3) points, N >= sample_size, NumPy or torch.
        target: (N, 3) corresponding points.
        threshold: Largest residual |target - (scale * R @ source + t)| of an inlier, in target
            units. The paper's 0.2 is for scenes of unit standard deviation.
        trials: Number of samples.
        sample_size: Points per sample, drawn without replacement. The paper takes 4, since 3 can be
            degenerate.
        seed: Seed or generator of the samples; the same seed gives the same result.
        scale_range: Smallest and largest scale. Trials outside are discarded; the final fit is the
            best within.

    Returns:
        The similarity fitted to the inliers, or that of the best trial if they are fewer than 3 or
        collinear; and the (N,) inliers of the best trial.

    Raises:
        InputError: Shapes are wrong, there are too few points, values are not finite, a setting is
            out of range, or every sample is collinear or has a scale out of range.
    """
    check_number("ransac: threshold", threshold, above=0)
    source, target = _point_pairs(source, target, minimum=sample_size)
    samples = _draw_samples(len(source), sample_size, trials, np.random.default_rng(seed))
    scale, rotation, translation, conditioning = umeyama_batch(source[samples], target[samples])
    in_range = (scale >= scale_range[0]) & (scale <= scale_range[1])
    usable = np.flatnonzero(in_range & (conditioning > _COLLINEAR))
    if not len(usable):
        raise InputError(
            f"ransac: none of {trials} trials with sample_size {sample_size} on {len(source)} "
            f"points is usable: all collinear, or scale outside scale_range {scale_range}"
        )

    def residuals(some: Int[np.ndarray, " t"]) -> Float[np.ndarray, "t n"]:
        linear = scale[some, None, None] * rotation[some]
        offset = linear @ source.T + translation[some, :, None] - target.T  # (t, 3, N)
        return np.sqrt(np.square(offset).sum(axis=1))

    # Inliers are counted in blocks of trials: the residuals of all may not fit into memory.
    blocks = np.array_split(usable, 1 + usable.size * len(source) // _BLOCK)
    counts = np.concatenate([(residuals(block) < threshold).sum(axis=1) for block in blocks])
    # Of the trials with the most inliers, the one with the smallest sum of their residuals.
    leaders = usable[counts == counts.max()]
    residual = residuals(leaders)
    inlier = residual < threshold
    first = np.where(inlier, residual, 0).sum(axis=1).argmin()
    best = leaders[first]
    fit = [scale[best], rotation[best], translation[best]]
    inliers = inlier[first]

    # The similarity of all inliers.
    if inliers.sum() >= 3:
        *refit, conditioning = umeyama_batch(
            source[None, inliers], target[None, inliers], scale_range
        )
        if conditioning[0] > _COLLINEAR:
            fit = [part[0] for part in refit]
    return Sim3(*fit), inliers


def _draw_samples(
    n: int, size: int, trials: int, rng: np.random.Generator
) -> Int[np.ndarray, "trials size"]:
    """Draw `trials` samples of `size` different indices below n, uniformly, without a loop over the
    trials."""
    samples = np.empty((trials, size), dtype=np.int64)
    # Index k of a sample is drawn as a rank among the n - k indices that are left, and moved up
    # past each earlier index that is not larger.
    for k in range(size):
        draw = rng.integers(n - k, size=trials)
        for earlier in np.sort(samples[:, :k], axis=1).T:
            draw += draw >= earlier
        samples[:, k] = draw
    return samples


def _point_pairs(
    source: ArrayLike, target: ArrayLike, minimum: int
) -> tuple[np.ndarray, np.ndarray]:
    """Convert corresponding points to float64 arrays and check them."""
    source = real_array("source", source, (None, 3))
    target = real_array("target", target, source.shape)
    if len(source) < minimum:
        raise InputError(f"got {len(source)} corresponding points, expected at least {minimum}")
    check_magnitude("source", source)
    check_magnitude("target", target)
    return source, target
