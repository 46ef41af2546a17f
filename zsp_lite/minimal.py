"""The whole method on one page (Goodwin et al., ECCV 2022): features of object crops in, pose out.

Each step is its definition; the library's other modules compute the same with fewer operations. The
one exception is `estimate_pose`: here it takes crops, in the library files or frames. I1 is the
reference image, I2 a target image, Phi(I) the descriptors of I, u a patch of I1 and v one of I2.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from sklearn.cluster import KMeans
from torch.nn.functional import avg_pool2d, normalize

from zsp_lite.errors import InputError

SALIENT = 0.05  # a patch is foreground if its saliency is above this
SCALES = (0.2, 5.0)  # smallest and largest scale between two objects of a category
COLLINEAR = 1e-6  # of 3D points on a line, the ratio of the covariance's singular values is smaller


class Crop(NamedTuple):
    """An object crop: features of h x w patches from a vision transformer, depth and camera."""

    keys: np.ndarray  # (h, w, d), of one block
    saliency: np.ndarray  # (h, w), attention of the class token, scaled to [0, 1]
    depth: np.ndarray  # (H, W) float32, along the optical axis; 0 where unknown
    K: np.ndarray  # (3, 3) intrinsics in pixels; pixel centres are at half-integers


class Pose(NamedTuple):
    """The similarity x -> scale * R @ x + t from the reference camera to that of target `view`."""

    scale: float
    R: np.ndarray  # (3, 3)
    t: np.ndarray  # (3,)
    view: int
    matches: tuple[np.ndarray, np.ndarray]  # patches u and v as (row, column), each (n, 2)
    inliers: np.ndarray  # (n,) bool, the matches that agree with the pose


def estimate_pose(reference: Crop, targets, k=50, trials=1000, threshold=0.2, seed=0) -> Pose:
    """Estimate the pose of the reference object in the best of the target views."""
    matches = [find_matches(reference, target, k, seed) for target in targets]
    view = int(np.argmax([view_score(cosine, k) for _, _, cosine in matches]))
    u, v, _ = matches[view]
    x, y = unproject(reference, u), unproject(targets[view], v)
    (scale, R, t), inliers = ransac(x, y, trials, threshold, np.random.default_rng(seed))
    return Pose(scale, R, t, view, (u, v), inliers)


def log_bin(keys):
    """Compute the normalised descriptors (h * w, 17 d) of keys (h, w, d) (Amir et al. 2021).

    Bins: the keys of 3 x 3 neighbours, and means over 3 x 3 patches at the 8 ones at distance 3.
    """
    keys = torch.as_tensor(keys).double()
    channels = keys.permute(2, 0, 1)  # first, as pooling takes them
    coarse = avg_pool2d(channels, 3, stride=1, padding=1, count_include_pad=False).permute(1, 2, 0)
    row, column = np.indices(keys.shape[:2])

    def neighbours(image, dy, dx):
        return image[(row + dy).clip(0, row.max()), (column + dx).clip(0, column.max())]

    bins = [neighbours(keys, dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    bins += [neighbours(coarse, dy, dx) for dy in (-3, 0, 3) for dx in (-3, 0, 3) if dy or dx]
    return normalize(torch.cat(bins, dim=2).flatten(0, 1), dim=1)


def find_matches(reference, target, k, seed):
    """Find at most k matches (sec. 4.1): patches u and v (n, 2), cosines of descriptors (n,)."""
    phi1, phi2 = log_bin(reference.keys), log_bin(target.keys)
    salience1, salience2 = reference.saliency.ravel(), target.saliency.ravel()
    place1 = np.argwhere(np.ones(reference.saliency.shape))  # (row, column) of each patch
    place2 = np.argwhere(np.ones(target.saliency.shape))
    cosine = (phi1 @ phi2.T).numpy()  # the largest cosine of unit vectors is the smallest distance

    # Cycle (eq. 2): v is the nearest neighbour of u, and u' that of v. Off the object: infinite.
    u = np.arange(len(phi1))
    v = cosine.argmax(axis=1)
    u_cycle = cosine.argmax(axis=0)[v]
    on_object = np.minimum(np.minimum(salience1[u], salience2[v]), salience1[u_cycle]) > SALIENT
    distance = np.linalg.norm(place1[u] - place1[u_cycle], axis=1)  # -C_u = d(u, u')
    distance = np.where(on_object, distance, np.inf)

    # Of the 2k smallest distances (of equal ones, the most similar), the most salient of k clusters
    best = np.lexsort([-cosine[u, v], distance])
    best = best[np.isfinite(distance[best])][: 2 * k]
    if len(best) > k:
        # k-means needs only distances: points in 2k dimensions with the same inner products do.
        values, vectors = np.linalg.eigh((phi1[best] @ phi1[best].T).round(decimals=6).numpy())
        points = vectors * np.sqrt(np.maximum(values, 0))
        draw = int(np.random.default_rng(seed).integers(2**31))
        label = KMeans(k, n_init=1, random_state=draw).fit_predict(points)
        clusters = [best[label == cluster] for cluster in np.unique(label)]
        best = best[np.isin(best, [members[salience1[members].argmax()] for members in clusters])]
    return place1[best], place2[v[best]], cosine[best, v[best]]


def view_score(cosine, k):
    """Sum -d(Phi(I1)_u, Phi(I2)_v) over k matches (eq. 3); missing ones count as orthogonal."""
    # of unit vectors, d^2 = 2 - 2 cosine
    return -np.sqrt(np.maximum(2 - 2 * cosine, 0)).sum() - (k - len(cosine)) * np.sqrt(2)


def unproject(crop, patches):
    """Compute depth * K^-1 (column, row, 1) at one pixel of each patch (supplement).

    It is at the 25th percentile of the known depths, or the centre, in-painted, if none is known.
    """
    known = crop.depth > 0
    filled = cv2.inpaint(crop.depth, np.uint8(~known), 3, cv2.INPAINT_NS)
    filled = np.clip(np.nan_to_num(filled), crop.depth[known].min(), crop.depth.max())
    height, width = np.array(crop.depth.shape) // crop.saliency.shape  # of a patch, in pixels
    points = []
    for top, left in patches * (height, width):
        depth = np.where(known, crop.depth, np.inf)[top : top + height, left : left + width].ravel()
        count = np.isfinite(depth).sum()
        pixel = height // 2 * width + width // 2
        if count:
            pixel = np.argsort(depth, kind="stable")[(count - 1) // 4]
        row, column = top + pixel // width, left + pixel % width
        points.append(filled[row, column] * np.linalg.solve(crop.K, [column + 0.5, row + 0.5, 1]))
    return np.array(points)


def umeyama(x, y, scales=(0, np.inf)):
    """Minimise sum |y - (scale * R @ x + t)|^2 (eq. 4; Umeyama 1991); None for points on a line."""
    x0, y0 = x - x.mean(axis=0), y - y.mean(axis=0)
    U, D, Vt = np.linalg.svd(y0.T @ x0)
    if D[1] <= COLLINEAR * D[0]:
        return None
    S = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])  # a rotation, never a reflection
    R = U * S @ Vt
    scale = np.clip(D @ S / np.square(x0).sum(), *scales)
    return scale, R, y.mean(axis=0) - scale * R @ x.mean(axis=0)


def ransac(x, y, trials, threshold, rng):
    """Fit a similarity to samples of 4 matches, and refit the best to its inliers (sec. 4.3)."""
    if len(x) < 4:
        raise InputError(f"the best view has {len(x)} matches, expected at least 4")
    samples = np.empty((trials, 4), dtype=int)
    for i in range(4):  # without replacement: a rank among the indices not in the sample yet
        samples[:, i] = rng.integers(len(x) - i, size=trials)
        for earlier in np.sort(samples[:, :i]).T:
            samples[:, i] += samples[:, i] >= earlier
    best, agreement = None, (-1, 0)
    for sample in samples:
        fit = umeyama(x[sample], y[sample])
        if fit and SCALES[0] <= fit[0] <= SCALES[1]:
            scale, R, t = fit
            residual = np.linalg.norm(y - (scale * x @ R.T + t), axis=1)
            inliers = residual < threshold
            found = (inliers.sum(), -residual[inliers].sum())  # of equal numbers, the closer
            if found > agreement:
                best, agreement = (fit, inliers), found
    if best is None:
        raise InputError(f"no sample of 4 matches spans a plane and has a scale in {SCALES}")
    fit, inliers = best
    refit = umeyama(x[inliers], y[inliers], SCALES) if inliers.sum() >= 3 else None
    return refit or fit, inliers
