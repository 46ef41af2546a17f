"""Pose estimates, and the protocol of the solvers that compute them from matched views."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.matching import Matches
from zsp_lite.metrics import rotation_error
from zsp_lite.views import View, ViewMatch

# points of k matches in the frames of the reference's and of the target's camera
PointPairs = tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One of several candidate poses of a solver."""

    sim3: Sim3  # reference-camera points to camera points of target view `view`
    view: int  # index of the target view that is closest to the reference viewpoint under this pose
    # in nats, comparable between the hypotheses of one estimate, or of turns of its reference image
    score: float
    terms: dict[str, float]  # the terms that the score is a weighted sum of, by name
    # probability that the rotation error is below 30 degrees. Over different poses, those whose
    # `mode` is their own index, the probabilities sum to at most 1 (see `verified.confidence`)
    confidence: float
    # index of the hypothesis that stands for this pose: its own, or that of a better one that is
    # the same pose within 30 degrees
    mode: int


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Pose of the reference object in one of the target views, with the intermediate results behind
    it."""

    sim3: Sim3  # reference-camera points to camera points of the chosen target view
    view: int  # index of the chosen target view
    matches: Matches  # matches between the reference and the chosen view
    # (K,) the matches that agree with the pose; with the verified solver, of those with measured
    # depth on both sides
    inliers: Bool[np.ndarray, " k"]
    # (N,) score of every target view, higher is better; -inf for views that were left out. The
    # verified solver's is minus the angle in degrees between the view's camera and the reference's
    # under the pose
    view_scores: Float[np.ndarray, " n"]
    reference_view: View  # crop, features and foreground of the reference
    target_views: tuple[View, ...]  # the same of all N target views
    timings: dict[str, float] = field(default_factory=dict)  # seconds per stage
    flags: tuple[str, ...] = ()  # one line per reason not to trust the estimate
    # candidate poses of the solver, best first; empty for the paper's solver
    hypotheses: tuple[Hypothesis, ...] = ()
    # whether the solver cannot decide between the estimate and its first alternative: both are
    # nearly equally probable and far apart, such as by a half turn (see
    # `verified.confidence.reliability_flags`)
    one_of_two: bool = False

    @property
    def target_camera(self) -> Camera:
        """Camera of the chosen target view's crop."""
        return self.target_views[self.view].frame.camera

    @cached_property
    def points(self) -> PointPairs:
        """3D points of the matches, in the reference's and in the chosen target's camera frame."""
        return match_points(self.reference_view, self.target_views[self.view], self.matches)

    @property
    def confidence(self) -> float | None:
        """Probability that the rotation error is below 30 degrees; None if the solver does not
        estimate it."""
        return self.hypotheses[0].confidence if self.hypotheses else None

    @cached_property
    def alternatives(self) -> tuple[Hypothesis, ...]:
        """Other poses, most probable first, without those within 30 degrees of a better one; ()
        without hypotheses."""
        return tuple(one for index, one in enumerate(self.hypotheses) if one.mode == index)[1:]

    @property
    def world_sim3(self) -> Sim3:
        """The pose as a similarity from the world of the reference to that of the target views."""
        return self.between_worlds(self.sim3, self.view)

    def between_worlds(self, sim3: Sim3, view: int) -> Sim3:
        """Return the similarity between the worlds that a pose in a target view stands for."""
        reference = self.reference_view.frame.camera
        target = self.target_views[view].frame.camera
        return target.sim3.inverse() @ sim3 @ reference.sim3

    def angle_to(self, pose: Hypothesis) -> float:
        """Return the angle in degrees between the rotation of the estimate and that of another
        pose."""
        other = self.between_worlds(pose.sim3, pose.view)
        return float(rotation_error(self.world_sim3.R, other.R))

    @property
    def note(self) -> str:
        """The flags as one line."""
        return "; ".join(self.flags)

    def __repr__(self) -> str:
        matches = f"{int(self.inliers.sum())} of {len(self.matches)} matches agree"
        sure = "" if self.confidence is None else f", confidence {self.confidence:.2f}"
        angle = rotation_error(np.eye(3), self.sim3.R)
        return (
            f"PoseEstimate(target view {self.view} of {len(self.target_views)}, {matches}{sure},\n"
            f"  rotation by {angle:.1f} degrees, t {np.round(self.sim3.t, 3).tolist()}, scale "
            f"{self.sim3.scale:.3f},\n"
            f"  {sum(self.timings.values()):.2f} s, "
            f"{f'flags: {self.note}' if self.flags else 'no flags'})"
        )

    def propagate(self, cameras: Sequence[Camera]) -> list[Sim3]:
        """Express the pose in other cameras of the target sequence (sec. 5.6)."""
        return [between_cameras(self.target_camera, camera) @ self.sim3 for camera in cameras]


@runtime_checkable
class Solver(Protocol):
    """The last stage of `ZeroShotPose`: from matched views to a pose. Any callable with this
    signature is accepted.

    A solver that fits the pose in the first target view:

        def first_view(reference, targets, matched, *, seed, threshold):
            matches = matched[0].matches
            scores = np.zeros(len(targets))
            points = match_points(reference, targets[0], matches)
            sim3, inliers = ransac(*points, threshold=threshold, seed=seed)
            return PoseEstimate(sim3, 0, matches, inliers, scores, reference, tuple(targets))

        ZeroShotPose(backbone, solver=first_view)

    A solver with an attribute `kmeans = False` gets the k best matches. Without this attribute,
    k-means selects the matches (see `ZeroShotPose.kmeans`).
    """

    def __call__(
        self,
        reference: View,
        targets: Sequence[View],
        matched: Sequence[ViewMatch],
        *,
        seed: int,
        threshold: float,
    ) -> PoseEstimate:
        """Estimate the pose of the reference object from N >= 1 target views, each with its matches
        to the reference.

        All views have known depth in at least one pixel, and the targets a foreground patch. The
        same `seed` gives the same pose. `threshold` is the largest residual of an inlier for an
        object of unit standard deviation, as the scenes of CO3D are scaled. InputError if the views
        do not determine a pose.
        """
        ...


def match_points(reference: View, target: View, matches: Matches) -> PointPairs:
    """Unproject matches to 3D points, each in the frame of its own camera (sec. 4.3)."""
    source = reference.patch_points[0][tuple(matches.reference.T)]
    return source, target.patch_points[0][tuple(matches.target.T)]


def between_cameras(first: Camera, second: Camera) -> Sim3:
    """Return the rigid transform from the first camera's frame to the second's."""
    turn = second.R @ first.R.T
    return Sim3(1.0, turn, second.t - turn @ first.t)


@contextmanager
def timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    """Write the run time of the block to `timings[stage]`, in seconds."""
    start = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - start
