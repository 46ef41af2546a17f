"""The verified solver, `ZeroShotPose(solver="verified")`: poses tested in all target views. It extends the paper.

The paper selects one target view and fits the pose to its matches. The relative poses of the target views are known and
all of them have depth, so a pose can be tested in every view. Each stage is a function:

    scene         points, feature similarities and maps of all views, in normalised frames
    proposals     poses from three matches of one view, and from viewpoints around the object
    soft_icp      local alignment with soft correspondences, weighted by feature similarity
    verification  the score: a weighted sum of nine terms on features, silhouettes, free space and views as a whole
    refinement    random search that increases the score
    solver        the ranked hypotheses, and the `VerifiedSolver` that runs all stages
    confidence    calibrated probability that a hypothesis is correct
"""

from zsp_lite.verified.solver import Solution, VerifiedSolver

__all__ = ["Solution", "VerifiedSolver"]
