"""Print the times and the memory that docs/scale.md quotes: `python -m tools.speed`.

Run it from the root of the repository, on an idle machine. All estimates are of one pair of the
sample data with five target views. Times are medians.
"""

import resource
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.course.demo import example_pair
from zsp_lite.course.samples import sample_data
from zsp_lite.data.co3d import Co3D
from zsp_lite.matching import similarities
from zsp_lite.pipeline import ZeroShotPose

REPEATS = 7  # odd, so that the median is one of the times


def seconds(function: Callable[[], object]) -> float:
    """Return the median time of a call; the first call, which fills caches, is not counted."""
    times = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times[1:]))


def one_estimate() -> None:
    """Make one estimate and print the peak memory of this process in bytes; `main` runs this in a
    new process."""
    dataset = Co3D(sample_data())
    ZeroShotPose(load_backbone(device="cpu")).estimate(*dataset.load_pair(example_pair(dataset)))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(peak if sys.platform == "darwin" else 1024 * peak)  # Linux counts in KiB


def main() -> None:
    """Measure and print everything."""

    def report(name: str, value: float, unit: str = "ms") -> None:
        print(f"{name:62} {value:9.4g} {unit}", flush=True)

    report("threads", torch.get_num_threads(), "")
    dataset = Co3D(sample_data())
    pair = example_pair(dataset)
    reference, targets = dataset.load_pair(pair)
    images = [frame.rgb for frame in (reference, *targets)]

    # The networks.
    tiny = load_backbone(device="cpu")
    large = Backbone(VisionTransformer(), "DINO", device="cpu")
    report(
        "forward pass of DINO ViT-S/8 with random weights, six images",
        1000 * seconds(lambda: large(images)),
    )
    report(f"the same with {tiny.name}", 1000 * seconds(lambda: tiny(images)))

    # The stages of an estimate, by medians; the first run is not counted.
    for solver in ("paper", "verified"):
        method = ZeroShotPose(tiny, solver=solver)
        runs = [method.estimate(reference, targets).timings for _ in range(REPEATS + 1)][1:]
        stages = {stage: 1000 * float(np.median([run[stage] for run in runs])) for stage in runs[0]}
        for stage, duration in stages.items():
            report(f"{solver} solver: {stage}", duration)
        report(f"{solver} solver: all but features", sum(stages.values()) - stages["features"])
    # Both solvers read and extract alike; `method` is the last one.
    frame = dataset.frame(pair.category, pair.target_sequence, pair.target_frames[0])
    report(
        "reading and features, per frame",
        1000 * seconds(lambda: method.views([dataset.load(frame)])),
    )

    # Random keys of the reference and five targets, as large as DINO's.
    keys = [torch.randn(28, 28, 384, generator=torch.Generator().manual_seed(i)) for i in range(6)]
    report(
        "similarity of log-binned descriptors, 5 targets",
        1000 * seconds(lambda: similarities(keys[0], keys[1:])),
    )

    command = [sys.executable, "-c", "from tools.speed import one_estimate; one_estimate()"]
    peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    report("peak memory of a process that makes one estimate", int(peak) / 1e9, "GB")


if __name__ == "__main__":
    main()
