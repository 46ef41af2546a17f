"""A whole category in one frame, as a run of the benchmark's kind, and one's own pair with the help of others."""

import json
import logging
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import BackboneLike, as_backbone
from zsp_lite.benchmark.baseline_rows import hypotheses
from zsp_lite.benchmark.execution import Chunk, open_workers
from zsp_lite.benchmark.identity import environment, fingerprint, library_version
from zsp_lite.benchmark.problem import FrameStore, Problem
from zsp_lite.benchmark.run import evaluate_pairs
from zsp_lite.benchmark.runs import Call, Settings, open_run, read_lines
from zsp_lite.category import SAME_ANGLE, CategoryAlignment, PairHypotheses, object_pairs, synchronise, world_hypotheses
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import PoseLabel, label_bytes, rigid_label
from zsp_lite.data.published import write_all
from zsp_lite.errors import InputError, NoPoseError
from zsp_lite.estimates import PairResult, PoseEstimate
from zsp_lite.features import FeatureExtractor
from zsp_lite.io.files import write_atomic
from zsp_lite.metrics import rotation_angle, rotation_error
from zsp_lite.own_objects import Source, estimate_pose, known_errors
from zsp_lite.verified.confidence import modes, reliability_flags

logger = logging.getLogger(__name__)


class _Line(msgspec.Struct):
    """Hypotheses of a pair (see `PairHypotheses`); none if the views determine no pose."""

    results: ClassVar[tuple[str]] = ("alignment",)  # the rows of a line, as in `ResultLine`
    pair: str
    centre: list[float] = []
    matrices: list[list[list[float]]] = []
    probabilities: list[float] = []


class PairSolver:
    """Finds the hypotheses of pairs of a category; frames and features are kept from chunk to chunk."""

    def __init__(self, root: str, category: str, backbone: BackboneLike, threads: int):
        self._store = FrameStore(Co3D(root), category, {"backbone": as_backbone(backbone)}, threads)

    def lines(self, chunk: Chunk) -> Iterator[dict[str, Any]]:
        """Find the hypotheses of the pairs of a chunk."""
        for pair, _ in chunk:
            line: dict[str, Any] = {"pair": pair.key}
            with suppress(NoPoseError):
                found = hypotheses(Problem(pair, self._store))
                line |= {"centre": found.centre.tolist(), "matrices": [one.matrix.tolist() for one in found.sim3s]}
                line |= {"probabilities": found.probabilities.tolist()}
            yield line


def align_category(
    dataset: Co3D,
    category: str,
    backbone: BackboneLike = "zsp-tiny",
    sequences: Sequence[str] | None = None,
    pairs: int | None = None,
    targets: int = 5,
    out: str | Path | None = None,
    executor: Executor | str | int = 1,
    allow_other_version: bool = False,
) -> CategoryAlignment:
    """Align all objects of a category in one frame, without labels (see `category`).

    Pairs whose views determine no pose are left out. A run in OUT is continued: pairs that it has are not solved again.

    Args:
        dataset: Data set.
        category: Name of the category.
        backbone: Backbone, or what `load_backbone` takes.
        sequences: Names of the sequences, one per object; None for all of the category.
        pairs: Objects that each object is the reference of; None for all others, or from twelve objects on, for six.
        targets: Target frames per pair of frames; each pair of objects becomes three of these.
        out: Folder of the run, which keeps the hypotheses of the pairs; None keeps nothing.
        executor: Number of processes; "dask://HOST:PORT"; or any `Executor`.
        allow_other_version: Continue a run of another version of the library.

    Raises:
        InputError: Sequences are fewer than two, too short, or not connected by pairs with poses; OUT has another run.
        FatalError: The backbone is broken, or a frame cannot be read.
    """
    chosen = {pair.key: pair for pair in object_pairs(dataset, category, sequences, pairs, targets)}
    loaded = as_backbone(backbone)
    with (
        tempfile.TemporaryDirectory() if out is None else nullcontext(out) as folder,
        open_workers(executor) as (pool, workers),
    ):
        settings = Settings(
            data=str(dataset.root).encode(errors="replace").decode(), backbone=fingerprint(loaded), targets=targets,
            library=[library_version()], methods={"alignment": "hypotheses of the verified solver"}, labels={},
            origins={category: "sampled"},
            calls=[Call(**environment(), workers=workers, rows=["alignment"], pairs={category: len(chosen)})],
        )  # fmt: skip
        with open_run(folder, settings, allow_other_version):
            make = partial(PairSolver, str(dataset.root.resolve()), category, backbone if pool else loaded)
            evaluate_pairs(folder, make, dict.fromkeys(chosen.values(), ["alignment"]), pool, workers, _Line)
        known = read_hypotheses(folder)
    found = [known[key] for key in chosen if key in known]
    if not found:
        raise InputError(f"category {category}: none of {len(chosen)} pairs determines a pose")
    posed = {name for one in found for name in (one.reference, one.target)}
    for name in sorted({pair.reference_sequence for pair in chosen.values()} - posed):
        logger.warning("%s/%s is left out: none of its pairs determines a pose", category, name)
    return synchronise(found)


