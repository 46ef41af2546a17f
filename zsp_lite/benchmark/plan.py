"""What a run would take, before it begins: frames, pairs, memory, disk, and time from a calibration of seconds."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from zsp_lite.benchmark.annotations import process_memory
from zsp_lite.benchmark.evaluation import evaluate_pair
from zsp_lite.benchmark.execution import default_threads
from zsp_lite.benchmark.jobs import frame_keys, one_thread_each, split
from zsp_lite.benchmark.methods import Method
from zsp_lite.benchmark.store import FrameKey, FrameStore
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import Pair
from zsp_lite.features import FeatureMap

# Of a crop of 224 x 224 pixels: colours, depth and mask.
_CROP_BYTES = 224 * 224 * (3 + 4 + 4)
_ROW_BYTES = 330  # of a row's part of a line in pairs.jsonl
_LINE_BYTES = 700
# Beside what it computes, a worker starts an interpreter and loads the backbone.
_START_SECONDS = 6.0


@dataclass(frozen=True)
class Plan:
    """frames: to be described.  pairs: problems, of any number of views; estimates: rows on pairs.
    memory, results_bytes, cache_bytes: bytes, the first of a worker.  frame_seconds: to read and describe one;
    pair_seconds: for the mean pair's rows; both with one worker.  described: what the calibration ran on.
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
    described: str

    def seconds(self, workers: int = 1) -> float:
        """Time that so many workers with a core each would take; workers beyond the machine's cores bring nothing.

        (Of other machines, give as many workers as cores, and think of them as this machine's.)
        """
        return _START_SECONDS + (self.frames * self.frame_seconds + self.pairs * self.pair_seconds) / workers

    def scaled(self, frames: int, pairs: int) -> "Plan":
        """The same rows on so many frames and pairs of other data, at the pace that was measured here."""
        more_frames, more_pairs = frames / max(self.frames, 1), pairs / max(self.pairs, 1)
        return replace(
            self, frames=frames, pairs=pairs, estimates=round(self.estimates * more_pairs),
            results_bytes=round(self.results_bytes * more_pairs), cache_bytes=round(self.cache_bytes * more_frames),
        )  # fmt: skip

    def lines(self, workers: int) -> list[str]:
        """For people to read."""
        numbers = sorted({1, self.cores, workers})
        memory = f"{self.memory / 2**30:.1f} GiB" if process_memory() else "unknown on this system"
        times = ", ".join(f"{duration(self.seconds(n))} with {n} worker{'s' * (n > 1)}" for n in numbers)
        return [
            f"frames to describe   {self.frames:,}",
            f"pairs                {self.pairs:,} ({self.estimates:,} estimates in all rows)",
            f"memory per worker    {memory}",
            f"disk                 {size(self.results_bytes)} of results; a feature cache would take "
            f"{size(self.cache_bytes)}",
            f"calibration          {1000 * self.frame_seconds:.0f} ms per frame, {1000 * self.pair_seconds:.0f} ms per "
            f"pair on one core ({self.described})",
            f"time                 {times}; this machine has {self.cores} core{'s' * (self.cores > 1)}",
        ]


