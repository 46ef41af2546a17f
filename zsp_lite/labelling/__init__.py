"""Pose labelling as in the paper's supplement: the same keypoints are picked on the point cloud of every sequence.

`session` keeps the picks and labels of a category on disk; the widget for notebooks is `zsp_lite.widgets.labelling`.
"""

from zsp_lite.labelling.session import Labelling, align_picks

__all__ = ["Labelling", "align_picks"]
