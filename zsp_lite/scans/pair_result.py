"""What is found for one pair: the estimates of its solvers, the votes of its frames, and the errors
against pose labels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from zsp_lite.alignment import Sim3
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import read_labels, relative_pose
from zsp_lite.errors import check_choice
from zsp_lite.estimates import PoseEstimate
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.scans.transfer import TransferredPoints, describe_surface, marked_point, transfer
from zsp_lite.views import View


@dataclass(frozen=True, eq=False)
class Vote:
    """What one frame of one object says of a pose that several frames of both determine."""

    name: str  # the frame, such as "frame 12 of my_cup"
    estimate: PoseEstimate  # of this frame alone: of its object in views of the other
    degrees: float  # angle between the rotations of this estimate and of the answer
    backward: bool  # whether the frame shows the target, and the views the reference


@dataclass(frozen=True, eq=False)
class PairResult:
    """Pose estimates of one pair by one solver, or by both. `print` shows them."""

    title: str  # name of the pair, such as its category
    # where the reference and the target views come from, in words, and the size of the objects
    sources: tuple[str, str]
    reference: Frame  # reference frame, whole
    targets: tuple[Frame, ...]  # target frames, whole
    estimates: dict[str, PoseEstimate]  # estimate of each solver by its name, at least one
    # rotation error of each estimate in degrees; empty without pose labels
    errors: dict[str, float]
    # where the masks of the reference and of the targets come from: "given", "box" or "auto"
    masks: tuple[str, str] = ("given", "given")
    backbone: str = ""  # name of the backbone
    # votes of the frames of both objects, the reference frame's first; () if one frame was solved
    votes: tuple[Vote, ...] = ()
    files: tuple[Path, ...] = ()  # what `write_pair` has written
    # whole frames of the reference by number, and the views of both objects, for `transfer`
    frames: Mapping[int, Frame] = field(default_factory=dict)
    views: tuple[Sequence[View], Sequence[View]] = ((), ())

    @property
    def world_sim3(self) -> Sim3:
        """Similarity from the world of the reference to that of the target, by the first solver."""
        return self.estimate.world_sim3

    @property
    def estimate(self) -> PoseEstimate:
        """Estimate of the first solver."""
        return next(iter(self.estimates.values()))

    @property
    def error(self) -> float:
        """Rotation error of the first solver in degrees; NaN without pose labels."""
        return next(iter(self.errors.values()), float("nan"))

    @property
    def disagreement(self) -> float | None:
        """Angle in degrees between the rotations of two solvers; None if only one ran."""
        if len(self.estimates) < 2:
            return None
        first, second = [estimate.world_sim3.R for estimate in self.estimates.values()]
        return float(rotation_error(first, second))

    def transfer(
        self,
        points: ArrayLike | None = None,
        frame: int | None = None,
        x: float = 0.0,
        y: float = 0.0,
    ) -> TransferredPoints:
        """Find places of the reference on the target, by the pose and by features.

        Args:
            points: Points (n, 3) in the world of the reference.
            frame: In their place, the number of a frame of the reference that was used (see
                `frames`), with a pixel that has depth.
            x: Pixels from the left edge of the image to the place; pixel centres are at
                half-integers.
            y: Pixels from the upper edge.

        Returns:
            The places in the world of the target, with their confidence if the pose is right.

        Raises:
            InputError: Points of another shape, an unused frame, or a pixel without depth.
        """
        if points is None:
            check_choice("frame", frame, self.frames)
            what = f"pixel {x:g},{y:g} of frame {frame}"
            points = marked_point(self.frames[frame], x, y, what)[None]
        poses = self.world_sim3, Sim3.identity()
        source, target = (describe_surface(views, pose) for views, pose in zip(self.views, poses))
        return transfer(points, source, target)

    def __repr__(self) -> str:
        return "\n".join(f"{solver}: {estimate!r}" for solver, estimate in self.estimates.items())

    def as_json(self) -> dict[str, Any]:
        """Return all numbers in the types of JSON.

        Matrices are for column vectors; `null` marks what is unknown.
        """
        solved = {}
        for solver, estimate in self.estimates.items():
            solved[solver] = {
                "view": estimate.view,
                "view_name": self.targets[estimate.view].name,
                "matrix": estimate.sim3.matrix.tolist(),
                "rotation": estimate.sim3.R.tolist(),
                "translation": estimate.sim3.t.tolist(),
                "scale": float(estimate.sim3.scale),
                "inliers": int(estimate.inliers.sum()),
                "matches": len(estimate.matches),
                "world_matrix": estimate.world_sim3.matrix.tolist(),
                "confidence": estimate.confidence,
                "error_degrees": self.errors.get(solver),
                "flags": list(estimate.flags),
                "one_of_two": estimate.one_of_two,
                "alternatives": [
                    {
                        "view": other.view,
                        "matrix": other.sim3.matrix.tolist(),
                        "probability": other.confidence,
                        "degrees_from_best": estimate.angle_to(other),
                        "score_below_best": estimate.hypotheses[0].score - other.score,
                    }
                    for other in estimate.alternatives
                ],
                "seconds": dict(estimate.timings),
            }
        views = [frame.name for frame in self.targets]
        return {
            "reference": {"source": self.sources[0], "masks": self.masks[0]},
            "target": {"source": self.sources[1], "masks": self.masks[1], "views": views},
            "backbone": self.backbone,
            "estimates": solved,
            "degrees_between_solvers": self.disagreement,
            "votes": [
                {
                    "frame": vote.name,
                    "confidence": vote.estimate.confidence,
                    "degrees_from_answer": vote.degrees,
                }
                for vote in self.votes
            ],
        }


def label_errors(found: PairResult, category: Path, sequences: Sequence[str]) -> dict[str, float]:
    """Compute rotation errors in degrees; {} unless both sequences of the folder of a category have
    labels."""
    labels = read_labels(category.parent, category.name)
    if not set(sequences) <= set(labels):
        return {}
    first, second = map(labels.get, sequences)
    errors = {}
    for name, estimate in found.estimates.items():
        camera = found.targets[estimate.view].camera
        truth = relative_pose(first, found.reference.camera, second, camera)
        errors[name] = float(rotation_error(estimate.sim3.R, truth[:3, :3]))
    return errors


def run_pair(dataset: Co3D, pair: Pair, method: ZeroShotPose, solvers: Sequence[str]) -> PairResult:
    """Estimate the pose of a pair by each solver, and its error if the pair has labels."""
    reference, targets = dataset.load_pair(pair)
    # The solvers share the features.
    view, *target_views = method.views([reference, *targets])
    estimates = {
        solver: replace(method, solver=solver).estimate_from_views(view, target_views)
        for solver in solvers
    }
    sources = (
        f"sequence {pair.reference_sequence}, frame {pair.reference_frame}",
        f"sequence {pair.target_sequence}, frames {', '.join(map(str, pair.target_frames))}",
    )
    result = PairResult(
        pair.category,
        sources,
        reference,
        tuple(targets),
        estimates,
        errors={},
        backbone=getattr(method.backbone, "name", ""),
    )
    return replace(
        result,
        errors=label_errors(
            result, dataset.root / pair.category, (pair.reference_sequence, pair.target_sequence)
        ),
    )
