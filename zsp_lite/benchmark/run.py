"""Rotation errors of methods over many pairs of a CO3D-format folder with pose labels (paper sec. 5).

Features are computed once per frame and shared by every pair and method. A finished pair is a line of
OUT/pairs.jsonl at once, so that an interrupted run goes on where it stopped;
OUT/summary.json is made of those lines alone.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from zsp_lite.alignment import Sim3
from zsp_lite.backbones import Backbone, load_backbone
from zsp_lite.baselines.rootsift import RootSift
from zsp_lite.best_view import mask_iou
from zsp_lite.co3d import Co3D
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.files import write_atomic
from zsp_lite.frames import Frame
from zsp_lite.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.metrics import median, paired_test, rotation_error, summarise, translation_error
from zsp_lite.pairs import Pair, sample_pairs, shipped_pairs
from zsp_lite.pipeline import View, ZeroShotPose, frame_view, object_crop, patch_mask, view_alignment
from zsp_lite.vit import VisionTransformer

Extractor = Callable[[list[np.ndarray]], list[FeatureMap]]

# A pair whose frames cannot be used counts as wrong as can be: leaving it out would reward failing.
_FAILED = 180.0


@dataclass(frozen=True)
class Method:
    """A row of the table.

    features: what describes the images: the backbone under test, one of its shape with random weights, or RootSIFT.
    answer: the fitted pose, the best view taken as it is ("Ours-BV"), or the pose fitted in the target view
    that is truly nearest in rotation.  settings: of `ZeroShotPose`, where they differ from the paper's.
    """

    features: Literal["backbone", "random", "rootsift"] = "backbone"
    answer: Literal["pose", "best view", "true view"] = "pose"
    settings: Mapping[str, Any] = field(default_factory=dict)


METHODS = {
    "ours": Method(),
    "ours-bv": Method(answer="best view"),
    # SIFT has no saliency: it gets the true mask, which no other row does unless its name says so.
    "rootsift": Method("rootsift", settings={"foreground": "mask"}),
    "rootsift-bv": Method("rootsift", "best view", {"foreground": "mask"}),
    "ours-mask": Method(settings={"foreground": "mask"}),
    "oracle-view": Method(answer="true view"),
    "random": Method("random"),
}


def evaluate(
    root: str | Path,
    backbone: Backbone | Extractor | str,
    methods: Sequence[str] = ("ours", "ours-bv", "rootsift"),
    pairs: int = 100,
    targets: int = 5,
    seed: int = 0,
    out: str | Path = "outputs/benchmark",
    categories: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict:
    """Run the benchmark and return what OUT/summary.json says.

    methods: names in `METHODS`.  pairs: per category; the folder's own evaluation set where it holds that
    many, else sampled with `seed` (see `category_pairs`).  categories: default all of the folder's.
    progress(done, total): called after each pair.
    Per-pair seeds come from the pair's key, so results do not depend on order. Running again with the same
    arguments continues, with other methods adds them.
    Raises InputError for unknown methods or categories, missing labels or files, and an OUT that holds another run.
    """
    dataset = Co3D(root)
    categories = list(categories or dataset.categories())
    if unknown := sorted(set(methods) - METHODS.keys()) or not methods:
        raise InputError(f"methods {unknown or 'none'}: expected some of {', '.join(METHODS)}")
    if missing := sorted(set(categories) - set(dataset.categories())) or not categories:
        found = ", ".join(dataset.categories()) or "none"
        raise InputError(f"{root}: no categories {missing or ''}, found {found}")
    backbone = load_backbone(backbone) if isinstance(backbone, str) else backbone
    todo = {category: category_pairs(dataset, category, pairs, targets, seed) for category in categories}
    total = sum(len(found) for found in todo.values())

    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    _same_run(out, {"data": str(root), "backbone": _fingerprint(backbone), "pairs": pairs, "targets": targets,
                    "seed": seed})  # fmt: skip
    records = read_records(out / "pairs.jsonl")
    extractors = _extractors(backbone, methods)
    done = 0
    with (out / "pairs.jsonl").open("a") as log:
        for category, found in todo.items():
            views = _Views(dataset, category, extractors)
            labels = read_labels(root, category)
            for pair in found:
                record = records.setdefault(pair.key, {})
                wanted = [name for name in methods if name not in record.get("methods", {})]
                if wanted:
                    line = _evaluate_pair(pair, wanted, views, labels)
                    log.write(json.dumps(line) + "\n")
                    log.flush()
                    _merge(record, line)
                done += 1
                if progress is not None:
                    progress(done, total)

    used = [records[pair.key] for found in todo.values() for pair in found]
    data = {"root": str(root), "categories": categories, "pairs": total, "targets": targets, "seed": seed}
    summary = summarise_run(used, methods, data, getattr(backbone, "name", type(backbone).__name__))
    write_atomic(out / "summary.json", json.dumps(summary, indent=1).encode())
    return summary


def category_pairs(dataset: Co3D, category: str, n: int, n_targets: int, seed: int = 0) -> list[Pair]:
    """The first n pairs of the folder's own evaluation set for n_targets, where it holds so many; else n sampled."""
    shipped = shipped_pairs(dataset, category, n_targets, at_least=n)
    return shipped[:n] or sample_pairs(dataset, category, n, n_targets, seed)


