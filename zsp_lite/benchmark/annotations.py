"""Time and memory to open a category of the size of the largest ones in CO3D."""

import gzip
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from zsp_lite.data.annotations import FRAMES_FILE, SEQUENCES_FILE

_FRAMES_PER_SEQUENCE = 100

# Runs in a new process, because memory freed by earlier steps would hide the peak.
_MEASURE = """
import json, sys, time
from pathlib import Path
from zsp_lite.benchmark.plan import process_memory
from zsp_lite.data.co3d import Co3D

before = process_memory("VmRSS")
start = time.perf_counter()
dataset = Co3D(sys.argv[1])
keys = dataset.frame_list("category")
opened = time.perf_counter()
frames = dataset.frames("category", keys[0].sequence_name)
sequence = time.perf_counter()
print(json.dumps({"frames": len(keys), "seconds": opened - start, "sequence_seconds": sequence - opened,
                  "memory_mb": (process_memory("VmHWM") - before) / 2**20}))
"""


def annotation_benchmark(frames: int = 86_000) -> dict:
    """Open a generated category in a new process and measure time and memory; needs Linux or macOS.

    Args:
        frames: Number of annotated frames.

    Returns:
        {"frames", "seconds": to open the category (decompress and index it), "sequence_seconds": to decode one
        sequence, "json_mb": size of the JSON, "memory_mb": increase of the peak memory, "extra_memory_mb": that
        increase minus the size of the JSON}. A megabyte is 2^20 bytes.
    """
    with tempfile.TemporaryDirectory() as root:
        size = _write_category(Path(root), frames)
        done = subprocess.run([sys.executable, "-c", _MEASURE, root], capture_output=True, text=True, check=True)
    figures = json.loads(done.stdout)
    json_mb = size / 2**20
    return {**figures, "json_mb": json_mb, "extra_memory_mb": figures["memory_mb"] - json_mb}


def _write_category(root: Path, frames: int) -> int:
    """Write frame annotations of the size of CO3D v1's, about 1.2 kB each; returns the size of the JSON in bytes."""
    rng = np.random.default_rng(0)
    folder = root / "category"
    folder.mkdir()
    size = 0
    with gzip.open(folder / FRAMES_FILE, "wb", compresslevel=1) as file:
        for index in range(frames):
            text = ("[" if index == 0 else ", ") + json.dumps(_entry(index, rng.standard_normal(19).tolist()))
            size += file.write(text.encode())
        size += file.write(b"]")
    with gzip.open(folder / SEQUENCES_FILE, "wb") as file:
        file.write(b"[]")
    return size


def _entry(index: int, draws: list[float]) -> dict:
    """Return a frame annotation with random numbers of the usual number of digits."""
    sequence, number = divmod(index, _FRAMES_PER_SEQUENCE)
    name = f"{100 + sequence // 7}_{10000 + 37 * sequence}_{20000 + 53 * sequence}"
    stem = f"category/{name}/%s/frame{number + 1:06d}%s"
    return {
        "sequence_name": name,
        "frame_number": number,
        "frame_timestamp": number * 0.20120120120120122,
        "image": {"path": stem % ("images", ".jpg"), "size": [1920, 1080]},
        "depth": {
            "path": stem % ("depths", ".jpg.geometric.png"),
            "scale_adjustment": abs(draws[0]) + 1,
            "mask_path": stem % ("depth_masks", ".png"),
        },
        "mask": {"path": stem % ("masks", ".png"), "mass": 1000 * abs(draws[1])},
        "viewpoint": {
            "R": [draws[2:5], draws[5:8], draws[8:11]],
            "T": draws[11:14],
            "focal_length": [abs(draws[14]) + 1, abs(draws[15]) + 1],
            "principal_point": draws[16:18],
        },
        # Fields of later versions that the reader skips, which takes time.
        "meta": {
            "frame_type": "train_known",
            "frame_splits": [
                f"{kind}_{split}"
                for kind in ("fewview", "manyview", "singlesequence")
                for split in ("train_known", "dev_known", "test_unseen")
            ],
        },
    }
