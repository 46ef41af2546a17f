"""A whole category in one frame, as a run of the benchmark's kind."""

import json
import logging
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any, ClassVar
from uuid import uuid4

import msgspec
import numpy as np

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.named import BackboneLike, as_backbone
from zsp_lite.benchmark.execution import Evaluator, check_workers, evaluate_pairs
from zsp_lite.benchmark.problem import FrameStore, evenly_spaced
from zsp_lite.benchmark.runs import open_run, read_lines
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import PoseLabel
from zsp_lite.data.published import write_all
from zsp_lite.data.writing import label_bytes, rigid_label
from zsp_lite.errors import InputError
from zsp_lite.importers.sources import SourceLike, list_sources, open_source
from zsp_lite.io.files import plain_name, read_json, write_atomic
from zsp_lite.metrics import rotation_error
from zsp_lite.scans.category import CategoryAlignment, PairHypotheses, partners, synchronise

logger = logging.getLogger(__name__)


class _Line(msgspec.Struct, omit_defaults=True):
    """A line of the run: the hypotheses of a pair; none if the views determine no pose."""

    # The rows and the repeat, as a `ResultLine` has them.
    results: ClassVar[tuple[str]] = ("alignment",)
    repeat: ClassVar[int] = 0
    pair: str
    centre: list[float] = []
    matrices: list[list[list[float]]] = []
    probabilities: list[float] = []

    def hypotheses(self) -> PairHypotheses | None:
        """Return the hypotheses, if there are some."""
        if not self.matrices:
            return None
        pair = Pair.from_key(self.pair)
        return PairHypotheses(
            pair.reference_sequence,
            pair.target_sequence,
            tuple(map(Sim3.from_matrix, np.array(self.matrices))),
            np.array(self.probabilities),
            np.array(self.centre),
        )


class _Written(msgspec.Struct):
    """The objects of OUT/alignment.json."""

    objects: dict[str, Any]


class SourceSet(Co3D):
    """Sources as the sequences of a data set, each in its own world and lengths.

    They are named by their folders or files, frames in memory by their position, from "1" on.
    """

    def __init__(self, sources: Iterable[SourceLike]):
        """Open the sources, find the masks that they lack, and log doubts about them."""
        self._by_name = {}
        for position, given in enumerate(list_sources(sources), 1):
            source = open_source(given).segmented()
            name = str(position) if source.format == "frames" else source.name
            if name in self._by_name:
                raise InputError(f"two objects are named {name}, expected different names")
            self._by_name[name] = source
            for flag in source.flags([source.read_frame(0)]):
                logger.warning("%s: %s", name, flag)
        # Files and frames may have changed since an earlier call: no run of it is continued.
        self.root = Path(f"sources {uuid4()}")

    def frame_numbers(self, category: str) -> dict[str, list[int]]:
        """List the numbers of the frames of every source."""
        return {name: list(source.numbers) for name, source in self._by_name.items()}

    def frame(self, category: str, sequence: str, frame_number: int) -> Frame:
        """Load the frame of a source with a number, with its mask."""
        source = self._by_name[sequence]
        return source.read_frame(source.numbers.index(frame_number))

    def load(self, annotation: Frame) -> Frame:
        """Return a frame, which `frame` has loaded, as it is."""
        return annotation


@dataclass
class HypothesisFinder:
    """Finds the hypotheses of pairs; frames and features are kept from pair to pair."""

    dataset: Co3D
    backbone: BackboneLike

    def open(self, threads: int) -> Evaluator:
        """Load the backbone, once in each process."""
        if not hasattr(self, "store"):  # the first call in this process
            extractors = {"backbone": as_backbone(self.backbone)}
            self.store = FrameStore(self.dataset, extractors, threads)
        return self.line

    def line(self, pair: Pair, names: Sequence[str]) -> _Line:
        """Find the hypotheses of a pair; `names` of rows are those of `_Line.results`."""
        found = self.store.hypotheses(pair)
        if found is None:
            return _Line(pair.key)
        matrices = [sim3.matrix.tolist() for sim3 in found.sim3s]
        return _Line(pair.key, found.centre.tolist(), matrices, found.probabilities.tolist())


