"""The verified solver, `ZeroShotPose(solver="verified")`: poses tested in all target views. It
extends the paper.

The relative poses of the target views are known and all have depth, so a pose can be tested in
every view. The stages are the files scene, proposals, soft_icp, verification, refinement and
confidence; `solver` runs them.
"""

from zsp_lite.verified.solver import Solution, VerifiedSolver

__all__ = ["Solution", "VerifiedSolver"]
