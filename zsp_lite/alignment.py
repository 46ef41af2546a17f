"""Rigid alignment with scale: Umeyama's least squares inside RANSAC (paper eq. 4, supplement "Rigid body transform").

All trials of RANSAC go through one batched SVD, which is what makes a thousand of them cost milliseconds.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from zsp_lite.errors import InputError

# Below this ratio of the second to the first singular value of the covariance, the rotation about the points'
# common line is noise. It is a ratio of squared widths: 1e-6 is a cloud a thousand times longer than it is wide.
_COLLINEAR_SAMPLE = 1e-6
_COLLINEAR = 1e-10
# The same for one cloud by itself, a ratio of widths: what float32 rounding leaves of a line is below it.
_COLLINEAR_CLOUD = 1e-5


@dataclass(frozen=True, eq=False)
class Sim3:
    """A similarity `y = scale * R @ x + t`, from reference-camera points to target-camera points.

    scale: positive, unitless.  R: (3, 3) rotation.  t: (3,), in units of the target's scene.
    Raises InputError where these are not finite, not of that shape, or R is not a rotation.
    """

    scale: float
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]

    def __post_init__(self):
        scale = float(self.scale)
        rotation, translation = np.asarray(self.R, dtype=np.float64), np.asarray(self.t, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(
                f"Sim3: R and t have shapes {rotation.shape} and {translation.shape}, expected (3, 3) and (3,)"
            )
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all() and 0 < scale < np.inf):
            raise InputError(f"Sim3: expected finite R and t and a positive finite scale, scale is {scale}")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5) or np.linalg.det(rotation) < 0:
            raise InputError("Sim3: R is not a rotation (orthogonal, determinant +1)")
        object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "R", rotation)
        object.__setattr__(self, "t", translation)

    @classmethod
    def identity(cls) -> "Sim3":
        """The transformation that moves nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The same as a homogeneous matrix for column vectors; its upper left block is scale * R."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.R
        matrix[:3, 3] = self.t
        return matrix

    def apply(self, points: ArrayLike) -> Float[np.ndarray, "*batch 3"]:
        """Transform points (..., 3)."""
        return self.scale * np.asarray(points, dtype=np.float64) @ self.R.T + self.t

    def inverse(self) -> "Sim3":
        """The similarity that undoes this one."""
        return Sim3(1 / self.scale, self.R.T, -(self.R.T @ self.t) / self.scale)

    def __matmul__(self, other: "Sim3") -> "Sim3":
        """`(a @ b).apply(x) == a.apply(b.apply(x))`."""
        return Sim3(self.scale * other.scale, self.R @ other.R, self.apply(other.t))


def umeyama(source: ArrayLike, target: ArrayLike, with_scale: bool = True) -> Sim3:
    """The similarity that minimises sum |target - (scale * R @ source + t)|^2 (paper eq. 4; Umeyama 1991).

    source, target: (N, 3) corresponding points, N >= 3, numpy or torch.  with_scale: False fixes the scale at
    1. R is always a rotation, also where a reflection would fit better.
    Raises InputError for wrong or unequal shapes, fewer than 3 points, non-finite values, and points that are
    all equal or collinear (the rotation about their line is then undetermined).
    """
    source, target = _point_pairs(source, target, minimum=3)
    scale, rotation, translation, conditioning = umeyama_batch(source[None], target[None], with_scale)
    if not conditioning[0] > _COLLINEAR:
        raise InputError(
            f"umeyama: the {len(source)} points are all equal or collinear in source or target, "
            "expected at least 3 that span a plane"
        )
    return Sim3(scale[0], rotation[0], translation[0])


