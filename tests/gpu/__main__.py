"""Checks on a CUDA GPU against the CPU of the same machine: poses, notebooks, speed; skipped
without a GPU.

    python -m tests.gpu [--parts poses notebooks speed] [--device cuda] [--out outputs/gpu]

`--device cpu` is a trial run where there is no GPU.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from tools.speed import seconds
from zsp_lite import Backbone, Co3D, ZeroShotPose, load_backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.choices import SOLVERS
from zsp_lite.course.demo import example_pair
from zsp_lite.course.samples import sample_data
from zsp_lite.data.pairs import labelled_categories, shipped_pairs
from zsp_lite.io.files import REPOSITORY
from zsp_lite.metrics import rotation_error
from zsp_lite.scans.pair_result import run_pair
from zsp_lite.views import object_crop

CORES = os.cpu_count()
LARGEST_ANGLE = 1.0  # degrees between the poses of two devices that count as equal
# Share of pairs of a solver that may differ: where features differ in their last digits, a tie may
# fall the other way.
TIES = 0.05
Result = tuple[list[str], list[str]]  # lines of a table, and failures in words


def poses(device: str) -> Result:
    """Compare the poses from the features of both devices, of all pairs with five target views."""
    dataset = Co3D(sample_data())
    pairs = [
        pair
        for category in labelled_categories(dataset)
        for pair in shipped_pairs(dataset, category, 5)
    ]
    rotations = []
    for place in (device, "cpu"):
        method = ZeroShotPose(load_backbone(device=place))
        for pair in pairs:
            estimates = run_pair(dataset, pair, method, SOLVERS["both"]).estimates
            rotations.append([estimates[solver].world_sim3.R for solver in SOLVERS["both"]])
    # Angles between both devices, (pairs, solvers).
    angles = rotation_error(*np.reshape(rotations, (2, len(pairs), -1, 3, 3)))
    lines = []
    failures = []
    for solver, apart in zip(SOLVERS["both"], angles.T):
        differ = [
            f"{pair.key} by {angle:.1f}°"
            for pair, angle in zip(pairs, apart)
            if angle > LARGEST_ANGLE
        ]
        line = (
            f"{solver} solver: {len(differ)} of {len(pairs)} poses differ between {device} and "
            f"cpu: {differ}"
        )
        lines.append(f"| {line} | | |")
        if len(differ) > TIES * len(pairs):
            failures.append(line)
    return lines, failures


def notebooks(device: str) -> Result:
    """Execute notebooks 00 to 04, which run all stages of the paper's method, with their assertions
    on the device.

    Their stored outputs are those of a CPU and are not compared. A notebook that uses
    `backbone.model` computes inside the network: it stays on the CPU.
    """
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted((REPOSITORY / "notebooks").glob("0[0-4]*.ipynb")):
            text = path.read_text("utf-8")
            if "backbone.model" not in text:
                # Raw strings: in the JSON of a notebook, a backslash is before each quote.
                text = text.replace(r"device=\"cpu\"", rf"device=\"{device}\"")
                text = text.replace("open_lesson()", rf"open_lesson(\"{device}\")")
            Path(folder, path.name).write_text(
                text.replace("nbval-check-output", "not-compared"), "utf-8"
            )
        words = "-m pytest -c pyproject.toml -q --nbval-lax --nbval-current-env"
        words += " --nbval-cell-timeout=300 -n 4 --dist loadfile --rootdir"
        # The folder is the value of --rootdir, and what pytest collects.
        command = [sys.executable, *words.split(), folder, folder]
        # The four workers of pytest share the cores.
        threads = {"OMP_NUM_THREADS": str(max(1, CORES // 4))}
        status = subprocess.run(command, cwd=REPOSITORY, env=os.environ | threads).returncode
    return [], [f"pytest of the notebooks ended with {status}"] if status else []


def speed(device: str) -> Result:
    """Measure features, whole estimates and memory on the device and on the CPU."""
    lines = []
    reference, targets = Co3D(sample_data()).load_pair(example_pair(Co3D(sample_data())))
    images = [object_crop(reference).rgb] * 64

    def measured(function) -> float:
        def to_its_end() -> None:
            """Wait for the GPU, which works while Python goes on."""
            function()
            if device == "cuda":
                torch.cuda.synchronize()

        return seconds(to_its_end)

    for place in dict.fromkeys((device, "cpu")):
        dino = Backbone(VisionTransformer(), "DINO ViT-S/8, random weights", device=place)
        for backbone in (load_backbone(device=place), dino):
            name = backbone.name
            for size in (8, 64):
                backbone.batch_size = size
                rate = size / measured(lambda: backbone(images[:size]))
                lines.append(f"| {name}, batches of {size} | {place} | {rate:.0f} images/s |")
            for solver in SOLVERS["both"]:
                method = ZeroShotPose(backbone, solver=solver)
                rate = 1 / measured(lambda: method.estimate(reference, targets))
                lines.append(f"| {name}, {solver} solver | {place} | {rate:.1f} pairs/s |")
            if place == "cuda":
                gigabytes = torch.cuda.max_memory_allocated() / 1e9
                lines.append(f"| {name}, memory | {place} | {gigabytes:.2f} GB |")
                torch.cuda.reset_peak_memory_stats()
    return lines, []


def main() -> int:
    """Run the parts, write outputs/gpu/gpu.md after each, and print it with what failed."""
    parts = {"poses": poses, "notebooks": notebooks, "speed": speed}
    parser = argparse.ArgumentParser(prog="python -m tests.gpu")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "outputs/gpu")
    options = parser.parse_args()
    if options.device == "cuda" and not torch.cuda.is_available():
        print("skipped: no CUDA device")
        return 0
    name = torch.cuda.get_device_name() if options.device == "cuda" else "no GPU"
    report = [
        f"| {name}, {CORES} cores, PyTorch {torch.__version__} | device | |",
        "|---|---|---:|",
    ]
    failures = []
    options.out.mkdir(parents=True, exist_ok=True)
    for part in options.parts:
        start = time.perf_counter()
        lines, failed = parts[part](options.device)
        report += [*lines, f"| the part {part} | | {time.perf_counter() - start:.0f} s |"]
        failures += failed
        (options.out / "gpu.md").write_text("\n".join([*report, ""]), "utf-8")
    print("\n".join([*report, *(f"FAILED {failure}" for failure in failures)]))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
