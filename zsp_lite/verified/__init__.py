"""The verified solver, `ZeroShotPose(solver="verified")`: poses tested in all target views. It extends the paper.

The relative poses of the target views are known and all have depth, so a pose can be tested in every view. The stages:

    scene         points, feature similarities and maps of all views, in normalised frames
    proposals     poses from three matches of one view, and from viewpoints around the object
    soft_icp      local alignment with soft correspondences, weighted by feature similarity
    verification  the score: a weighted sum of nine terms on features, silhouettes, free space and views as a whole
    refinement    random search that increases the score
    confidence    calibrated probability that a hypothesis is correct
    solver        the `VerifiedSolver` that runs all stages, and its ranked hypotheses
"""

from zsp_lite.verified.solver import Solution, VerifiedSolver

__all__ = ["Solution", "VerifiedSolver"]
