"""Check poses, notebooks and speed on a CUDA GPU against the CPU of the same machine; skipped without a GPU.

    python -m tests.gpu [--parts poses notebooks speed] [--device cuda] [--out outputs/gpu]

Writes gpu.md and gpu.json. `--device cpu` is a trial run where there is no GPU.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.choices import SOLVERS
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.pairs import labelled_categories, shipped_pairs
from zsp_lite.demo import example_pair
from zsp_lite.matching import similarities
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.samples import REPOSITORY, sample_data
from zsp_lite.views import extract_views, object_crop

CORES, LARGEST_ANGLE = len(os.sched_getaffinity(0)), 1.0  # degrees between the poses of two devices


class Found(NamedTuple):
    """A pose in the chosen target view."""

    view: int
    sim3: Sim3


def solve(views):
    """Estimate the poses of a reference and its targets by both solvers, on one thread."""
    torch.set_num_threads(1)
    found = {}
    for solver in SOLVERS["both"]:
        estimate = ZeroShotPose(load_backbone(device="cpu"), solver=solver).estimate_from_views(views[0], views[1:])
        found[solver] = Found(estimate.view, estimate.sim3)
    return found


def poses(device: str) -> tuple[list, list[str]]:
    """Compare the poses of all evaluation pairs with five target views that features of both devices give."""
    dataset = Co3D(sample_data())
    pairs = [pair for category in labelled_categories(dataset) for pair in shipped_pairs(dataset, category, 5)]
    frames = {}  # of each pair, by name
    for pair in pairs:
        ends = [(pair.reference_sequence, pair.reference_frame)]
        ends += [(pair.target_sequence, number) for number in pair.target_frames]
        frames[pair.key] = [(pair.category, *end) for end in ends]
    names = list(dict.fromkeys(name for some in frames.values() for name in some))
    backbones = [load_backbone(device=one) for one in (device, "cpu")]
    crops = [object_crop(dataset.load(dataset.frame(*name)), backbones[0].image_size) for name in names]
    views = [dict(zip(names, extract_views(backbone, crops))) for backbone in backbones]
    keys = [torch.stack([some[name].features.keys for name in names]) for some in views]
    off = float(((keys[0] - keys[1]).norm(dim=-1) / keys[1].norm(dim=-1)).max())
    work = [[some[name] for name in frames[key]] for some in views for key in frames]
    with ProcessPoolExecutor(CORES, get_context("spawn")) as executor:
        found = list(executor.map(solve, work))
    angles, failures = [], []
    for key, first, second in zip(frames, found, found[len(frames) :]):
        for solver in first:
            one, other = first[solver], second[solver]
            angles.append(rotation_error(one.sim3.R, other.sim3.R))
            if angles[-1] > LARGEST_ANGLE:
                both = " against ".join(f"view {x.view} {x.sim3.matrix.round(3).tolist()}" for x in (one, other))
                failures.append(f"{key}, {solver} solver, {device} against cpu, {angles[-1]:.1f}° apart: {both}")
    rows = [("poses compared", device, len(angles), ""), ("poses that differ", device, len(failures), "")]
    rows += [("largest difference of poses", device, float(max(angles)), "°")]
    return rows + [(f"largest relative difference of the keys of {len(names)} frames", device, off, "")], failures


def notebooks(device: str) -> tuple[list, list[str]]:
    """Execute copies of notebooks 00 to 04 on the default device; 01, which computes inside the network, on the CPU.

    Outputs are not compared: `make test` does so, with the pinned packages.
    """
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted((REPOSITORY / "notebooks").glob("0[0-4]*.ipynb")):
            text = path.read_text(encoding="utf-8").replace("nbval-check-output", "not-compared")
            if "backbone.model" not in text:
                text = text.replace(r", device=\"cpu\"", "")
            Path(folder, path.name).write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-c", "pyproject.toml", "--rootdir", folder, "-q", "--nbval-lax"]
        command += ["--nbval-current-env", "--nbval-cell-timeout=300", "-n", str(min(5, CORES)), "--dist", "loadfile"]
        environment = os.environ | {"OMP_NUM_THREADS": str(max(1, CORES // 5)), "CUDA_VISIBLE_DEVICES": ""}
        if device == "cuda":
            del environment["CUDA_VISIBLE_DEVICES"]
        start = time.perf_counter()
        status = subprocess.run([*command, folder], cwd=REPOSITORY, env=environment).returncode
    failures = [f"pytest of the notebooks ended with {status}"] if status else []
    return [("notebooks 00 to 04", device, time.perf_counter() - start, "s")], failures


def seconds(function, repeats: int) -> float:
    """Return the median time of a call until the GPU has finished; the first call is not counted."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        function()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return float(np.median(times[1:]))


