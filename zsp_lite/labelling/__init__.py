"""Pose labelling as in the paper's supplement: the same keypoints are picked on the point cloud of every sequence.

keypoints: alignment of two point clouds by keypoints
session: picks and labels of a category, stored on disk

The widget for notebooks is in `zsp_lite.widgets.labelling`.
"""

from zsp_lite.labelling.keypoints import align_picks
from zsp_lite.labelling.session import Labelling

__all__ = ["Labelling", "align_picks"]
