"""Time and memory of one estimate by stage, and comparison of fast implementations with plain Python loops.

The backbone is dino_vits8 with random weights, because the time does not depend on them. The images show textured
ellipsoids with masks and incomplete depth, so that every stage has its usual amount of work.
"""

import gzip
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from zsp_lite.alignment import ransac, umeyama_batch
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.data.annotations import FRAMES_FILE, SEQUENCES_FILE
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.features import log_bin
from zsp_lite.matching import similarities
from zsp_lite.pipeline import ZeroShotPose

N_TARGETS = 5
_FRAMES_PER_SEQUENCE = 100


@dataclass(frozen=True)
class Measurement:
    """A measured value.

    Attributes:
        name: What was measured.
        value: In `unit`.
        unit: Its unit.
        limit: The value that the project requires on an idle machine, or None.
        at_most: Whether the limit is an upper one.
        note: Conditions of the measurement.
    """

    name: str
    value: float
    unit: str
    limit: float | None = None
    at_most: bool = True
    note: str = ""

    @property
    def within_limit(self) -> bool:
        """Whether the value keeps its limit; True without a limit."""
        return self.limit is None or (self.value <= self.limit if self.at_most else self.value >= self.limit)

    def __str__(self) -> str:
        text = f"{self.name:44} {self.value:10.4g} {self.unit}"
        if self.limit is not None:
            missed = "" if self.within_limit else ", MISSED"
            text += f"  ({'at most' if self.at_most else 'at least'} {self.limit:g}{missed})"
        return f"{text}  {self.note}" if self.note else text


def measure_all(repeats: int = 5) -> Iterator[Measurement]:
    """Yield all measurements as they are made; times are medians of `repeats` runs."""
    if hasattr(os, "getloadavg"):
        yield Measurement(
            "load average before", os.getloadavg()[0], "processes", note="the limits are for an idle machine"
        )
    yield from measure_stages(repeats)
    yield measure_verified_solver(repeats)
    yield from measure_similarity(repeats)
    yield from measure_ransac(repeats)
    yield measure_memory()
    yield from measure_annotations()


def measure_stages(repeats: int = 5) -> list[Measurement]:
    """Measure the stages of one estimate (N = 5, K = 50), and all but the forward pass as a share of it."""
    method = ZeroShotPose(random_vits8())
    reference, *targets = made_up_frames(1 + N_TARGETS)
    method.estimate(reference, targets)  # the first run includes allocations and lazy imports
    runs = [method.estimate(reference, targets).timings for _ in range(repeats)]
    names, note = {"features": "ViT forward, 6 images"}, f"{torch.get_num_threads()} threads"
    stages = [
        Measurement(names.get(stage, stage), 1000 * float(np.median([run[stage] for run in runs])), "ms", note=note)
        for stage in runs[0]
    ]
    share = 100 * float(np.median([sum(run.values()) / run["features"] - 1 for run in runs]))
    return [*stages, Measurement("all other stages, relative to the forward", share, "%", 25, note="N = 5, K = 50")]


def measure_verified_solver(repeats: int = 5) -> Measurement:
    """Measure the stages of the verified solver that follow features, similarities and matches."""
    method = ZeroShotPose(random_vits8(), foreground="mask", solver="verified")
    reference, *targets = method.views(made_up_frames(1 + N_TARGETS))
    pairs = [method.match_pair(reference, *one) for one in zip(targets, method.similarities(reference, targets))]
    (seconds,) = _median_seconds([lambda: method.estimate_from_pairs(reference, targets, pairs)], repeats)
    note = f"without features, similarities and matches; {torch.get_num_threads()} threads"
    return Measurement(f"verified solver, N = {N_TARGETS}", 1000 * seconds, "ms", 300, note=note)