def summarise_run(records: Sequence[dict], methods: Sequence[str], data: dict, backbone: str) -> dict:
    """The summary of finished pairs: figures per method and category, saliency, and median seconds per stage.

    "median", "acc30" and "acc15" are over all pairs; "mean_category_median" is the paper's way of averaging
    medians. "against_ours": paired tests of "ours" against each other method.
    "saliency_iou": mean over the frames used.
    """
    errors = {name: np.array([record["methods"][name]["error"] for record in records]) for name in methods}
    category_of = np.array([record["category"] for record in records])
    categories = list(dict.fromkeys(category_of.tolist()))
    rows = {}
    for name in methods:
        per_category = {category: summarise(errors[name][category_of == category]) for category in categories}
        rows[name] = summarise(errors[name]) | {
            "mean_category_median": float(np.mean([row["median"] for row in per_category.values()])),
            "failed": sum("failed" in record["methods"][name] for record in records),
            "flagged": sum(record["methods"][name].get("note", "") != "" for record in records),
            "per_category": per_category,
        }
    saliency: dict[str, float] = {}
    for category in categories:
        frames: dict[str, float] = {}
        for record in records:
            if record["category"] == category:
                frames.update(record["saliency_iou"])
        if frames:
            saliency[category] = float(np.mean(list(frames.values())))
    if saliency:
        saliency["mean"] = float(np.mean(list(saliency.values())))
    timed = [record["methods"][name]["timings"] for record in records for name in methods[:1]
             if "timings" in record["methods"][name]]  # fmt: skip
    stages = timed[0] if timed else ()
    timings = {stage: float(median([timing[stage] for timing in timed])) for stage in stages}
    frame_seconds = [record["seconds_per_frame"] for record in records if record.get("seconds_per_frame")]
    if frame_seconds:
        timings["features_per_frame"] = float(median(frame_seconds))
    summary = {"data": data, "backbone": backbone, "methods": rows, "saliency_iou": saliency}
    summary["timings"] = timings
    if "ours" in errors:
        summary["against_ours"] = {
            name: paired_test(found, errors["ours"]) for name, found in errors.items() if name != "ours"
        }
    return summary


def read_records(path: Path) -> dict[str, dict]:
    """The finished pairs of a run by key; a last line that a crash cut short is dropped from the file."""
    records: dict[str, dict] = {}
    if not path.is_file():
        return records
    lines = path.read_bytes().splitlines(keepends=True)
    if lines and not lines[-1].endswith(b"\n"):
        write_atomic(path, b"".join(lines[:-1]))
        lines = lines[:-1]
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            _merge(records.setdefault(record["key"], {}), record)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}, line {number}: not a record of a pair ({error})") from error
    return records


