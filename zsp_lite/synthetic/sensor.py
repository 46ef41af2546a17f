"""From exact renderings to data like CO3D's: depth with holes and noise, soft masks, a fused point cloud.

CO3D's depth comes from multi-view stereo (COLMAP), which finds no match where there is no texture, at depth
edges and at grazing angles; its masks come from a segmentation network (PointRend), right to a pixel or two.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.data.co3d import SequenceData
from zsp_lite.data.frames import Frame
from zsp_lite.synthetic.render import Rendering
from zsp_lite.synthetic.sequences import RenderedSequence, rescaled

_DEPTH_NOISE = 0.005  # of the depth, at the object
# Unknown share of the object's and of the floor's pixels, drawn per sequence; the wall is too far away.
_OBJECT_HOLES, _FLOOR_HOLES = (0.28, 0.46), (0.1, 0.3)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """World points with unit normals and 8-bit colours."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]


def smooth_noise(rng: np.random.Generator, size: tuple[int, int], sigma: float) -> Float[np.ndarray, "h w"]:
    """Gaussian noise (H, W) correlated over `sigma` pixels, of unit variance."""
    noise = _blur(rng.standard_normal(size).astype(np.float32), sigma)
    return noise / (noise.std() + 1e-6)


def stereo_confidence(view: Rendering, seed: int | np.random.Generator) -> Float[np.ndarray, "h w"]:
    """How readily stereo would match each pixel, (H, W), in no particular unit.

    High where the picture has texture at a coarse scale; low at depth edges and at grazing angles; the rest
    is luck, in patches.
    """
    rng = np.random.default_rng(seed)
    scale = min(view.mask.shape) / 100
    grey = _blur(view.rgb.astype(np.float32) @ np.float32([0.299, 0.587, 0.114]), 0.6 * scale)
    energy = cv2.Sobel(grey, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(grey, cv2.CV_32F, 0, 1) ** 2
    texture = np.log(np.sqrt(_blur(energy, 2.5 * scale)) + 1)
    texture = (texture - texture.mean()) / (texture.std() + 1e-6)
    far = np.where(view.depth > 0, view.depth, view.depth.max())
    jump = cv2.dilate(far, np.ones((3, 3))) / cv2.erode(far, np.ones((3, 3))) - 1
    edge = np.minimum(_blur((jump > 0.03).astype(np.float32), 0.5 * scale) * 2, 1)
    h, w = view.mask.shape
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    ray = view.camera.unproject_camera(np.stack([x, y], -1), np.ones((h, w)))
    facing = np.abs((view.normals * ray).sum(-1)) / np.linalg.norm(ray, axis=-1)
    grazing = np.where(view.mask, np.clip(1 - facing / 0.5, 0, 1), 0)
    luck = 0.7 * smooth_noise(rng, (h, w), 5 * scale) + 0.4 * smooth_noise(rng, (h, w), 1.5 * scale)
    return texture + luck - 1.5 * edge - 1.5 * grazing


def stereo_depth(
    view: Rendering, seed: int | np.random.Generator, object_holes: float = 0.4, floor_holes: float = 0.2
) -> Float[np.ndarray, "h w"]:
    """Depth (float32, 0 = unknown) as stereo would give it, with the wanted shares of unknown pixels.

    The shares hold for the object's pixels and for those of the floor. The noise is mostly correlated; it is
    0.5 % of the depth at the object and grows with the square of the depth, as stereo's does.
    """
    rng = np.random.default_rng(seed)
    confidence = stereo_confidence(view, rng)
    known = np.zeros(view.mask.shape, bool)
    for region, holes in ((view.mask, object_holes), (~view.mask & (view.depth > 0), floor_holes)):
        if region.any():
            known |= region & (confidence >= np.quantile(confidence[region], np.clip(holes, 0, 1)))
    near = np.median(view.depth[view.mask])
    noise = 0.95 * smooth_noise(rng, view.mask.shape, 2.0) + 0.3 * rng.standard_normal(view.mask.shape)
    noise *= _DEPTH_NOISE * np.minimum(view.depth / near, 3)
    return np.where(known, view.depth * np.maximum(1 + noise, 0.5), 0).astype(np.float32)


def soft_mask(mask: Bool[np.ndarray, "h w"], seed: int | np.random.Generator) -> Float[np.ndarray, "h w"]:
    """A segmentation network's probability (float32): a blurred edge that wanders by a pixel or two."""
    rng = np.random.default_rng(seed)
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    distance -= np.where(mask, 0.5, -0.5)
    wander = np.clip(0.8 * smooth_noise(rng, mask.shape, 0.04 * min(mask.shape)), -1.5, 1.5)
    return (1 / (1 + np.exp(-np.clip((distance + wander) / 0.7, -20, 20)))).astype(np.float32)


def fused_cloud(
    views: Sequence[Rendering],
    depths: Sequence[Float[np.ndarray, "h w"]],
    n_points: int,
    seed: int | np.random.Generator,
) -> PointCloud:
    """At most `n_points` object points of the views' known depths, drawn at random, in the views' world."""
    rng = np.random.default_rng(seed)
    points, normals, colours = [], [], []
    for view, depth in zip(views, depths, strict=True):
        row, col = np.nonzero((depth > 0) & view.mask)
        points.append(view.camera.unproject(np.stack([col + 0.5, row + 0.5], -1), depth[row, col]))
        normals.append(view.normals[row, col] @ view.camera.R)
        colours.append(view.rgb[row, col])
    points, normals, colours = (np.concatenate(values) for values in (points, normals, colours))
    chosen = np.sort(rng.choice(len(points), min(n_points, len(points)), replace=False))
    return PointCloud(points[chosen], normals[chosen].astype(np.float64), colours[chosen])


def observe(
    sequence: RenderedSequence, name: str, seed: int | np.random.Generator
) -> tuple[SequenceData, RenderedSequence]:
    """The sequence as CO3D would hold it, and its exact twin in the same unit.

    The unit of the world is set so that the point cloud has unit standard deviation, averaged over its axes;
    cameras and depth follow. The quality scores are drawn from the range of sequences worth labelling.
    """
    rng = np.random.default_rng(seed)
    object_holes, floor_holes = rng.uniform(*_OBJECT_HOLES), rng.uniform(*_FLOOR_HOLES)
    depths, masks = [], []
    for view in sequence.views:
        shares = np.clip(np.array([object_holes, floor_holes]) + rng.normal(0, 0.03, 2), 0.05, 0.9)
        depths.append(stereo_depth(view, rng, *shares))
        masks.append(soft_mask(view.mask, rng))
    cloud = fused_cloud(sequence.views, depths, int(rng.integers(5000, 8001)), rng)
    factor = round(float(1 / cloud.points.std(0).mean()), 9)
    exact = rescaled(sequence, factor)
    frames = [
        Frame(view.rgb, depth * np.float32(factor), mask, view.camera, f"{name}/{number}")
        for number, (view, depth, mask) in enumerate(zip(exact.views, depths, masks, strict=True))
    ]
    data = SequenceData(
        name=name,
        frames=frames,
        timestamps=sequence.timestamps,
        points=cloud.points * factor,
        colours=cloud.colours,
        normals=cloud.normals,
        viewpoint_quality=round(rng.uniform(1.3, 3.0), 4),
        point_cloud_quality=round(rng.uniform(0.35, 1.0), 4),
        depth_scale_adjustment=round(rng.uniform(0.4, 2.5), 4),
    )
    return data, exact


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), max(sigma, 0.3), borderType=cv2.BORDER_REFLECT)