def measure_similarity(repeats: int = 5, tokens: int = 8) -> list[Measurement]:
    """Measure the log-binned similarities of a reference and 5 targets, and a loop over materialised descriptors.

    Args:
        repeats: Runs behind each median.
        tokens: The loop is timed on so many of the 784 reference tokens, and scaled.
    """
    generator = torch.Generator().manual_seed(0)
    keys = [torch.randn(28, 28, 384, generator=generator) for _ in range(1 + N_TARGETS)]
    first, second = (log_bin(one[None])[0].flatten(0, 1) for one in keys[:2])
    runs = max(repeats, tokens)
    per_token, fast = _median_seconds(
        [lambda: F.cosine_similarity(first[:1], second), lambda: similarities(keys[0], keys[1:])], runs
    )
    loop = per_token * len(first) * N_TARGETS
    note = f"loop timed on {runs} of {len(first)} tokens and scaled"
    return [
        Measurement("similarity, 5 targets", 1000 * fast, "ms"),
        Measurement("similarity by a per-token loop, 5 targets", loop, "s", note=note),
        Measurement("similarity, times faster than the loop", loop / fast, "x", 300, at_most=False),
    ]


def measure_ransac(repeats: int = 5) -> list[Measurement]:
    """Measure RANSAC on 50 points with 60 % outliers and 1,000 trials, and a loop over the trials."""
    rng = np.random.default_rng(0)
    source = rng.normal(size=(50, 3))
    target = source + 0.02 * rng.normal(size=(50, 3))
    target[:30] = rng.normal(size=(30, 3))
    fast, loop = _median_seconds([lambda: ransac(source, target), lambda: ransac_by_loop(source, target)], 2 * repeats)
    return [
        Measurement("RANSAC, 1,000 trials, 50 points", 1000 * fast, "ms"),
        Measurement("RANSAC by a loop over the trials", 1000 * loop, "ms"),
        Measurement("RANSAC, times faster than the loop", loop / fast, "x", 15, at_most=False),
    ]


def ransac_by_loop(source: np.ndarray, target: np.ndarray, threshold: float = 0.2, trials: int = 1000) -> np.ndarray:
    """Run RANSAC as a plain loop: sample 4 points, fit, count the inliers, keep the best. Returns the inliers (N,)."""
    rng = np.random.default_rng(0)
    best = np.zeros(len(source), dtype=bool)
    for _ in range(trials):
        sample = rng.choice(len(source), 4, replace=False)
        (scale,), (rotation,), (translation,), _ = umeyama_batch(source[None, sample], target[None, sample])
        residual = np.linalg.norm(scale * source @ rotation.T + translation - target, axis=1)
        inliers = residual < threshold
        if inliers.sum() > best.sum():
            best = inliers
    return best


def measure_memory() -> Measurement:
    """Measure the peak memory of a process that imports the library and makes one estimate (N = 5)."""
    return Measurement("peak memory of one estimate", _in_new_process(_ESTIMATE) / 1e9, "GB", 1.5, note="whole process")


# Run in new processes: the peak memory of this one includes everything before.
_ESTIMATE = """
import json
from zsp_lite.benchmark.plan import process_memory
from zsp_lite.cli.profile import N_TARGETS, ZeroShotPose, made_up_frames, random_vits8
reference, *targets = made_up_frames(1 + N_TARGETS)
ZeroShotPose(random_vits8()).estimate(reference, targets)
print(json.dumps(process_memory()))
"""
_OPEN_CATEGORY = """
import json, sys, time
from zsp_lite.benchmark.plan import process_memory
from zsp_lite.data.co3d import Co3D
before = process_memory("VmRSS")
start = time.perf_counter()
dataset = Co3D(sys.argv[1])
keys = dataset.frame_list("category")
opened = time.perf_counter()
dataset.frames("category", keys[0].sequence_name)
print(json.dumps({"frames": len(keys), "seconds": opened - start, "sequence_seconds": time.perf_counter() - opened,
                  "memory_mb": (process_memory("VmHWM") - before) / 2**20}))
"""


def measure_annotations(frames: int = 86_000) -> list[Measurement]:
    """Measure the opening of a category of the largest kind (see `open_annotations`)."""
    found = open_annotations(frames)
    category, note = f"category of {found['frames']:,} frames", f"in addition to {found['json_mb']:.0f} MiB of JSON"
    return [
        Measurement(f"opening a {category}", found["seconds"], "s", 3),
        Measurement(f"memory to open a {category}", found["extra_memory_mb"], "MiB", 400, note=note),
    ]


