"""Estimate of a run before it starts: frames, pairs, memory, disk space, and time by a calibration of a few seconds."""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from rich.filesize import decimal

from zsp_lite.benchmark.evaluation import evaluate_pair
from zsp_lite.benchmark.execution import available_cores, one_thread
from zsp_lite.benchmark.methods import Method
from zsp_lite.benchmark.problem import frame_keys
from zsp_lite.benchmark.store import CAPACITY, FrameStore
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import Pair
from zsp_lite.features import FeatureMap

_CROP_BYTES = 224 * 224 * (3 + 4 + 4)  # colours, depth and mask
_RESULT_BYTES, _EVALUATION_BYTES = 450, 500  # of a line in the database
_START_SECONDS = 6.0  # until a worker's interpreter has loaded the backbone


@dataclass(frozen=True)
class Plan:
    """Estimated cost of a run.

    Attributes:
        frames: Number of frames to read and extract features from.
        pairs: Number of pairs, of any number of target views.
        estimates: Number of rows over all pairs.
        memory: Bytes per worker; 0 if the system does not report it.
        results_bytes: Disk space of the results.
        cache_bytes: Disk space of a feature cache.
        frame_seconds: Mean time to read a frame and extract its features, with one worker.
        pair_seconds: Mean time of a pair's rows, with one worker.
        cores: Number of cores of this machine.
        calibration: What was timed.
    """

    frames: int
    pairs: int
    estimates: int
    memory: int
    results_bytes: int
    cache_bytes: int
    frame_seconds: float
    pair_seconds: float
    cores: int
    calibration: str

    def seconds(self, workers: int = 1) -> float:
        """Return the estimated time with workers that have a core of this machine's speed each."""
        return _START_SECONDS + (self.frames * self.frame_seconds + self.pairs * self.pair_seconds) / workers

    def lines(self, workers: int) -> list[str]:
        """Return a printable description."""
        times = (
            f"{timedelta(seconds=round(self.seconds(n)))} with {n} worker{'s' * (n > 1)}"
            for n in sorted({1, self.cores, workers})
        )
        return [
            f"frames               {self.frames:,}",
            f"pairs                {self.pairs:,} ({self.estimates:,} estimates in all rows)",
            f"memory per worker    {decimal(self.memory) if self.memory else 'unknown on this system'}",
            f"disk                 {decimal(self.results_bytes)} of results; a feature cache would take "
            f"{decimal(self.cache_bytes)}",
            f"calibration          {1000 * self.frame_seconds:.0f} ms per frame, {1000 * self.pair_seconds:.0f} ms per "
            f"pair on one core ({self.calibration})",
            f"time                 {', '.join(times)}; this machine has {self.cores} core{'s' * (self.cores > 1)}",
        ]


def make_plan(
    root: str | Path,
    work: Mapping[str, Mapping[Pair, list[str]]],
    rows: Mapping[str, Method],
    extractors: Mapping[str, Any],
    seconds: float = 5.0,
) -> Plan:
    """Count the work of a run, and time some pairs of its first category. Writes nothing.

    Args:
        root: The data.
        work: By category, pairs with the rows to evaluate.
        rows: The rows by name.
        extractors: The rows' extractors by name.
        seconds: About how long to calibrate.
    """
    memory = process_memory()
    pairs = {pair: names for found in work.values() for pair, names in found.items()}
    if not pairs:
        return Plan(0, 0, 0, memory, 0, 0, 0.0, 0.0, available_cores(), "nothing is left to do")
    category = next(iter(pairs)).category
    store = FrameStore(Co3D(root), category, extractors, threads=1)
    labels = read_labels(root, category)
    order = [list(work[category])[i] for i in np.random.default_rng(0).permutation(len(work[category]))]
    frame_times: dict[str, list[float]] = {}
    spent = estimated_views = timed = 0.0
    start = time.perf_counter()
    with one_thread():
        # The first pair is not timed, as it pays for lazy imports, unless it is the only one.
        for pair in order if len(order) > 1 else 2 * order:
            record = evaluate_pair(pair, {name: rows[name] for name in pairs[pair]}, store, labels)
            for stage, values in record["timings"].items():
                frame_times.setdefault(stage, []).extend(values)
            if frame_times and pair is order[0] and not timed and len(order) > 1:
                timed = 1
                continue
            spent += record["seconds"] - sum(sum(record["timings"].get(s, ())) for s in ("reading", *extractors))
            estimated_views += _views(pair, pairs[pair])
            timed += 1
            if time.perf_counter() - start > seconds:
                break
    frames = {(pair.category, key) for pair in pairs for key in frame_keys(pair)}
    frame_seconds = len(frames) * median(frame_times["reading"])
    for name in extractors:
        described = {
            (pair.category, key)
            for pair, names in pairs.items() if name in {rows[row].features for row in names}
            for key in frame_keys(pair)
        }  # fmt: skip
        frame_seconds += len(described) * median(frame_times.get(name, [0.0]))
    feature_maps = (store.description(name, frame_keys(order[0])[0]) for name in extractors)
    feature_bytes = sum(_bytes(one) for one in feature_maps if isinstance(one, FeatureMap))
    estimates = sum(map(len, pairs.values()))
    all_views = sum(_views(pair, names) for pair, names in pairs.items())
    return Plan(
        len(frames), len(pairs), estimates, memory + min(CAPACITY, len(frames)) * (_CROP_BYTES + feature_bytes),
        len(pairs) * _EVALUATION_BYTES + estimates * _RESULT_BYTES, len(frames) * feature_bytes,
        frame_seconds / len(frames), spent / estimated_views * all_views / len(pairs), available_cores(),
        f"{timed:.0f} pairs of {category}",
    )  # fmt: skip


def process_memory(field: str = "VmHWM") -> int:
    """Return the memory of this process in bytes, 0 if the system does not report it.

    Args:
        field: "VmHWM" for the peak, "VmRSS" for the current value. macOS reports only the peak, Windows neither.
    """
    try:
        # ru_maxrss of a child process starts at its parent's size on Linux; /proc does not.
        status = Path("/proc/self/status").read_text()
        return 1024 * int(next(line.split()[1] for line in status.splitlines() if line.startswith(f"{field}:")))
    except (OSError, StopIteration):
        try:
            import resource
        except ImportError:
            return 0
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _views(pair: Pair, names: list[str]) -> int:
    """Count the target views of a pair over all rows; the time of the rows is about proportional to it."""
    return len(pair.target_frames) * len(names)


def _bytes(feature_map: FeatureMap) -> int:
    parts = (feature_map.keys, feature_map.saliency, feature_map.global_feature)
    return sum(part.numel() * part.element_size() for part in parts)