def plan(
    root: str | Path,
    work: Mapping[str, Sequence[tuple[Pair, Sequence[str]]]],
    rows: Mapping[str, Method],
    extractors: Mapping[str, Any],
    seconds: float = 5.0,
) -> Plan:
    """Count what is to be done, and time a little of it: some pairs of the first category, for about `seconds`.

    work: by category, pairs with the rows that they still lack. Writes nothing.
    """
    before = process_memory()
    frames = peak = pairs = estimates = 0
    asked: Counter[str] = Counter()  # frames by who has to describe them
    for found in work.values():
        ordered = [item for chunk in split(found, 1) for item in chunk]
        frames += len({key for pair, _ in ordered for key in frame_keys(pair)})
        for name in extractors:
            asked[name] += len({key for pair, names in ordered if name in {rows[row].features for row in names}
                                for key in frame_keys(pair)})  # fmt: skip
        peak = max(peak, frames_at_once([pair for pair, _ in ordered]))
        pairs += len(ordered)
        estimates += sum(len(names) for _, names in ordered)
    category, found = next((item for item in work.items() if item[1]), (None, []))
    if category is None:
        return Plan(0, 0, 0, before, 0, 0, 0.0, 0.0, default_threads(1), "nothing is left to do")
    store = FrameStore(Co3D(root), category, extractors, threads=1)
    labels = read_labels(root, category)
    timed: Counter[tuple] = Counter()
    took: dict[tuple, float] = {}
    with one_thread_each():
        first = _warm_up(store, found, rows, labels)
        start = time.perf_counter()
        for pair, names in _each_kind(found):
            record = evaluate_pair(pair, {name: rows[name] for name in names}, store, labels)
            on_frames = sum(record["spent"].get(name, (0, 0.0))[1] for name in ("reading", *extractors))
            kind = len(pair.target_frames), tuple(names)
            timed[kind] += 1
            took[kind] = took.get(kind, 0.0) + record["seconds"] - on_frames
            store.forget_similarities()
            if time.perf_counter() - start > seconds and len(timed) == len(_kinds(found)):
                break
    kinds = Counter((len(pair.target_frames), tuple(names)) for one in work.values() for pair, names in one)
    mean = sum(took.values()) / sum(timed.values())
    each = {name: spent.seconds / spent.times for name, spent in (first | dict(store.spent)).items() if spent.times}
    spent_on_frames = frames * each.get("reading", 0.0) + sum(n * each.get(name, 0.0) for name, n in asked.items())
    spent_on_rows = sum(n * (took[kind] / timed[kind] if kind in took else mean) for kind, n in kinds.items())
    key = frame_keys(found[-1][0])[0]
    feature_bytes = sum(_bytes(one) for name in extractors
                        if isinstance(one := store.described(name, key), FeatureMap))  # fmt: skip
    results = pairs * _LINE_BYTES + estimates * _ROW_BYTES
    return Plan(
        frames, pairs, estimates, before + peak * (_CROP_BYTES + feature_bytes), results, frames * feature_bytes,
        spent_on_frames / frames, spent_on_rows / pairs, default_threads(1),
        f"{sum(timed.values())} pairs of {category}",
    )  # fmt: skip


def frames_at_once(pairs: Sequence[Pair]) -> int:
    """The most frames in memory together when pairs are done in this order and a frame is kept to its last use."""
    last: dict[FrameKey, int] = {}
    for number, pair in enumerate(pairs):
        last.update(dict.fromkeys(frame_keys(pair), number))
    kept: set[FrameKey] = set()
    most = 0
    for number, pair in enumerate(pairs):
        kept.update(frame_keys(pair))
        most = max(most, len(kept))
        kept -= {key for key in frame_keys(pair) if last[key] == number}
    return most


def duration(seconds: float) -> str:
    """Two units at most: "1 h 20 min"."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{seconds:.0f} s"
    if minutes < 90:
        return f"{minutes} min"
    hours = round(seconds / 3600)
    return f"{minutes // 60} h {minutes % 60} min" if hours < 48 else f"{hours // 24} d {hours % 24} h"


def size(n: float) -> str:
    """Bytes in the largest unit that leaves a number of at least 1."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if n < 1024:
            return f"{n:.0f} {unit}" if unit == "B" else f"{n:.1f} {unit}"
        n /= 1024
    return f"{n:.1f} TiB"


def _kinds(found: Sequence[tuple[Pair, Sequence[str]]]) -> set[tuple]:
    return {(len(pair.target_frames), tuple(names)) for pair, names in found}


def _each_kind(found: Sequence[tuple[Pair, Sequence[str]]]) -> list[tuple[Pair, Sequence[str]]]:
    """The pairs in an order in which every kind, by number of views and rows, comes round in turn."""
    by_kind: dict[tuple, list] = {}
    for pair, names in found:
        by_kind.setdefault((len(pair.target_frames), tuple(names)), []).append((pair, names))
    longest = max(map(len, by_kind.values()))
    return [items[i] for i in range(longest) for items in by_kind.values() if i < len(items)]


def _warm_up(
    store: FrameStore, found: Sequence[tuple[Pair, Sequence[str]]], rows: Mapping[str, Method], labels
) -> dict:
    """Each row's first answer pays for lazy imports and allocations; its time is nobody's.

    Returns what the frames cost then: all there is to go by where no other pair needs new ones.
    """
    pair = min((pair for pair, _ in reversed(found)), key=lambda pair: len(pair.target_frames))
    names = dict.fromkeys(name for _, names in found for name in names)
    evaluate_pair(pair, {name: rows[name] for name in names}, store, labels)
    store.forget_similarities()
    spent = dict(store.spent)
    store.spent.clear()
    return spent


def _bytes(feature_map: FeatureMap) -> int:
    parts = (feature_map.keys, feature_map.saliency, feature_map.global_feature)
    return sum(part.numel() * part.element_size() for part in parts)
