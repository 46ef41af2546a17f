"""Labelling session of a category, stored on disk after every change, and the alignment of two
clouds by keypoints.

See "Labelling pose for evaluation" in the paper's supplement: at least four keypoints are picked in
the same order on the clouds of the reference sequence and of another sequence, and aligned by
Umeyama's method with scale.

ROOT/label_picks/CATEGORY.json holds the names of the keypoints and all picks.
ROOT/class_labels/CATEGORY/SEQ.json holds an accepted label in the format of the published code.
ROOT/label_proposals/CATEGORY/SEQ.json holds, in the same format, a label that
`zsp-lite align --propose` proposes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, Real
from numpy.typing import ArrayLike

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.data.annotations import Row
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, read_label_folder, read_labels
from zsp_lite.data.writing import rigid_label, write_label
from zsp_lite.errors import InputError, check_choice, check_magnitude, real_array
from zsp_lite.io.files import plain_name, read_json, write_atomic

Point = Real[np.ndarray, "3"] | Sequence[float]
MIN_KEYPOINTS = 4  # as in the paper
# A label whose RMS residual is above this fraction of the object's size is accepted on request
# only: usually two keypoints are confused. The size is the longest side of the point cloud without
# outliers.
MAX_RESIDUAL = 0.15
# States of a sequence.
OPEN = "open"
ACCEPTED = "accepted"
REFERENCE = "reference"


@dataclass(frozen=True, eq=False)
class Alignment:
    """Alignment of the reference sequence with another sequence."""

    sim3: Sim3  # from the world of the reference sequence to that of the sequence
    # Distance of each transformed keypoint from its pick, relative to the spread of the picks
    # (their standard deviation, averaged over the axes), so that objects of any size can be
    # compared.
    residuals: Float[np.ndarray, " n"]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.square(self.residuals).mean()))


def align_picks(reference: ArrayLike, picks: ArrayLike) -> Alignment:
    """Align keypoints by Umeyama's method with scale.

    Args:
        reference: Keypoints (n, 3) of the reference sequence in its world, n >= 4.
        picks: The same keypoints of another sequence in its world.

    Returns:
        The alignment from the world of the reference to that of the other sequence.

    Raises:
        InputError: The numbers differ or are below 4, a keypoint is not finite, or all keypoints
            are equal or collinear.
    """
    reference = np.asarray(reference, dtype=np.float64)
    picks = np.asarray(picks, dtype=np.float64)
    if len(reference) != len(picks) or len(picks) < MIN_KEYPOINTS:
        raise InputError(
            f"{len(picks)} keypoints picked and {len(reference)} on the reference, expected "
            f"equally many, at least {MIN_KEYPOINTS}"
        )
    sim3 = umeyama(reference, picks)
    distance = np.linalg.norm(sim3.apply(reference) - picks, axis=1)
    return Alignment(sim3, distance / np.sqrt(picks.var(axis=0).mean()))


class _Picks(msgspec.Struct):
    """Content of ROOT/label_picks/CATEGORY.json."""

    reference_seq: str
    names: list[str]
    picks: dict[str, list[Row]]


@dataclass(frozen=True)
class Progress:
    """Progress of a sequence."""

    sequence: str
    state: str  # "reference", "open" or "accepted"
    picks: int
    # RMS residual relative to the spread of the picks; None before all keypoints are picked
    rms: float | None
    problem: str = ""  # why the picks give no alignment, such as all on one line


class Labelling:
    """Labelling of one category: pick keypoints, align, accept.

    Keypoints are defined on the reference sequence and picked on the others in the same order, as
    points in world coordinates of the sequence. Only one process may use a session at a time.
    """

    def __init__(self, root: str | Path, category: str):
        """Open a category with its stored picks.

        The sequences are the ten with the best point clouds (`Co3D.select`), or all with a point
        cloud if there are no quality scores; the reference is that of the stored picks and labels,
        or else the best point cloud. InputError if the category is unknown, fewer than two
        sequences have point clouds, or the references differ.
        """
        self.root = Path(root)
        self.category = plain_name(category, "category")
        self.dataset = Co3D(root)
        known = {sequence.sequence_name: sequence for sequence in self.dataset.sequences(category)}
        with_cloud = [name for name in known if known[name].point_cloud is not None]

        # The stored picks, and the reference that they and the labels name.
        self.path = self.root / "label_picks" / f"{self.category}.json"
        stored = read_json(self.path, _Picks, "picks") if self.path.is_file() else None
        references = set()
        if stored:
            names = len(stored.names)
            picks = len(stored.picks.get(stored.reference_seq, []))
            if names != picks:
                raise InputError(
                    f"picks {self.path}: {names} names, but {picks} picks on the reference"
                )
            references.add(stored.reference_seq)
        references.update(label.reference_seq for label in read_labels(root, category).values())
        if len(references) > 1:
            raise InputError(
                f"category {category}: reference, stored picks and labels name "
                f"{', '.join(sorted(references))}, expected one reference sequence"
            )

        # The sequences to label, each once.
        best_clouds = [sequence.sequence_name for sequence in self.dataset.select(category)]
        chosen = list(dict.fromkeys([*references, *(best_clouds or with_cloud)]))
        missing = [name for name in chosen if name not in with_cloud]
        if missing:
            allowed = ", ".join(with_cloud) or "none"
            raise InputError(
                f"sequence {category}/{missing[0]} has no point cloud, expected some of {allowed}"
            )
        if len(chosen) < 2:
            raise InputError(
                f"category {category} has {len(chosen)} sequence with a point cloud, expected two"
            )
        best = max(chosen, key=lambda name: known[name].point_cloud.quality_score or -np.inf)
        self.reference = next(iter(references), best)
        # The reference comes first; the order of the others stays.
        self.sequences = sorted(chosen, key=lambda name: name != self.reference)
        self._stored = stored or _Picks(self.reference, [], {})
        proposals = read_label_folder(self.root / "label_proposals" / self.category)
        self._proposals = {name: label.trans for name, label in proposals.items()}
        self._clouds: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the keypoints, in the order of picking."""
        return tuple(self._stored.names)

    def picks(self, sequence: str) -> Float[np.ndarray, "n 3"]:
        """Return the picks (n, 3) on a sequence, in its world coordinates."""
        picks = self._stored.picks.get(self._known(sequence), [])
        return np.array(picks, dtype=np.float64).reshape(-1, 3)

    def cloud(self, sequence: str) -> tuple[np.ndarray, np.ndarray]:
        """Return points (n, 3) and colours (n, 3), uint8, of a sequence's point cloud; grey if it
        has no colours."""
        if self._known(sequence) not in self._clouds:
            points, colours = self.dataset.point_cloud(self.category, sequence)
            if colours is None:
                colours = np.full(points.shape, 128, np.uint8)
            self._clouds[sequence] = points, colours
        return self._clouds[sequence]

    def first_view(self, sequence: str) -> Float[np.ndarray, "3 3"]:
        """Return the rotation (3, 3) from world to first camera of a sequence; the identity without
        cameras."""
        for frame in self.dataset.frames(self.category, self._known(sequence)):
            if frame.viewpoint is not None:
                return self.dataset.camera(frame).R
        return np.eye(3)

    def pick(self, sequence: str, point: Point, name: str = "") -> None:
        """Add the next keypoint of a sequence.

        Args:
            sequence: Name of the sequence.
            point: The keypoint in world coordinates of the sequence.
            name: Name of the keypoint, if it is a new one of the reference.

        Raises:
            InputError: All keypoints are picked, or the keypoints of the reference are in use on
                other sequences.
        """
        picks = self.picks(sequence)
        if sequence != self.reference and len(picks) >= len(self.names):
            raise InputError(
                f"sequence {sequence}: all {len(self.names)} keypoints are picked; undo one "
                "to pick again"
            )
        self.put(sequence, [*picks, point], (*self.names, name or f"keypoint {len(picks) + 1}"))

    def undo(self, sequence: str) -> None:
        """Remove the last pick of a sequence, if there is one."""
        picks = self.picks(sequence)
        if len(picks):
            self.put(sequence, picks[:-1], self.names[:-1])

    def proposal(self, sequence: str) -> Sim3 | None:
        """Return the proposed similarity from the world of the reference to that of a sequence;
        None without one."""
        if not {self.reference, self._known(sequence)} <= self._proposals.keys():
            return None
        # Proposals lead from a reference of their own, which need not be that of the session.
        trans = self._proposals[sequence] @ np.linalg.inv(self._proposals[self.reference])
        return Sim3(1.0, trans[:3, :3], trans[:3, 3])

    def put(
        self,
        sequence: str,
        points: Sequence[Point] | Real[np.ndarray, "n 3"],
        names: Sequence[str] = (),
    ) -> None:
        """Replace all picks (n, 3) of a sequence, and on the reference the names of the keypoints.

        An accepted label is kept until another one is accepted.
        """
        points = points if len(points) else np.zeros((0, 3))
        points = real_array(f"picks on {sequence}", points, (None, 3))
        check_magnitude(f"picks on {sequence}", points)
        stored = self._stored
        if self._known(sequence) == self.reference:
            others = [name for name, picks in stored.picks.items() if name != sequence and picks]
            if others:
                raise InputError(
                    f"keypoints of the reference {sequence} are in use on {', '.join(others)}; "
                    "clear those first"
                )
            stored.names[:] = names
        stored.picks[sequence] = points.tolist()
        write_atomic(self.path, msgspec.json.format(msgspec.json.encode(stored), indent=1))

    def alignment(self, sequence: str) -> Alignment | None:
        """Align the reference with a sequence by the picks; None before all are picked."""
        picks = self.picks(sequence)
        if len(picks) < MIN_KEYPOINTS or len(picks) != len(self.names):
            return None
        return align_picks(self.picks(self.reference), picks)

    def doubt(self, sequence: str) -> str:
        """Say in a line why a label should be checked, or "": its RMS residual is above
        `MAX_RESIDUAL`."""
        alignment = self.alignment(sequence)
        if alignment is None:
            return ""
        # The factor from the spread of the picks to the object's size: residuals are relative to
        # the spread.
        low, high = np.percentile(self.cloud(sequence)[0], [1, 99], axis=0)
        scale = np.sqrt(self.picks(sequence).var(axis=0).mean()) / max((high - low).max(), 1e-12)
        residuals = scale * alignment.residuals
        rms = scale * alignment.rms
        if rms <= MAX_RESIDUAL:
            return ""
        worst = int(residuals.argmax())
        return (
            f"residual of {100 * rms:.0f} % of the object's size, above "
            f"{100 * MAX_RESIDUAL:.0f} %; the worst keypoint "
            f"is {self.names[worst]} with {100 * residuals[worst]:.0f} %"
        )

    def accept(self, sequence: str, confirmed: bool = False) -> Path:
        """Write the label of a sequence, and the label of the reference, which is the identity.

        Without picks on the sequence, the label is the proposal.

        Args:
            sequence: Name of the sequence.
            confirmed: Whether a label in `doubt` is written, too.

        Returns:
            The label file of the sequence.

        Raises:
            InputError: Keypoints are missing, the sequence is the reference, or the label is in
                doubt and not confirmed.
        """
        alignment = self.alignment(sequence)
        picked = len(self.picks(sequence))
        if alignment:
            sim3 = alignment.sim3
        else:
            sim3 = None if picked else self.proposal(sequence)

        if sequence == self.reference:
            raise InputError(
                f"sequence {sequence} is the reference: its label is the identity and comes by "
                "itself"
            )
        if sim3 is None:
            raise InputError(
                f"sequence {sequence} has {picked} of {len(self.names)} keypoints, expected all, "
                f"at least {MIN_KEYPOINTS}"
            )
        doubt = "" if confirmed else self.doubt(sequence)
        if doubt:
            raise InputError(
                f"sequence {sequence} has a {doubt}; expected a smaller one, or confirmed=True"
            )

        # A label has no scale: it moves the centre of the reference as the alignment does.
        centre = self.cloud(self.reference)[0].mean(axis=0)
        label = rigid_label(sim3, centre, sequence, self.reference)
        write_label(self.root, self.category, PoseLabel(np.eye(4), self.reference, self.reference))
        return write_label(self.root, self.category, label)

    def progress(self) -> list[Progress]:
        """Return the progress of every sequence, the reference first."""
        labels = read_labels(self.root, self.category)
        rows = []
        for name in self.sequences:
            state = ACCEPTED if name in labels else OPEN
            if name == self.reference:
                state = REFERENCE
            alignment = None
            problem = ""
            if name != self.reference:
                try:
                    alignment = self.alignment(name)
                except InputError as error:
                    problem = str(error)
            rms = alignment.rms if alignment else None
            rows.append(Progress(name, state, len(self.picks(name)), rms, problem))
        return rows

    def _known(self, sequence: str) -> str:
        """Return the name of a sequence of the session; InputError for others."""
        check_choice("sequence", sequence, self.sequences)
        return sequence
