"""Pose labelling as in the paper's supplement: the same keypoints are picked on the point cloud of
every sequence.

`session` keeps the picks and labels of a category on disk; `zsp_lite.course.widgets.labelling` is
the widget for notebooks.
"""

from zsp_lite.course.labelling.session import Labelling, align_picks

__all__ = ["Labelling", "align_picks"]
