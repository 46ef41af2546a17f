"""What was picked and accepted in a category so far. Every change is on disk at once; a restart loses nothing.

ROOT/label_picks/CATEGORY.json holds the keypoints' names and all picks, ROOT/class_labels/CATEGORY/SEQ.json the
labels that were accepted, in the upstream form.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, Real

from zsp_lite.alignment import Sim3
from zsp_lite.data.annotations import SequenceAnnotation, Triple, decode
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, label_folder, read_labels, rigid_label, write_label
from zsp_lite.errors import InputError
from zsp_lite.io.files import plain_name, read_bytes, write_atomic
from zsp_lite.labelling.keypoints import MIN_KEYPOINTS, Alignment, align_picks

Point = Real[np.ndarray, "3"] | Sequence[float]
OPEN, ACCEPTED, SKIPPED, REFERENCE = "open", "accepted", "skipped", "reference"


class _Picks(msgspec.Struct):
    reference_seq: str
    names: list[str]
    picks: dict[str, list[Triple]]
    skipped: list[str]


@dataclass(frozen=True)
class Progress:
    """How far a sequence is.  state: "reference", "open", "accepted" or "skipped".  picks: how many.
    rms: residual of its alignment, a share of the picks' spread; None before all keypoints are picked.
    problem: why its picks give no alignment, such as two at one place; "" where nothing is wrong.
    """

    sequence: str
    state: str
    picks: int
    rms: float | None
    problem: str = ""


class Labelling:
    """The labelling of one category: pick, undo, name, align, accept.

    The reference is the sequence whose point cloud scores best (or that of labels which are there already); picks are
    world points of their sequence, in the order of the reference's keypoints. Use it from one process at a time.
    """

    def __init__(
        self, root: str | Path, category: str, sequences: Sequence[str] | None = None, reference: str | None = None
    ):
        """Open the category, with what was picked before.

        sequences: the candidates; default: the ten with the best clouds (`Co3D.select`), or all that have a cloud
        where the data has no scores.  reference: default as above. Raises InputError where the category or a sequence
        is not there, where fewer than two have clouds, or where the picks or labels on disk are another reference's.
        """
        self.root, self.category, self.dataset = Path(root), plain_name(category, "category"), Co3D(root)
        known = {one.sequence_name: one for one in self.dataset.sequences(category)}
        with_cloud = [name for name, one in known.items() if one.point_cloud is not None]
        chosen = sequences or [one.sequence_name for one in self.dataset.select(category)] or with_cloud
        chosen = list(dict.fromkeys(chosen))
        self.path = self.root / "label_picks" / f"{self.category}.json"
        stored = decode(read_bytes(self.path, "picks"), _Picks, self.path) if self.path.is_file() else None
        if stored and len(stored.names) != len(stored.picks.get(stored.reference_seq, [])):
            raise InputError(
                f"picks {self.path}: {len(stored.names)} names and "
                f"{len(stored.picks.get(stored.reference_seq, []))} picks on the reference, expected equally many"
            )
        labelled = {label.reference_seq for label in read_labels(root, category).values()}
        bound = ({stored.reference_seq} if stored else set()) | labelled
        if len(bound | ({reference} if reference else set())) > 1:
            given = f"reference {reference}, " if reference else ""
            raise InputError(
                f"category {category}: {given}labels and picks on disk refer to {', '.join(sorted(bound))}, "
                "expected one reference sequence"
            )
        best = max(chosen, key=lambda name: _cloud_quality(known.get(name)), default="")
        self.reference = reference or next(iter(bound), None) or best
        if self.reference and self.reference not in chosen:
            chosen.insert(0, self.reference)
        for name in chosen:
            if name not in with_cloud:
                raise InputError(
                    f"sequence {category}/{name} has no point cloud, expected some of {', '.join(with_cloud) or 'none'}"
                )
        if len(chosen) < 2:
            raise InputError(f"category {category} has {len(chosen)} sequence with a cloud, expected at least two")
        self.sequences = sorted(chosen, key=lambda name: name != self.reference)
        self._stored = stored or _Picks(self.reference, [], {}, [])
        self._clouds: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """The keypoints' names, in the order in which they are picked."""
        return tuple(self._stored.names)

    def picks(self, sequence: str) -> Float[np.ndarray, "n 3"]:
        """World points picked on a sequence so far."""
        return np.array(self._stored.picks.get(self._known(sequence), []), dtype=np.float64).reshape(-1, 3)

    def cloud(self, sequence: str) -> tuple[np.ndarray, np.ndarray]:
        """World points (n, 3) and colours (n, 3), uint8, of a sequence's cloud; grey where it has no colours."""
        if self._known(sequence) not in self._clouds:
            points, colours = self.dataset.point_cloud(self.category, sequence)
            if colours is None:
                colours = np.full(points.shape, 128, np.uint8)
            self._clouds[sequence] = points, colours
        return self._clouds[sequence]

    def first_view(self, sequence: str) -> Float[np.ndarray, "3 3"]:
        """World directions right, down and away, as rows, of a sequence's first camera; the world's own without one."""
        for frame in self.dataset.frames(self.category, self._known(sequence)):
            if frame.viewpoint is not None:
                return self.dataset.camera(frame).R
        return np.eye(3)

    def pick(self, sequence: str, point: Point, name: str | None = None) -> None:
        """Add the next keypoint of a sequence: `point` (3,) in its world.

        name: of a new keypoint of the reference (default: a number). Raises InputError where all keypoints are picked
        already, or the reference's would change under those of other sequences.
        """
        point = _finite_point(point, sequence)
        picks = self._editable(sequence)
        if sequence == self.reference:
            self._stored.names.append(name or f"keypoint {len(picks) + 1}")
        elif len(picks) >= len(self.names):
            raise InputError(f"sequence {sequence}: all {len(self.names)} keypoints are picked; undo one to pick again")
        picks.append(point)
        self._save()

    def undo(self, sequence: str) -> None:
        """Take the last pick of a sequence back; nothing happens where there is none."""
        if len(self.picks(sequence)):
            self._editable(sequence).pop()
            if sequence == self.reference:
                self._stored.names.pop()
            self._save()

    def clear(self, sequence: str) -> None:
        """Take all picks of a sequence back. A label that was accepted stays until another is."""
        self._editable(sequence).clear()
        if sequence == self.reference:
            self._stored.names.clear()
        self._save()

    def put(self, sequence: str, points: Real[np.ndarray, "n 3"], names: Sequence[str] = ()) -> None:
        """Replace all picks of a sequence: what taking a change back needs.  names: of the reference's keypoints."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        wanted = len(names) if sequence == self.reference else min(len(points), len(self.names))
        if not np.isfinite(points).all() or len(points) != wanted:
            raise InputError(f"{len(points)} picks put on {sequence}, expected {wanted} finite points")
        self._editable(sequence)[:] = [tuple(point) for point in points.tolist()]
        if sequence == self.reference:
            self._stored.names[:] = names
        self._save()

    def rename(self, index: int, name: str) -> None:
        """Give keypoint `index` (from 0) another name."""
        if not 0 <= index < len(self.names) or not name.strip():
            raise InputError(f"keypoint {index} as {name!r}: expected 0 to {len(self.names) - 1}, and a name")
        self._stored.names[index] = name.strip()
        self._save()

    def guess(self, sequence: str, sim3: Sim3) -> None:
        """Put a sequence's picks where `sim3` (reference world to its world) says, each on the nearest cloud point.

        No two on one point: a guess that is far off may lead several to the same.
        """
        if sequence == self.reference or len(self.names) < MIN_KEYPOINTS:
            raise InputError(f"a guess for {sequence} needs {MIN_KEYPOINTS} keypoints on the reference first")
        cloud, moved = self.cloud(sequence)[0], sim3.apply(self.picks(self.reference))
        picks = self._editable(sequence)
        taken: list[int] = []
        for point in moved:
            distance = np.square(cloud - point).sum(axis=1)
            distance[taken] = np.inf
            taken.append(int(distance.argmin()))
        picks[:] = [tuple(cloud[index].tolist()) for index in taken]
        self._save()

    def move(self, sequence: str, index: int, point: Point) -> None:
        """Put pick `index` (from 0) of a sequence elsewhere."""
        picks = self._editable(sequence)
        if not 0 <= index < len(picks):
            raise InputError(f"sequence {sequence} has no pick {index}, expected 0 to {len(picks) - 1}")
        picks[index] = _finite_point(point, sequence)
        self._save()

    def alignment(self, sequence: str) -> Alignment | None:
        """The reference laid on a sequence by its picks; None before all are picked. Raises as `align_picks`."""
        picks = self.picks(sequence)
        if len(picks) < MIN_KEYPOINTS or len(picks) != len(self.names):
            return None
        return align_picks(self.picks(self.reference), picks, self.names)

    def accept(self, sequence: str) -> Path:
        """Write the sequence's label, and the reference's own, the identity; returns the file.

        Raises InputError where keypoints are missing.
        """
        if self._known(sequence) == self.reference:
            raise InputError(f"sequence {sequence} is the reference: its label is the identity and comes by itself")
        alignment = self.alignment(sequence)
        if alignment is None:
            raise InputError(
                f"sequence {sequence}: {len(self.picks(sequence))} of {len(self.names)} keypoints picked, "
                f"expected all, at least {MIN_KEYPOINTS}"
            )
        centre = self.cloud(self.reference)[0].mean(axis=0)
        label = rigid_label(alignment.sim3, centre, sequence, self.reference)
        write_label(self.root, self.category, PoseLabel(np.eye(4), self.reference, self.reference))
        path = write_label(self.root, self.category, label)
        if sequence in self._stored.skipped:
            self._stored.skipped.remove(sequence)
        self._save()
        return path

    def skip(self, sequence: str) -> None:
        """Leave a sequence out, such as a bad cloud; picking on it takes it up again. The label made of its picks goes.

        Raises InputError for the reference, and for a sequence whose label was not made of picks.
        """
        if self._known(sequence) == self.reference:
            raise InputError(f"sequence {sequence} is the reference, which cannot be skipped")
        path = label_folder(self.root, self.category) / f"{sequence}.json"
        if path.is_file() and len(self.picks(sequence)) != len(self.names):
            raise InputError(f"sequence {sequence} has a label not made of picks; remove {path} to leave it out")
        path.unlink(missing_ok=True)
        if sequence not in self._stored.skipped:
            self._stored.skipped.append(sequence)
            self._save()

    def progress(self) -> list[Progress]:
        """Every sequence's state, the reference first."""
        labels = read_labels(self.root, self.category)
        rows = []
        for name in self.sequences:
            state = REFERENCE if name == self.reference else ACCEPTED if name in labels else OPEN
            state = SKIPPED if name in self._stored.skipped else state
            alignment, problem = None, ""
            try:
                alignment = None if name == self.reference else self.alignment(name)
            except InputError as error:
                problem = str(error)
            rows.append(Progress(name, state, len(self.picks(name)), alignment and alignment.rms, problem))
        return rows

    def _known(self, sequence: str) -> str:
        if sequence not in self.sequences:
            raise InputError(f"sequence is {sequence!r}, expected one of {', '.join(self.sequences)}")
        return sequence

    def _editable(self, sequence: str) -> list[Triple]:
        """The list of a sequence's picks, where it may change."""
        if self._known(sequence) == self.reference:
            others = [name for name, picks in self._stored.picks.items() if name != sequence and picks]
            if others:
                raise InputError(
                    f"keypoints of the reference {sequence} are in use on {', '.join(others)}; clear those first"
                )
        if sequence in self._stored.skipped:
            self._stored.skipped.remove(sequence)
        return self._stored.picks.setdefault(sequence, [])

    def _save(self) -> None:
        write_atomic(self.path, msgspec.json.format(msgspec.json.encode(self._stored), indent=1))


def _finite_point(point: Point, sequence: str) -> Triple:
    point = np.asarray(point, dtype=np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(f"pick on {sequence} is {point.tolist()}, expected a finite point (3,)")
    return tuple(point.tolist())


def _cloud_quality(sequence: SequenceAnnotation | None) -> float:
    """The score of a sequence's cloud, below all others where it has none."""
    score = None if sequence is None or sequence.point_cloud is None else sequence.point_cloud.quality_score
    return -np.inf if score is None else score