def open_annotations(frames: int) -> dict[str, float]:
    """Open a made-up category in a new process.

    Returns:
        {"frames"; "seconds" to decompress and index the category; "sequence_seconds" to decode one sequence;
        "json_mb": size of the JSON in MiB; "memory_mb": peak memory in MiB beyond that before; "extra_memory_mb": the
        same less the JSON}.
    """
    with tempfile.TemporaryDirectory() as root:
        size = _write_category(Path(root), frames)
        found = _in_new_process(_OPEN_CATEGORY, root)
    return found | {"json_mb": size / 2**20, "extra_memory_mb": found["memory_mb"] - size / 2**20}


def _write_category(root: Path, frames: int) -> int:
    """Write frame annotations of the size of CO3D v1's, about 1.2 kB each. Returns the length of the JSON in bytes."""
    rng = np.random.default_rng(0)
    folder = root / "category"
    folder.mkdir()
    entries = ", ".join(json.dumps(_entry(index, rng.standard_normal(19).tolist())) for index in range(frames))
    data = f"[{entries}]".encode()
    (folder / FRAMES_FILE).write_bytes(gzip.compress(data, compresslevel=1))
    (folder / SEQUENCES_FILE).write_bytes(gzip.compress(b"[]"))
    return len(data)


def _entry(index: int, numbers: list[float]) -> dict:
    """A frame annotation with as many digits as a real one has."""
    sequence, number = divmod(index, _FRAMES_PER_SEQUENCE)
    name = f"{100 + sequence // 7}_{10000 + 37 * sequence}_{20000 + 53 * sequence}"
    stem = f"category/{name}/%s/frame{number + 1:06d}%s"
    splits = [f"{kind}_{split}" for kind in ("fewview", "manyview", "singlesequence")
              for split in ("train_known", "dev_known", "test_unseen")]  # fmt: skip
    return {
        "sequence_name": name,
        "frame_number": number,
        "frame_timestamp": number * 0.20120120120120122,
        "image": {"path": stem % ("images", ".jpg"), "size": [1920, 1080]},
        "depth": {
            "path": stem % ("depths", ".jpg.geometric.png"),
            "scale_adjustment": abs(numbers[0]) + 1,
            "mask_path": stem % ("depth_masks", ".png"),
        },
        "mask": {"path": stem % ("masks", ".png"), "mass": 1000 * abs(numbers[1])},
        "viewpoint": {
            "R": [numbers[2:5], numbers[5:8], numbers[8:11]],
            "T": numbers[11:14],
            "focal_length": [abs(numbers[14]) + 1, abs(numbers[15]) + 1],
            "principal_point": numbers[16:18],
        },
        # The reader skips this member, as it does those of later versions.
        "meta": {"frame_type": "train_known", "frame_splits": splits},
    }


def random_vits8() -> Backbone:
    """Return a backbone of the shape of dino_vits8 with random weights, on the CPU."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Backbone(VisionTransformer(), "random dino_vits8", device="cpu")


def made_up_frames(n: int, size: tuple[int, int] = (480, 640), seed: int = 0) -> list[Frame]:
    """Return frames of a textured ellipsoid with its mask, and with depth at two thirds of its pixels."""
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
        frames.append(Frame(rgb, known.astype(np.float32), inside.astype(np.float32), camera, f"generated {index}"))
    return frames


def _in_new_process(code: str, *arguments: str):
    """Run code in a new interpreter and return the JSON that it prints."""
    command = [sys.executable, "-c", code, *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def _median_seconds(functions: list[Callable[[], object]], repeats: int) -> list[float]:
    """Measure median wall times. The functions alternate, so that other load affects all of them equally."""
    times = np.empty((repeats, len(functions)))
    for function in functions:
        function()
    for row in times:
        for index, function in enumerate(functions):
            start = time.perf_counter()
            function()
            row[index] = time.perf_counter() - start
    return np.median(times, axis=0).tolist()
