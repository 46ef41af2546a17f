"""Result of one pair: the estimates of one or both solvers, with rotation errors where the truth is known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import PoseLabel, relative_pose
from zsp_lite.data.pairs import Pair
from zsp_lite.estimates import PoseEstimate
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose

SEQUENCE_FRAMES = 6  # frames of the target sequence that the pose is shown in
# Choices of the command line, each with the solvers that it runs.
SOLVER_CHOICES = {"paper": ("paper",), "verified": ("verified",), "both": ("paper", "verified")}


@dataclass(frozen=True, eq=False)
class PairResult:
    """Pose estimates of one pair.

    Attributes:
        title: Name of the pair, such as its category.
        reference: Where the reference comes from, in words.
        target: Where the target views come from, in words.
        estimates: Estimate of each solver by its name, at least one.
        errors: Rotation error of each estimate in degrees; empty without pose labels.
        sequence: Some whole frames of the target sequence, for displaying the propagated pose.
        pair: The evaluation pair, or None.
    """

    title: str
    reference: str
    target: str
    estimates: dict[str, PoseEstimate]
    errors: dict[str, float]
    sequence: tuple[Frame, ...]
    pair: Pair | None = None

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
        first, second = (one.world_rotation() for one in self.estimates.values())
        return float(rotation_error(first, second))


def label_error(
    estimate: PoseEstimate, reference_label: PoseLabel, reference: Frame, target_label: PoseLabel,
    targets: Sequence[Frame],
) -> float:  # fmt: skip
    """Return the rotation error of an estimate in degrees, by the labels of both sequences."""
    truth = relative_pose(reference_label, reference.camera, target_label, targets[estimate.view].camera)
    return float(rotation_error(estimate.sim3.R, truth[:3, :3]))


def solve_pair(
    method: ZeroShotPose, reference: Frame, targets: Sequence[Frame], solvers: Sequence[str] | None = None
) -> dict[str, PoseEstimate]:
    """Estimate the pose of a pair by several solvers; crops and features are computed once.

    Args:
        method: The method.
        reference: Frame of the reference object.
        targets: Frames of the target object.
        solvers: Names of solvers; by default the method's own.

    Returns:
        Estimate of each solver by its name.

    Raises:
        InputError: The pose cannot be estimated (see `ZeroShotPose.estimate`).
    """
    if solvers is None:
        name = method.solver if isinstance(method.solver, str) else getattr(method.solver, "__name__", "solver")
        return {name: method.estimate(reference, targets)}
    timings: dict[str, float] = {}
    turns, views = method.pair_views(reference, targets, timings)
    return {name: replace(method, solver=name).estimate_from_turns(turns, views, timings) for name in solvers}