def alignment_errors(found: CategoryAlignment, labels: Mapping[str, PoseLabel]) -> tuple[list[float], list[float]]:
    """Compute the rotation errors in degrees of all ordered pairs of labelled objects, and of every pair alone."""
    turns = {name: labels[name].trans[:3, :3] for name in found.objects if name in labels}
    true = {(a, b): turns[b] @ turns[a].T for a, b in permutations(turns, 2)}
    together = [float(rotation_error(found.between(*pair).R, true[pair])) for pair in true]
    alone = [((one.reference, one.target), one.sim3s[0].R) for one in found.pairs]
    return together, [float(rotation_error(rotation, true[pair])) for pair, rotation in alone if pair in true]


def read_hypotheses(out: str | Path) -> dict[str, PairHypotheses]:
    """Read the hypotheses that a run of `align_category` keeps, by the key of the pair of frames, for `synchronise`."""
    found = {}
    for line in (line for line in read_lines(out, _Line) if line.matrices):
        names = [part.rpartition(":")[0] for part in line.pair.split("/")[1:]]
        sim3s = tuple(map(Sim3.from_matrix, np.array(line.matrices)))
        found[line.pair] = PairHypotheses(*names, sim3s, np.array(line.probabilities), np.array(line.centre))
    return found


def estimate_with_helpers(
    sources: Sequence[Source], backbone: FeatureExtractor, reference_frame: int | None = None, targets: int = 5,
    upright: bool = True,
) -> PairResult:  # fmt: skip
    """Estimate the pose between the first two of one's own objects; the others settle what these two cannot.

    Of the hypotheses for these two, the one that agrees with the alignment of all objects comes first.
    """
    if len({one.path.resolve() for one in sources}) < len(sources):
        raise InputError(f"{', '.join(str(one.path) for one in sources)}: expected different objects")
    solve = partial(estimate_pose, solver="verified", targets=targets, backbone=_Remembering(backbone), upright=upright)
    found = {(0, 1): solve(*sources[:2], reference_frame=reference_frame)}
    for a, b in permutations(range(len(sources)), 2):
        if (a, b) != (0, 1) and sources[b].format != "image":  # an image alone is the reference of pairs only
            with suppress(NoPoseError):
                found[a, b] = solve(sources[a], sources[b], reference_frame=None if a else reference_frame)
    names = [f"{k} {one.name}" for k, one in enumerate(sources)]
    pairs = {
        (a, b): world_hypotheses(Pair("", names[a], 0, names[b], ()), one.estimates["verified"])
        for (a, b), one in found.items()
    }
    alignment = synchronise(list(pairs.values()))
    estimate, (first, second) = found[0, 1].estimates["verified"], found[0, 1].sources
    helpers = ", ".join(str(one.path) for one in sources[2:])
    result = replace(found[0, 1], sources=(first, f"{second}; helpers: {helpers}"))
    rotations = np.stack([one.R for one in pairs[0, 1].sim3s])
    angles = rotation_angle(rotations, alignment.between(*names[:2]).R)
    if angles.min() > SAME_ANGLE:
        flags = (*estimate.flags, "no hypothesis agrees with the other objects: they were not used")
        return replace(result, estimates={"verified": replace(estimate, flags=flags)})
    sure = min(alignment.objects[name].probability for name in names[:2])
    estimates = {"verified": _settled(estimate, int(angles.argmin()), sure)}
    return replace(result, estimates=estimates, errors=known_errors(*sources[:2], result, estimates))