def _merge(record: dict, line: dict) -> None:
    methods = record.get("methods", {}) | line["methods"]
    iou = record.get("saliency_iou", {}) | line["saliency_iou"]
    # A later line of the pair, for other methods, need not have described its frames again.
    seconds = line["seconds_per_frame"] or record.get("seconds_per_frame")
    record.update(line, methods=methods, saliency_iou=iou, seconds_per_frame=seconds)


class _Views:
    """The category's frames as views, each cropped and described once; kept while the category is worked on."""

    def __init__(self, dataset: Co3D, category: str, extractors: Mapping[str, Extractor]):
        self.dataset, self.category, self.extractors = dataset, category, extractors
        self.frames: dict[tuple[str, int], Frame | InputError] = {}
        self.features: dict[tuple[str, str, int], FeatureMap] = {}
        self.views: dict[tuple, View] = {}
        # Of the pair at hand; None where nothing was left to compute.
        self.seconds_per_frame: float | None = None

    def load(self, keys: Sequence[tuple[str, int]]) -> None:
        """Read and crop frames. A file that cannot be read is an error; one without an object fails its pairs."""
        for key in keys:
            if key not in self.frames:
                frame = self.dataset.load(self.dataset.frame(self.category, *key))
                try:
                    self.frames[key] = object_crop(frame)
                except InputError as error:
                    self.frames[key] = error

    def frame(self, key: tuple[str, int]) -> Frame:
        frame = self.frames[key]
        if isinstance(frame, InputError):
            raise frame
        return frame

    def describe(self, features: str, keys: Sequence[tuple[str, int]]) -> list[FeatureMap]:
        missing = [key for key in dict.fromkeys(keys) if (features, *key) not in self.features]
        if missing:
            frames = [self.frame(key) for key in missing]
            start = time.perf_counter()
            found = self.extractors[features]([frame.rgb for frame in frames])
            if features == "backbone":
                self.seconds_per_frame = (time.perf_counter() - start) / len(frames)
            for key, one in zip(missing, found):
                self.features[features, *key] = one
        return [self.features[features, *key] for key in keys]

    def look(self, features: str, keys: Sequence[tuple[str, int]], settings: ZeroShotPose) -> list[View]:
        found = []
        for key, feature_map in zip(keys, self.describe(features, keys)):
            name = (features, settings.foreground, settings.saliency_threshold, *key)
            if name not in self.views:
                self.views[name] = frame_view(
                    self.frame(key), feature_map, settings.foreground, settings.saliency_threshold
                )
            found.append(self.views[name])
        return found


def _evaluate_pair(
    pair: Pair, methods: Sequence[str], views: _Views, labels: Mapping[str, PoseLabel]
) -> dict:
    for sequence in (pair.reference_sequence, pair.target_sequence):
        if sequence not in labels:
            raise InputError(f"{pair.category}/{sequence}: no pose label, expected one for each of a pair")
    views.seconds_per_frame = None
    keys = [(pair.reference_sequence, pair.reference_frame)]
    keys += [(pair.target_sequence, number) for number in pair.target_frames]
    views.load(keys)
    shared: dict[tuple, Any] = {}  # methods that differ only in what they answer share one estimate
    results = {}
    for name in methods:
        try:
            results[name] = _evaluate_method(METHODS[name], pair, keys, views, labels, shared)
        except InputError as error:
            results[name] = {"error": _FAILED, "failed": str(error)}
    return {
        "key": pair.key,
        "category": pair.category,
        "methods": results,
        "saliency_iou": _saliency_iou(keys, views),
        "seconds_per_frame": views.seconds_per_frame,
    }