def align_category(
    dataset: Co3D | Iterable[SourceLike],
    category: str = "objects",
    backbone: BackboneLike = "zsp-tiny",
    sequences: Sequence[str] | None = None,
    pairs: int | None = None,
    targets: int = 5,
    out: str | Path | None = None,
    executor: Executor | int = 1,
) -> CategoryAlignment:
    """Align all objects of a category in one frame, without labels (see `category`).

    Objects to which nothing tells a pose are left out. A run of a data set in OUT is continued:
    frames that it has are not solved again. Sources need a new OUT.

    Args:
        dataset: Data set; or sources of the objects (see `open_source`), such as paths of scans, or
            lists of frames: poses are in their worlds and lengths. Objects are named by their
            folders or files, frames in memory "1", "2", and so on.
        category: Name of the category; of sources, any name.
        backbone: Backbone, or what `load_backbone` takes.
        sequences: Names of the sequences, one per object; None for all of the category.
        pairs: Partners of each object; None for all others, or from twelve objects on, for six.
        targets: Frames of each object, of which up to four are solved against those of another.
        out: Folder of the run, which keeps the hypotheses of the pairs; None keeps nothing.
        executor: Number of processes, or any `Executor`.

    Raises:
        InputError: Sequences are fewer than two, without frames, or not connected by pairs with
            poses; OUT has another run.
        FatalError: The backbone is broken, or a frame cannot be read.
    """
    check_workers(executor)
    if isinstance(dataset, Co3D):
        # Workers read the annotations themselves, because these are large.
        opened = Co3D(dataset.root.resolve())
    else:
        opened = dataset = SourceSet(dataset)
    numbers = dataset.frame_numbers(category)
    names = sorted(numbers if sequences is None else set(sequences))
    if len(names) < 2:
        raise InputError(
            f"category {category}: {len(names)} sequences to align, expected at least 2"
        )
    for name in names:
        if not numbers.get(name):
            raise InputError(f"sequence {category}/{name} has no frames")
    frames = evenly_spaced({name: numbers[name] for name in names}, targets)
    loaded = as_backbone(backbone)
    # Workers load a named backbone themselves; an object travels to them.
    finder = HypothesisFinder(opened, loaded if executor == 1 else backbone)
    with tempfile.TemporaryDirectory() if out is None else nullcontext(out) as folder:
        with open_run(
            folder,
            dataset.root,
            loaded,
            targets,
            {"alignment": "hypotheses of the verified solver"},
            {},  # no hash of an object is kept
            _Line,
            pairs={category: len(names)},
        ) as lines:

            def solve(asked: list[Pair]) -> list[PairHypotheses | None]:
                work = dict.fromkeys(asked, ["alignment"])
                evaluate_pairs(folder, finder.open, work, executor, lines)
                found = {line.pair: line.hypotheses() for line in lines}
                return [found[pair.key] for pair in asked]

            # Without a backbone among its extractors: `solve` stands in for it.
            store = FrameStore(opened, {})
            judged = store.judged(category, frames, pairs=partners(names, pairs), solve=solve)
    if not judged:
        raise InputError(f"category {category}: nothing tells the pose between any two objects")
    found = synchronise(judged)
    for name in sorted(set(names) - found.objects.keys()):
        logger.warning("%s/%s is left out: nothing tells its pose", category, name)
    return found


def alignment_errors(alignment: CategoryAlignment, labels: Mapping[str, PoseLabel]) -> list[float]:
    """Compute the rotation errors in degrees of the alignment, for all ordered pairs of labelled
    objects."""
    turns = {name: labels[name].trans[:3, :3] for name in alignment.objects if name in labels}
    return [
        float(rotation_error(alignment.between(a, b).R, turns[b] @ turns[a].T))
        for a, b in permutations(turns, 2)
    ]


def read_hypotheses(out: str | Path) -> dict[str, PairHypotheses]:
    """Read the hypotheses that a run of `align_category` keeps, by the key of the pair of frames,
    for `synchronise`."""
    lines = read_lines(out, _Line)
    return {line.pair: line.hypotheses() for line in lines if line.matrices}


def write_alignment(found: CategoryAlignment, out: str | Path, axes: Sim3 | None = None) -> Path:
    """Write the poses of all objects in the common frame, and the disagreements, to
    OUT/alignment.json.

    With `axes` (see `category_axes`) every object also gets the rigid pose from its world to them.
    """
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
    pairs = [
        {"pair": pair, "degrees": round(angle, 2)} for pair, angle in found.disagreements.items()
    ]
    document = {"objects": objects, "disagreements": pairs}
    if axes:
        document["axes"] = "x front, y left, z up; origin amid the objects; lengths of the data"
        for name, one in found.objects.items():
            matrix = (axes @ one.sim3).matrix
            matrix[:3] /= one.sim3.scale  # rigid: in the lengths of the object's world
            objects[name]["world_to_axes"] = matrix.tolist()
    write_atomic(path, json.dumps(document, indent=1).encode())
    return path


def remove_outputs(out: str | Path, category: str) -> None:
    """Remove what an earlier run has written to OUT for each of its objects, and for marks."""
    out = Path(out)
    if not (out / "alignment.json").is_file():
        return
    for name in read_json(out / "alignment.json", _Written, "alignment").objects:
        plain_name(name, "object")
        (out / "class_labels" / category / f"{name}.json").unlink(missing_ok=True)
        (out / "marks" / f"{name}.ply").unlink(missing_ok=True)
    for file in ("marks.json", "marks.jpg"):
        (out / file).unlink(missing_ok=True)


def write_labels(
    found: CategoryAlignment,
    root: str | Path,
    category: str,
    kind: str = "class_labels",
    replace: bool = False,
) -> Path:
    """Write the alignment as pose labels to ROOT/KIND/CATEGORY/, in the format of the published
    code.

    The first object is the reference. Without `replace`, InputError if one exists with other
    content.
    """
    folder = Path(root) / kind / category
    reference = next(iter(found.objects))
    centre = found.objects[reference].centre
    files = {}
    for name in found.objects:
        label = rigid_label(found.between(reference, name), centre, name, reference)
        files[folder / f"{name}.json"] = label_bytes(label)
    write_all(files, replace)
    return folder