def umeyama_batch(
    source: Float[np.ndarray, "b n 3"], target: Float[np.ndarray, "b n 3"], with_scale: bool = True
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, "b 3 3"], Float[np.ndarray, "b 3"], Float[np.ndarray, " b"]]:
    """`umeyama` on a batch of point sets, unchecked: scales, rotations, translations, and conditionings.

    The conditioning is the ratio of the covariance's second to its first singular value: 0 for collinear points.
    """
    source_mean, target_mean = source.mean(axis=1), target.mean(axis=1)
    centred_source, centred_target = source - source_mean[:, None], target - target_mean[:, None]
    left, singular, right = np.linalg.svd(centred_target.swapaxes(1, 2) @ centred_source)
    rotation = left @ right
    # The sign on the last axis keeps det(R) = +1: the best rotation, where the best orthogonal matrix is a mirror.
    flip = np.sign(np.linalg.det(rotation))
    mirrored = np.flatnonzero(flip < 0)
    rotation[mirrored] -= 2 * left[mirrored, :, 2:] * right[mirrored, 2:, :]
    if with_scale:
        spread = np.square(centred_source).sum(axis=(1, 2))
        scale = (singular[:, 0] + singular[:, 1] + flip * singular[:, 2]) / np.where(spread > 0, spread, 1)
    else:
        scale = np.ones(len(singular))
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
    """Umeyama in RANSAC: the most inliers among `trials` samples, then a fit on those inliers.

    source, target: (N, 3) corresponding points, N >= sample_size, numpy or torch.
    threshold: largest distance |target - (scale * R @ source + t)| of an inlier, in target units; the paper's
    0.2 is for clouds of unit standard deviation.  sample_size: points per trial, drawn without replacement;
    the paper takes 4 because 3 can be degenerate.  scale_range: hypotheses with another scale are discarded;
    a lower bound keeps out those that shrink the source into one dense spot of the target.
    Returns the similarity and the (N,) bool inliers of the best trial (ties: the smaller sum of their
    residuals), which are what the fit used; where those cannot carry a fit of their own, the best trial's
    similarity. Deterministic for a seed.
    Raises InputError for bad shapes, too few points, non-finite values, and where every sample is collinear
    or has a scale out of range.
    """
    if not (threshold > 0 and trials >= 1 and sample_size >= 3):
        raise InputError(
            f"ransac: threshold={threshold}, trials={trials}, sample_size={sample_size}; "
            "expected a positive threshold, at least 1 trial and at least 3 points per sample"
        )
    source, target = _point_pairs(source, target, minimum=sample_size)
    samples = _draw_samples(len(source), sample_size, trials, np.random.default_rng(seed))
    scale, rotation, translation, conditioning = umeyama_batch(source[samples], target[samples])
    usable = (conditioning > _COLLINEAR_SAMPLE) & (scale >= scale_range[0]) & (scale <= scale_range[1])
    if not usable.any():
        raise InputError(
            f"ransac: no usable sample in {trials} trials over {len(source)} points: all "
            f"collinear, or scale outside {scale_range}"
        )
    scale, rotation, translation = scale[usable], rotation[usable], translation[usable]

    residual = _residuals(scale, rotation, translation, source, target)
    inlier = residual < threshold
    counts = inlier.sum(axis=1)
    leaders = np.flatnonzero(counts == counts.max())
    best = leaders[np.where(inlier[leaders], residual[leaders], 0).sum(axis=1).argmin()]
    chosen = inlier[best]

    if counts[best] >= 3:
        *fit, conditioning = umeyama_batch(source[None, chosen], target[None, chosen])
        if conditioning[0] > _COLLINEAR_SAMPLE:
            return Sim3(*(part[0] for part in fit)), chosen
    return Sim3(scale[best], rotation[best], translation[best]), chosen


def _residuals(
    scale: Float[np.ndarray, " trials"],
    rotation: Float[np.ndarray, "trials 3 3"],
    translation: Float[np.ndarray, "trials 3"],
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "trials n"]:
    """|target - (scale * R @ source + t)| for every trial and point.

    The square, multiplied out, is one matrix product of what is known of the trials with what is known of the
    points: a third of the time of moving every point. Taken about the clouds' means, so that little cancels.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    x, y = source - source_mean, target - target_mean
    linear = scale[:, None, None] * rotation
    t = translation + linear @ source_mean - target_mean
    ones = np.ones((len(scale), 1))
    of_trials = np.hstack([
        np.square(t).sum(axis=1, keepdims=True), ones, np.square(scale)[:, None],
        2 * (t[:, None, :] @ linear)[:, 0], -2 * t, -2 * linear.reshape(-1, 9),
    ])  # fmt: skip
    of_points = np.hstack([
        np.ones((len(x), 1)),
        np.square(y).sum(axis=1, keepdims=True), np.square(x).sum(axis=1, keepdims=True),
        x, y, (y[:, :, None] * x[:, None, :]).reshape(-1, 9),
    ])  # fmt: skip
    return np.sqrt(np.maximum(of_trials @ of_points.T, 0))


def _draw_samples(n: int, size: int, trials: int, rng: np.random.Generator) -> Int[np.ndarray, "trials size"]:
    """`trials` uniform samples of `size` different indices below n, without a loop over the trials.

    The k-th draw picks among the n - k indices left: step over every earlier pick that is not above it.
    """
    samples = np.empty((trials, size), dtype=np.int64)
    for k in range(size):
        draw = rng.integers(n - k, size=trials)
        for earlier in np.sort(samples[:, :k], axis=1).T:
            draw += draw >= earlier
        samples[:, k] = draw
    return samples


def _point_pairs(source: ArrayLike, target: ArrayLike, minimum: int) -> tuple[np.ndarray, np.ndarray]:
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if source.ndim != 2 or source.shape[1:] != (3,) or source.shape != target.shape:
        raise InputError(f"source and target have shapes {source.shape} and {target.shape}, expected equal (N, 3)")
    if len(source) < minimum:
        raise InputError(f"got {len(source)} corresponding points, expected at least {minimum}")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise InputError("source or target holds non-finite coordinates, expected finite ones")
    for name, points in (("source", source), ("target", target)):
        longest, width, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if width <= _COLLINEAR_CLOUD * longest:
            raise InputError(f"the {len(points)} {name} points are all equal or collinear, expected some off the line")
    return source, target
