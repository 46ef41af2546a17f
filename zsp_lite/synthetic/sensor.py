"""Simulated capture: depth with holes and noise, soft masks and a fused point cloud, as in CO3D.

CO3D's depth comes from multi-view stereo (COLMAP), which finds no match without texture, at depth edges and at
grazing angles. Its masks come from a segmentation network (PointRend), accurate to one or two pixels.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from zsp_lite.data.co3d import SequenceData
from zsp_lite.data.frames import Frame
from zsp_lite.points import axis_deviation
from zsp_lite.synthetic.raytracing import Rendering
from zsp_lite.synthetic.sequences import RenderedSequence, rescaled
from zsp_lite.synthetic.textures import blur, smooth_noise

_DEPTH_NOISE = 0.005  # standard deviation relative to the depth, at the object
# Range of the fraction of pixels without depth, drawn per sequence. The wall has no depth at all.
_OBJECT_HOLES, _FLOOR_HOLES = (0.28, 0.46), (0.1, 0.3)
# Ranges of CO3D's viewpoint quality and point cloud quality in the sequences that the paper labels, and of CO3D's
# factor from stored depth to depth.
_SCORES = (1.3, 3.0), (0.35, 1.0), (0.4, 2.5)


def stereo_depth(
    view: Rendering, object_holes: float, floor_holes: float, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Simulate the depth map of multi-view stereo, 0 where there is no measurement.

    The holes are fractions of the pixels of the object and of the floor. The noise, mostly correlated between pixels,
    is 0.5 % of the depth at the object and grows with the square of the depth.
    """
    confidence = _stereo_confidence(view, rng)
    known = np.zeros(view.mask.shape, bool)
    for region, holes in ((view.mask, object_holes), (~view.mask & (view.depth > 0), floor_holes)):
        if region.any():
            known |= region & (confidence >= np.quantile(confidence[region], holes))
    near = np.median(view.depth[view.mask]) if view.mask.any() else np.inf  # a flat object may be seen edge-on
    noise = 0.95 * smooth_noise(rng, view.mask.shape, 2.0) + 0.3 * rng.standard_normal(view.mask.shape)
    noise *= _DEPTH_NOISE * np.minimum(view.depth / near, 3)
    return np.where(known, view.depth * np.maximum(1 + noise, 0.5), 0).astype(np.float32)


def _stereo_confidence(view: Rendering, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return how well stereo would match each pixel: badly at depth edges and grazing angles."""
    scale = min(view.mask.shape) / 100
    grey = blur(view.rgb.astype(np.float32) @ np.float32([0.299, 0.587, 0.114]), max(0.6 * scale, 0.3))
    energy = cv2.Sobel(grey, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(grey, cv2.CV_32F, 0, 1) ** 2
    texture = np.log(np.sqrt(blur(energy, 2.5 * scale)) + 1)
    texture = (texture - texture.mean()) / (texture.std() + 1e-6)
    far = np.where(view.depth > 0, view.depth, view.depth.max())
    jump = cv2.dilate(far, np.ones((3, 3))) / cv2.erode(far, np.ones((3, 3))) - 1
    edge = np.minimum(blur((jump > 0.03).astype(np.float32), max(0.5 * scale, 0.3)) * 2, 1)
    h, w = view.mask.shape
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    ray = view.camera.unproject_camera(np.stack([x, y], -1), np.ones((h, w)))
    facing = np.abs((view.normals * ray).sum(-1)) / np.linalg.norm(ray, axis=-1)
    grazing = np.where(view.mask, np.clip(1 - facing / 0.5, 0, 1), 0)
    noise = 0.7 * smooth_noise(rng, (h, w), 5 * scale) + 0.4 * smooth_noise(rng, (h, w), 1.5 * scale)
    return texture + noise - 1.5 * edge - 1.5 * grazing


def soft_mask(mask: Bool[np.ndarray, "h w"], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Simulate the probability map (float32) of a segmentation network: a soft edge, displaced by up to two pixels."""
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    distance -= np.where(mask, 0.5, -0.5)
    wander = np.clip(0.8 * smooth_noise(rng, mask.shape, 0.04 * min(mask.shape)), -1.5, 1.5)
    return (1 / (1 + np.exp(-np.clip(distance + wander, -14, 14) / 0.7))).astype(np.float32)


def fused_cloud(
    views: Sequence[Rendering], depths: Sequence[Float[np.ndarray, "h w"]], n_points: int, rng: np.random.Generator
) -> list[np.ndarray]:
    """Sample points of the object from the depth maps of all views: world points, unit normals, 8-bit colours."""
    parts = []
    for view, depth in zip(views, depths, strict=True):
        row, col = np.nonzero((depth > 0) & view.mask)
        points = view.camera.unproject(np.stack([col + 0.5, row + 0.5], -1), depth[row, col])
        parts.append((points, view.normals[row, col] @ view.camera.R, view.rgb[row, col]))
    cloud = [np.concatenate(values) for values in zip(*parts, strict=True)]
    chosen = np.sort(rng.choice(len(cloud[0]), min(n_points, len(cloud[0])), replace=False))
    return [values[chosen] for values in cloud]


def simulate_capture(
    sequence: RenderedSequence, name: str, rng: np.random.Generator
) -> tuple[SequenceData, RenderedSequence]:
    """Return a sequence with the errors of CO3D's data, and the exact one; the point cloud has CO3D's unit spread."""
    object_holes, floor_holes = rng.uniform(*_OBJECT_HOLES), rng.uniform(*_FLOOR_HOLES)
    depths, masks = [], []
    for view in sequence.views:
        shares = np.clip(np.array([object_holes, floor_holes]) + rng.normal(0, 0.03, 2), 0.05, 0.9)
        depths.append(stereo_depth(view, *shares, rng))
        masks.append(soft_mask(view.mask, rng))
    points, normals, colours = fused_cloud(sequence.views, depths, int(rng.integers(5000, 8001)), rng)
    factor = round(1 / axis_deviation(points), 9)
    exact = rescaled(sequence, factor)
    frames = [
        Frame(view.rgb, depth * np.float32(factor), mask, view.camera, f"{name}/{number}")
        for number, (view, depth, mask) in enumerate(zip(exact.views, depths, masks, strict=True))
    ]
    scores = [round(rng.uniform(*limits), 4) for limits in _SCORES]
    return SequenceData(name, frames, sequence.timestamps, points * factor, colours, normals, *scores), exact