def _settled(estimate: PoseEstimate, chosen: int, probability: float) -> PoseEstimate:
    """Put the hypothesis with an index first, with a probability; the others share what is left."""
    rotations = np.stack([estimate.world_rotation(one) for one in estimate.hypotheses])
    before = rotation_angle(rotations[:, None], rotations)
    order = sorted(range(len(rotations)), key=lambda k: k != chosen)
    after, ordered = before[np.ix_(order, order)], [estimate.hypotheses[k] for k in order]
    mode = modes(after)
    rest = sum(one.confidence for k, one in enumerate(ordered) if 0 != mode[k] == k) or 1.0
    hypotheses = tuple(
        replace(one, mode=int(m), confidence=(1 - probability) * one.confidence / rest if m else probability)
        for one, m in zip(ordered, mode)
    )
    old, (new, one_of_two) = reliability_flags(estimate.hypotheses, before)[0], reliability_flags(hypotheses, after)
    return replace(
        estimate, sim3=ordered[0].sim3, view=ordered[0].view, hypotheses=hypotheses, one_of_two=one_of_two,
        flags=(*new, *(flag for flag in estimate.flags if flag not in old)),
    )  # fmt: skip


class _Remembering:
    """A backbone that computes the features of an image once."""

    def __init__(self, backbone: FeatureExtractor):
        self._backbone, self._known = backbone, {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backbone, name)

    def __call__(self, images: Sequence[np.ndarray]) -> list[Any]:
        for image in images:
            if (name := image.tobytes()) not in self._known:
                (self._known[name],) = self._backbone([image])
        return [self._known[image.tobytes()] for image in images]


def write_alignment(found: CategoryAlignment, out: str | Path) -> Path:
    """Write the poses of all objects in the common frame, and the disagreements, to OUT/alignment.json."""
    objects = {
        name: {
            "world_to_frame": one.sim3.matrix.tolist(),
            "probability": round(one.probability, 4),
            "alternative": None if one.alternative is None else one.alternative.matrix.tolist(),
            "alternative_probability": round(one.alternative_probability, 4),
        }
        for name, one in found.objects.items()
    }
    path = Path(out) / "alignment.json"
    pairs = [{"pair": pair, "degrees": round(angle, 2)} for pair, angle in found.disagreements.items()]
    write_atomic(path, json.dumps({"objects": objects, "disagreements": pairs}, indent=1).encode())
    return path


def write_labels(
    found: CategoryAlignment, root: str | Path, category: str, kind: str = "class_labels", replace: bool = False
) -> Path:
    """Write the alignment as pose labels to ROOT/KIND/CATEGORY/, in the format of the published code.

    The first object is the reference. Without `replace`, InputError if one exists with other content.
    """
    reference, folder = next(iter(found.objects)), Path(root) / kind / category
    centre = found.objects[reference].centre
    labels = {name: rigid_label(found.between(reference, name), centre, name, reference) for name in found.objects}
    write_all({folder / f"{name}.json": label_bytes(label) for name, label in labels.items()}, replace)
    return folder
