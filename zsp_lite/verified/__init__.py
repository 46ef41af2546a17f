"""A pose checked against everything that was seen: the solver beyond the paper, `ZeroShotPose(solver="verified")`.

The paper picks one target view and trusts the consensus of its matches. But the target views' relative poses are
known and all have depth, so a pose can be tested in every one of them. Stages, each a function of its own:

scene         what all views saw, in one frame and unit
proposals     poses suggested by three matches of one view, and the views' own rotations
soft_icp      each drawn to its neighbourhood's best alignment, weighted by features
verification  a score of named terms: features, silhouettes, free space, forward and in reverse
refinement    the score itself climbed by random search
hypotheses    the ranking, and all of it in one call: `solve`
confidence    a calibrated chance that a hypothesis is right
"""

from zsp_lite.verified.hypotheses import Hypothesis, Solution, VerifiedSettings, solve

__all__ = ["Hypothesis", "Solution", "VerifiedSettings", "solve"]