def speed(device: str) -> tuple[list, list[str]]:
    """Measure features, whole estimates and similarities on the device and on the CPU."""
    dataset, rows = Co3D(sample_data()), []
    frames = dataset.load_pair(example_pair(dataset))
    images = [object_crop(frame).rgb for frame in (frames[0], *frames[1])] * 11
    for one in dict.fromkeys((device, "cpu")):
        repeats, cuda = (3, False) if one == "cpu" else (9, True)
        dino = Backbone(VisionTransformer(224, 8, 384, 12, 6), "DINO ViT-S/8, random weights", device=one)
        for backbone in (load_backbone(device=one), dino):
            for size in (8, 64):
                backbone.batch_size = size
                if cuda:
                    torch.cuda.reset_peak_memory_stats()
                rate = size / seconds(lambda: backbone(images[:size]), repeats)
                rows.append((f"{backbone.name}, batches of {size}", one, rate, "images/s"))
                pixels = torch.rand(size, 3, 224, 224, device=one)
                with torch.inference_mode():
                    rate = size / seconds(lambda: backbone.model.extract(pixels, backbone.layer, "key"), repeats)
                rows.append(("the same, network alone", one, rate, "images/s"))
                if cuda:
                    rows.append(("the same, peak memory", one, torch.cuda.max_memory_allocated() / 2**20, "MiB"))
            for solver in SOLVERS["both"]:
                method = ZeroShotPose(backbone, solver=solver)
                rate = 1 / seconds(lambda: method.estimate(*frames), repeats)
                rows.append((f"{backbone.name}, {solver} solver, 5 targets", one, rate, "pairs/s"))
    keys, threads = [torch.randn(28, 28, 384) for _ in range(6)], torch.get_num_threads()
    for number in dict.fromkeys((1, threads)):
        torch.set_num_threads(number)
        row = f"similarities of 5 targets, {number} threads", "cpu"
        rows.append((*row, 1000 * seconds(lambda: similarities(keys[0], keys[1:]), 15), "ms"))
    there = [one.to(device) for one in keys]

    def with_copies():
        return [one.cpu() for one in similarities(keys[0].to(device), [one.to(device) for one in keys[1:]])]

    rows.append(("similarities of 5 targets, with copies to and fro", device, 1000 * seconds(with_copies, 15), "ms"))
    alone = 1000 * seconds(lambda: similarities(there[0], there[1:]), 15)
    return rows + [("similarities of 5 targets, without copies", device, alone, "ms")], []


def main() -> int:
    parts = {"poses": poses, "notebooks": notebooks, "speed": speed}
    parser = argparse.ArgumentParser(prog="python -m tests.gpu")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "outputs" / "gpu")
    options = parser.parse_args()
    if options.device == "cuda" and not torch.cuda.is_available():
        print("skipped: no CUDA device")
        return 0
    name = torch.cuda.get_device_name() if options.device == "cuda" else "no GPU"
    rows, failures = [], []
    for part in options.parts:
        start = time.perf_counter()
        try:
            found, failed = parts[part](options.device)
        except Exception:  # the other parts still run
            found, failed = [], [f"{part}: {traceback.format_exc()}"]
        rows += [*found, (f"time of part {part}", "", time.perf_counter() - start, "s")]
        failures += failed
        title = f"{name}, {CORES} cores, PyTorch {torch.__version__}"
        lines = [f"| {title} | device | value | unit |", "|---|---|---:|---|"]
        lines += [f"| {what} | {where} | {value:.4g} | {unit} |" for what, where, value, unit in rows]
        report = "\n".join([*lines, "", *(f"FAILED {one}" for one in failures), ""])
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "gpu.md").write_text(report, encoding="utf-8")
        content = {"machine": title, "rows": rows, "failures": failures}
        (options.out / "gpu.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    print(report)
    return 1 if failures else 0
