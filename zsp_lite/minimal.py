"""The whole method on one page (Goodwin et al., ECCV 2022): features of object crops in, pose out.

Each step is its definition; the library's other modules compute the same with fewer operations. The
one exception is `estimate_pose`: here it takes crops, in the library files or frames. I1 is the
reference image, I2 a target image, Phi(I) the descriptors of I, u a patch of I1 and v one of I2.
"""

from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
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
    x = unproject(*pixel_depths(reference, u))
    y = unproject(*pixel_depths(targets[view], v))
    (scale, R, t), inliers = ransac(x, y, trials, threshold, np.random.default_rng(seed))
    return Pose(scale, R, t, view, (u, v), inliers)


def descriptor(image, row, column, step):
    """Take the 9 vectors of image (h, w, d) at and around a patch; a step ends at the border."""
    rows = [np.clip(row + step * i, 0, image.shape[0] - 1) for i in (-1, 0, 1)]
    columns = [np.clip(column + step * i, 0, image.shape[1] - 1) for i in (-1, 0, 1)]
    return [image[i, j] for i in rows for j in columns]


def log_bin(keys):
    """Compute the normalised descriptors (h * w, 17 d) of keys (h, w, d) (Amir et al. 2021).

    Bins: the keys of 3 x 3 neighbours, and means over 3 x 3 patches at the 8 ones at distance 3.
    """
    keys = torch.as_tensor(keys).double()
    row, column = np.indices(keys.shape[:2])
    far = descriptor(means(keys), row, column, 3)
    bins = descriptor(keys, row, column, 1) + far[:4] + far[5:]
    return normalize(torch.cat(bins, dim=2).flatten(0, 1), dim=1)


def means(keys):
    """Compute the means of the 3 x 3 keys around each patch (h, w, d); at a border, of fewer."""
    channels = keys.permute(2, 0, 1)  # first, as pooling takes them
    return avg_pool2d(channels, 3, stride=1, padding=1, count_include_pad=False).permute(1, 2, 0)


def cycle(cosine, place, on1, on2):
    """Follow each patch u to its nearest v, and v to u' (eq. 2): v, and -C_u = d(u, u') or inf."""
    v = cosine.argmax(axis=1)  # of unit vectors, the largest cosine is the smallest distance
    back = cosine.argmax(axis=0)[v]
    distance = np.linalg.norm(place - place[back], axis=1)
    return v, np.where(on1 & on2[v] & on1[back], distance, np.inf)


def kmeans(vectors, k, seed=0):
    """Assign n vectors to k clusters: labels (n,)."""
    from sklearn.cluster import KMeans  # takes half a second

    values, axes = np.linalg.eigh((vectors @ vectors.T).round(decimals=6))  # ties stay ties
    points = axes * np.sqrt(np.maximum(values, 0))  # with these distances
    draw = int(np.random.default_rng(seed).integers(2**31))
    return KMeans(k, n_init=1, random_state=draw).fit_predict(points)


def choose(distance, cosine, descriptors, salience, k, kmeans=kmeans):
    """Choose at most k patches u: the most salient of k clusters of the 2k with the smallest
    distances; of equal distances, the most similar."""
    best = np.lexsort([-cosine, distance])
    best = best[np.isfinite(distance[best])][: 2 * k]
    if len(best) <= k:
        return best
    label = kmeans(descriptors[best], k)
    clusters = [best[label == cluster] for cluster in np.unique(label)]
    return best[np.isin(best, [members[salience[members].argmax()] for members in clusters])]


def find_matches(reference, target, k, seed):
    """Find at most k matches (sec. 4.1): patches u and v (n, 2), cosines of descriptors (n,)."""
    phi1, phi2 = log_bin(reference.keys).numpy(), log_bin(target.keys).numpy()
    salience1, salience2 = reference.saliency.ravel(), target.saliency.ravel()
    place1 = np.argwhere(np.ones(reference.saliency.shape))  # (row, column) of each patch
    place2 = np.argwhere(np.ones(target.saliency.shape))
    cosine = phi1 @ phi2.T
    v, distance = cycle(cosine, place1, salience1 > SALIENT, salience2 > SALIENT)
    nearest = cosine[np.arange(len(v)), v]
    u = choose(distance, nearest, phi1, salience1, k, partial(kmeans, seed=seed))
    return place1[u], place2[v[u]], nearest[u]


def view_score(cosine, k):
    """Sum -d(Phi(I1)_u, Phi(I2)_v) over k matches (eq. 3); missing ones count as orthogonal."""
    # of unit vectors, d^2 = 2 - 2 cosine
    return -np.sqrt(np.maximum(2 - 2 * cosine, 0)).sum() - (k - len(cosine)) * np.sqrt(2)


def pixel_depths(crop, patches):
    """Find a pixel of each patch: centres (n, 2) as (x, y), depths (n,), and the intrinsics.

    It is at the 25th percentile of the known depths, or the centre, in-painted, if none is known.
    """
    known = crop.depth > 0
    filled = cv2.inpaint(crop.depth, np.uint8(~known), 3, cv2.INPAINT_NS)  # may overshoot
    filled = np.clip(np.nan_to_num(filled), crop.depth[known].min(), crop.depth.max())
    height, width = np.array(crop.depth.shape) // crop.saliency.shape  # of a patch, in pixels
    found = np.empty((len(patches), 3))
    for i, (top, left) in enumerate(patches * (height, width)):
        depth = np.where(known, crop.depth, np.inf)[top : top + height, left : left + width].ravel()
        count = np.isfinite(depth).sum()
        pixel = height // 2 * width + width // 2
        if count:
            pixel = np.argsort(depth, kind="stable")[(count - 1) // 4]
        row, column = top + pixel // width, left + pixel % width
        found[i] = column + 0.5, row + 0.5, filled[row, column]
    return found[:, :2], found[:, 2], crop.K


def unproject(pixels, depth, K):
    """Compute depth * K^-1 (x, y, 1), the points (n, 3) of pixels (n, 2) (supplement)."""
    rays = np.linalg.solve(K, np.column_stack([pixels, np.ones(len(pixels))]).T).T
    return depth[:, None] * rays


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


def draw_samples(n, trials, rng):
    """Draw samples of 4 of n matches, without replacement: (trials, 4)."""
    samples = np.empty((trials, 4), dtype=int)
    for i in range(4):  # a rank among the indices that are not in the sample yet
        samples[:, i] = rng.integers(n - i, size=trials)
        for earlier in np.sort(samples[:, :i]).T:
            samples[:, i] += samples[:, i] >= earlier
    return samples


def ransac(x, y, trials, threshold, rng):
    """Fit a similarity to samples of 4 matches, and refit the best to its inliers (sec. 4.3)."""
    if len(x) < 4:
        raise InputError(f"the best view has {len(x)} matches, expected at least 4")
    best, agreement = None, (-1, 0)
    for sample in draw_samples(len(x), trials, rng):
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
