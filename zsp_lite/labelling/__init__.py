"""Labelling poses as in the paper's supplement: the same keypoints picked on every sequence's point cloud.

keypoints   picks into an alignment, an alignment into a label
session     what was picked and accepted so far, on disk at once
guess       the method itself proposes the alignment, the person corrects it
candidates  which sequences are worth labelling, as a contact sheet
desktop     Open3D's picking window, driven from the terminal

The notebook's widget is `zsp_lite.widgets.labelling`.
"""

from zsp_lite.data.labels import rigid_label
from zsp_lite.labelling.keypoints import Alignment, align_picks
from zsp_lite.labelling.session import Labelling

__all__ = ["Alignment", "Labelling", "align_picks", "rigid_label"]
