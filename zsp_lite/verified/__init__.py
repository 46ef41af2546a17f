"""A pose checked against everything that was seen: the solver beyond the paper, `ZeroShotPose(solver="verified")`.

The paper picks one target view and trusts the consensus of its matches. But the target views' relative poses are
known and all have depth, so a pose can be tested in every one of them. Stages, each a function of its own:

scene         what all views saw, in one frame and unit
proposals     poses suggested by three matches of one view, and the views' own rotations
soft_icp      each drawn to its neighbourhood's best alignment, weighted by features
verification  a score of named terms: features, silhouettes, free space, forward and in reverse; likeness of views
refinement    the score itself climbed by random search
hypotheses    the ranking, and the `VerifiedSolver` that runs all stages
confidence    a calibrated chance that a hypothesis is right

What was tried and left out, before the view term came (276 pairs of 19 training categories, Acc30 of the paper's
solver 59.4): locally optimised RANSAC with the truncated score in the chosen view, thresholds of 0.2 to 0.4 (60.1 to
60.5: the inliers of a wrong pose agree as well as those of a right one); the same with thresholds from the object's
size (62.3, of which a threshold from the size alone gives 61.6: `ZeroShotPose(adaptive_threshold=True)`; on
evaluation objects it brought 2.6 points once and 1.0 another time). In the verification (418 pairs, fitted and
judged on different categories, Acc30 84.7): similarity per point seen instead of per point, how many proposals agree
with a pose, and roots and products of the terms (82.3 to 84.7); a prior on the scale (86.4) is within the noise; the
view term (87.6) was kept. Calling answers equally good by what both show to view, not by their scores, flags a third
of the right answers.
"""

from zsp_lite.verified.solver import Solution, VerifiedSolver

__all__ = ["Solution", "VerifiedSolver"]