def _evaluate_method(
    method: Method,
    pair: Pair,
    keys: Sequence[tuple[str, int]],
    views: _Views,
    labels: Mapping[str, PoseLabel],
    shared: dict[tuple, Any],
) -> dict:
    solver = ZeroShotPose(views.extractors[method.features], **method.settings, seed=pair.seed)
    reference, *targets = views.look(method.features, keys, solver)
    truths = [
        relative_pose(
            labels[pair.reference_sequence], reference.frame.camera,
            labels[pair.target_sequence], target.frame.camera,
        )
        for target in targets
    ]  # fmt: skip
    first = 0
    if method.answer == "true view":
        first = int(rotation_error(np.eye(3), np.stack(truths)[:, :3, :3]).argmin())
        targets = targets[first : first + 1]
    same = (method.features, method.answer == "true view", tuple(sorted(method.settings.items())))
    if same not in shared:
        shared[same] = solver.estimate_from_features(reference, targets)
    estimate = shared[same]
    sim3: Sim3 = estimate.sim3
    if method.answer == "best view":
        sim3 = view_alignment(reference, targets[estimate.view])
    truth = truths[first + estimate.view]
    return {
        "error": float(rotation_error(sim3.R, truth[:3, :3])),
        "translation_error": float(translation_error(sim3.t, truth[:3, 3])),
        "scale": sim3.scale,
        "view": first + estimate.view,
        "matches": len(estimate.matches),
        "inliers": int(estimate.inliers.sum()),
        "note": estimate.note if method.answer != "best view" else "",
        "timings": {stage: round(seconds, 5) for stage, seconds in estimate.timings.items()},
    }


def _saliency_iou(keys: Sequence[tuple[str, int]], views: _Views) -> dict[str, float]:
    """IoU of the backbone's foreground (the paper's threshold) with the mask's patches, by frame."""
    found = {}
    for key in keys:
        frame, features = views.frames.get(key), views.features.get(("backbone", *key))
        if isinstance(frame, Frame) and features is not None and frame.mask is not None:
            iou = mask_iou(features.foreground().cpu(), patch_mask(frame, features.grid))
            found[f"{key[0]}/{key[1]}"] = round(iou, 4)
    return found


def _extractors(backbone: Extractor, methods: Sequence[str]) -> dict[str, Extractor]:
    makers = {"backbone": lambda: backbone, "rootsift": RootSift, "random": lambda: random_backbone(backbone)}
    return {name: makers[name]() for name in {METHODS[method].features for method in methods}}


def random_backbone(like: Backbone, seed: int = 0) -> Backbone:
    """A backbone of the same shape with random weights: what the architecture alone is worth."""
    if not isinstance(like, Backbone):
        raise InputError(f"method 'random' needs a Backbone to copy the shape of, got {type(like).__name__}")
    model = like.model
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = VisionTransformer(
            model.image_size, model.patch_size, model.embed_dim, model.depth, model.num_heads
        )
    return Backbone(fresh, f"random like {like.name}", like.key_block, like.saliency_heads, like.device)


def _fingerprint(backbone: Extractor) -> str:
    """The backbone's name and a hash of its weights: retrained weights of the same name are another backbone."""
    name = getattr(backbone, "name", type(backbone).__name__)
    if not isinstance(backbone, Backbone):
        return name
    digest = hashlib.sha256(f"{backbone.key_block} {backbone.saliency_heads} {backbone.precision}".encode())
    for key, weight in sorted(backbone.model.state_dict().items()):
        digest.update(key.encode() + weight.cpu().contiguous().numpy().tobytes())
    return f"{name} {digest.hexdigest()[:16]}"


def _same_run(out: Path, settings: dict) -> None:
    """Remember what OUT is a run of; InputError where it is one of something else."""
    path = out / "run.json"
    if path.is_file():
        try:
            before = json.loads(path.read_bytes())
        except ValueError as error:
            raise InputError(f"{path}: not the settings of a run ({error}); choose another folder") from error
        if before != settings:
            before = before if isinstance(before, dict) else {}
            differing = ", ".join(key for key in settings if before.get(key) != settings[key])
            raise InputError(f"{out} holds a run with other settings ({differing}); choose another folder")
    elif (out / "pairs.jsonl").exists():
        raise InputError(f"{out} holds pairs.jsonl without run.json; choose another folder")
    else:
        write_atomic(path, json.dumps(settings, indent=1).encode())
