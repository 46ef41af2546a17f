"""Result of one pair: the estimates of one or both solvers, with rotation errors where the truth is known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
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
        first, second = (world_rotation(one, one.sim3, one.view) for one in self.estimates.values())
        return float(rotation_error(first, second))


@dataclass(frozen=True, eq=False)
class Alternative:
    """A hypothesis of the verified solver below its best one.

    Attributes:
        rank: Rank among the hypotheses; the best one has 1.
        sim3: Reference-camera points to camera points of target view `view`.
        view: Index of the target view that is closest to the reference viewpoint under this pose.
        angle: Angle between its rotation and that of the best hypothesis in degrees.
        deficit: Score of the best hypothesis minus its own, in nats.
    """

    rank: int
    sim3: Sim3
    view: int
    angle: float
    deficit: float


def alternatives(estimate: PoseEstimate) -> list[Alternative]:
    """List the hypotheses of an estimate below the best one, best first; the paper's solver has none."""
    best, *others = estimate.hypotheses or (None,)
    return [
        Alternative(
            rank, one.sim3, one.view,
            float(rotation_error(world_rotation(estimate, best.sim3, best.view),
                                 world_rotation(estimate, one.sim3, one.view))),
            best.score - one.score,
        )
        for rank, one in enumerate(others, 2)
    ]  # fmt: skip


def world_rotation(estimate: PoseEstimate, sim3: Sim3, view: int) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from the reference camera's frame to the world of the target views."""
    return estimate.target_views[view].frame.camera.R.T @ sim3.R


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
    found: dict[str, PoseEstimate] = {}
    for name in solvers:
        solving = replace(method, solver=name)
        if not found:
            found[name] = first = solving.estimate(reference, targets)
        else:
            shared = {stage: first.timings[stage] for stage in ("crop", "features")}
            found[name] = solving.estimate_from_views(first.reference_view, first.target_views, shared)
    return found
