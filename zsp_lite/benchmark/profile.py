"""Time and memory of one estimate by stage, and comparison of fast implementations with plain Python loops.

The backbone is dino_vits8 with random weights, because the time does not depend on them. The images show textured
ellipsoids with masks and incomplete depth, so that every stage has its usual amount of work.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from zsp_lite.alignment import ransac, umeyama_batch
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.benchmark.annotations import annotation_benchmark
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.features import log_bin
from zsp_lite.matching import similarities
from zsp_lite.pipeline import ZeroShotPose

N_TARGETS = 5


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        name: What was measured.
        value: The result.
        unit: Its unit.
        limit: Required value, or None.
        at_most: Whether the limit is an upper one.
        note: Further information.
    """

    name: str
    value: float
    unit: str
    limit: float | None = None
    at_most: bool = True
    note: str = ""

    @property
    def kept(self) -> bool:
        """Whether the limit is met; True without a limit."""
        if self.limit is None:
            return True
        return self.value <= self.limit if self.at_most else self.value >= self.limit

    def __str__(self) -> str:
        bound = "" if self.limit is None else f"  ({'at most' if self.at_most else 'at least'} {self.limit:g}"
        bound += "" if self.limit is None else ")" if self.kept else ", MISSED)"
        return f"{self.name:44} {self.value:10.4g} {self.unit}{bound}{'  ' + self.note if self.note else ''}"


def profile(repeats: int = 5) -> Iterator[Row]:
    """Yield all measurements; times are medians over `repeats` runs."""
    if repeats < 1:
        raise InputError(f"repeats is {repeats}, expected at least 1")
    if hasattr(os, "getloadavg"):
        yield Row("load average before", os.getloadavg()[0], "processes", note="the limits are for an idle machine")
    yield from stage_rows(repeats)
    yield verified_row(repeats)
    yield from similarity_rows(repeats)
    yield from ransac_rows(repeats)
    yield memory_row()
    yield from annotation_rows()


def stage_rows(repeats: int = 5) -> list[Row]:
    """Measure each stage of an estimate (N = 5, K = 50), and all others relative to the forward pass."""
    method = ZeroShotPose(random_vits8())
    reference, *targets = made_up_frames(1 + N_TARGETS)
    method.estimate(reference, targets)  # the first run includes allocations and lazy imports
    runs = [method.estimate(reference, targets).timings for _ in range(repeats)]
    stages = {stage: float(np.median([run[stage] for run in runs])) for stage in runs[0]}
    rest = [sum(run.values()) / run["features"] - 1 for run in runs]
    threads = f"{torch.get_num_threads()} threads"
    names = {"features": "ViT forward, 6 images"}
    rows = [Row(names.get(name, name), 1000 * value, "ms", note=threads) for name, value in stages.items()]
    share = 100 * float(np.median(rest))
    return [*rows, Row("all other stages, relative to the forward", share, "%", 25, note="N = 5, K = 50")]


def verified_row(repeats: int = 5) -> Row:
    """Measure the verified solver without feature extraction, similarities and matching."""
    method = ZeroShotPose(random_vits8(), foreground="mask", solver="verified")
    reference, *targets = method.views(made_up_frames(1 + N_TARGETS))
    compared = [method.match_pair(reference, *one) for one in zip(targets, method.similarities(reference, targets))]
    (seconds,) = _median_seconds([lambda: method.estimate_from_pairs(reference, targets, compared)], repeats)
    note = f"without features, similarities and matches; {torch.get_num_threads()} threads"
    return Row(f"verified solver, N = {N_TARGETS}", 1000 * seconds, "ms", 300, note=note)


def similarity_rows(repeats: int = 5, tokens: int = 8) -> list[Row]:
    """Compare the log-binned similarity of a reference with 5 targets to a loop over the reference's descriptors.

    The loop is timed on `tokens` of the 784 descriptors and scaled; computing the descriptors is not included.
    """
    generator = torch.Generator().manual_seed(0)
    keys = [torch.randn(28, 28, 384, generator=generator) for _ in range(1 + N_TARGETS)]
    first, second = (log_bin(one[None])[0].flatten(0, 1) for one in keys[:2])
    per_token, fast = _median_seconds(
        [lambda: F.cosine_similarity(first[:1], second), lambda: similarities(keys[0], keys[1:])],
        max(repeats, tokens),
    )
    loop = per_token * len(first) * N_TARGETS
    note = f"loop timed on {max(repeats, tokens)} of {len(first)} tokens and scaled"
    return [
        Row("similarity, 5 targets", 1000 * fast, "ms"),
        Row("similarity by a per-token loop, 5 targets", loop, "s", note=note),
        Row("similarity, times faster than the loop", loop / fast, "x", 300, at_most=False),
    ]


