"""Print the times that docs/scale.md quotes, and the memory: `python -m tools.speed`, from the root of the repository.

All estimates are of one pair of the sample data with five target views. Times are medians; run it on an idle machine.
"""

import gzip
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import torch.nn.functional as F

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.course.demo import example_pair
from zsp_lite.course.samples import sample_data
from zsp_lite.data.annotations import FRAMES_FILE, SEQUENCES_FILE
from zsp_lite.data.co3d import Co3D
from zsp_lite.features import log_bin
from zsp_lite.matching import similarities
from zsp_lite.pipeline import ZeroShotPose

REPEATS, FRAMES = 7, 86_000


def seconds(function: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median time of a call; the first call is not counted."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times[1:]))


def write_category(root: Path, frames: int) -> None:
    """Write the annotations of a made-up category: those of a sample frame, in sequences of 100 frames."""
    folder = root / "category"
    folder.mkdir()
    source = next(sample_data().glob(f"*/{FRAMES_FILE}"))
    entry = json.loads(gzip.decompress(source.read_bytes()))[0]
    copies = (entry | {"sequence_name": f"sequence_{i // 100}", "frame_number": i % 100} for i in range(frames))
    (folder / FRAMES_FILE).write_bytes(gzip.compress(json.dumps(list(copies)).encode(), compresslevel=1))
    (folder / SEQUENCES_FILE).write_bytes(gzip.compress(b"[]"))


def one_estimate() -> None:
    """Make one estimate and print the peak memory of this process in bytes; `main` runs it in a new one."""
    dataset = Co3D(sample_data())
    ZeroShotPose(load_backbone(device="cpu")).estimate(*dataset.load_pair(example_pair(dataset)))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024))


def main() -> None:
    def report(name: str, value: float, unit: str = "ms") -> None:
        print(f"{name:62} {value:9.4g} {unit}", flush=True)

    report("threads", torch.get_num_threads(), "")
    tiny, dataset = load_backbone(device="cpu"), Co3D(sample_data())
    pair = example_pair(dataset)
    reference, targets = dataset.load_pair(pair)
    images, large = [one.rgb for one in (reference, *targets)], Backbone(VisionTransformer(), "DINO", device="cpu")
    report("forward pass of DINO ViT-S/8 with random weights, six images", 1000 * seconds(lambda: large(images)))
    report(f"the same with {tiny.name}", 1000 * seconds(lambda: tiny(images)))
    for solver in ("paper", "verified"):
        method = ZeroShotPose(tiny, solver=solver)
        runs = [method.estimate(reference, targets).timings for _ in range(REPEATS + 1)][1:]
        stages = {stage: 1000 * float(np.median([run[stage] for run in runs])) for stage in runs[0]}
        for stage in stages:
            report(f"{solver} solver: {stage}", stages[stage])
        report(f"{solver} solver: all but features", sum(stages.values()) - stages["features"])
    frame = dataset.frame(pair.category, pair.target_sequence, pair.target_frames[0])
    report("reading and features, per frame", 1000 * seconds(lambda: method.views([dataset.load(frame)])))

    keys = [torch.randn(28, 28, 384, generator=torch.Generator().manual_seed(i)) for i in range(6)]
    first, second = (log_bin(one[None])[0].flatten(0, 1) for one in keys[:2])
    fast = seconds(lambda: similarities(keys[0], keys[1:]))
    loop = 5 * len(first) * seconds(lambda: F.cosine_similarity(first[:1], second))  # of one descriptor, scaled
    report("similarity of log-binned descriptors, 5 targets", 1000 * fast)
    report("the same by a loop over the descriptors, times", loop / fast, "x")

    command = [sys.executable, "-c", "from tools.speed import one_estimate; one_estimate()"]
    peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    report("peak memory of a process that makes one estimate", int(peak) / 1e9, "GB")
    with TemporaryDirectory() as folder:
        write_category(Path(folder), FRAMES)
        opened = seconds(lambda: Co3D(folder).frame_list("category"), 3)
    report(f"opening a CO3D category of {FRAMES:,} annotated frames", opened, "s")


if __name__ == "__main__":
    main()