def ransac_rows(repeats: int = 5) -> list[Row]:
    """Compare RANSAC (50 points, 60 % outliers, 1,000 trials) to a loop over the trials."""
    rng = np.random.default_rng(0)
    source = rng.normal(size=(50, 3))
    target = source + 0.02 * rng.normal(size=(50, 3))
    target[:30] = rng.normal(size=(30, 3))
    fast, loop = _median_seconds([lambda: ransac(source, target), lambda: ransac_by_loop(source, target)], 2 * repeats)
    return [
        Row("RANSAC, 1,000 trials, 50 points", 1000 * fast, "ms"),
        Row("RANSAC by a loop over the trials", 1000 * loop, "ms"),
        Row("RANSAC, times faster than the loop", loop / fast, "x", 15, at_most=False),
    ]


def ransac_by_loop(
    source: np.ndarray, target: np.ndarray, threshold: float = 0.2, trials: int = 1000, seed: int = 0
) -> np.ndarray:
    """Run RANSAC as a plain loop over the trials; returns the inliers (N,) of the best one."""
    rng = np.random.default_rng(seed)
    best = np.zeros(len(source), dtype=bool)
    for _ in range(trials):
        sample = rng.choice(len(source), 4, replace=False)
        (scale,), (rotation,), (translation,), _ = umeyama_batch(source[None, sample], target[None, sample])
        residual = np.linalg.norm(scale * source @ rotation.T + translation - target, axis=1)
        inliers = residual < threshold
        if inliers.sum() > best.sum():
            best = inliers
    return best


# Runs in a new process, because the peak of this one includes everything that ran before.
_MEMORY = """
import json
from zsp_lite.benchmark.plan import process_memory
from zsp_lite.benchmark.profile import estimate_once
estimate_once()
print(json.dumps(process_memory()))
"""


def memory_row() -> Row:
    """Measure the peak memory of a process that imports the library, builds dino_vits8 and estimates one pose."""
    done = subprocess.run([sys.executable, "-c", _MEMORY], capture_output=True, text=True, check=True)
    return Row("peak memory of one estimate", json.loads(done.stdout) / 1e9, "GB", 1.5, note="whole process")


def estimate_once() -> None:
    """Estimate one pose with N = 5 target views and a dino_vits8 of random weights."""
    reference, *targets = made_up_frames(1 + N_TARGETS)
    ZeroShotPose(random_vits8()).estimate(reference, targets)


def annotation_rows(frames: int = 86_000) -> list[Row]:
    """Measure the opening of a large category (see `annotation_benchmark`)."""
    found = annotation_benchmark(frames)
    what = f"category of {found['frames']:,} frames"
    note = f"in addition to {found['json_mb']:.0f} MiB of JSON"
    return [
        Row(f"opening a {what}", found["seconds"], "s", 3),
        Row(f"memory to open a {what}", found["extra_memory_mb"], "MiB", 400, note=note),
    ]


def random_vits8() -> Backbone:
    """Return a dino_vits8 with random weights on the CPU."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Backbone(VisionTransformer(), "random dino_vits8", device="cpu")


def made_up_frames(n: int, size: tuple[int, int] = (480, 640), seed: int = 0) -> list[Frame]:
    """Generate frames of a textured ellipsoid with its mask, and with depth unknown in a third of the pixels."""
    rng = np.random.default_rng(seed)
    height, width = size
    camera = Camera(np.eye(3), np.zeros(3), np.full(2, float(width)), np.array([width, height]) / 2, size)
    y, x = np.mgrid[:height, :width]
    u, v = (x - width / 2) / (0.3 * width), (y - height / 2) / (0.35 * height)
    inside = u**2 + v**2 < 1
    depth = 4 - np.sqrt(np.where(inside, 1 - u**2 - v**2, 0))
    frames = []
    for index in range(n):
        texture = cv2.resize(rng.random((24, 32, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
        rgb = np.where(inside[..., None], 255 * texture.clip(0, 1), 90).astype(np.uint8)
        holes = cv2.resize(rng.random((30, 40)), (width, height)) < 0.42
        known = np.where(inside & ~holes, depth, 0)
        mask = inside.astype(np.float32)
        frames.append(Frame(rgb, known.astype(np.float32), mask, camera, f"generated {index}"))
    return frames


def _median_seconds(works: list[Callable[[], object]], repeats: int) -> list[float]:
    """Measure median wall times. The functions alternate, so that other load affects all of them equally."""
    times = np.empty((repeats, len(works)))
    for work in works:
        work()
    for row in times:
        for index, work in enumerate(works):
            start = time.perf_counter()
            work()
            row[index] = time.perf_counter() - start
    return np.median(times, axis=0).tolist()
