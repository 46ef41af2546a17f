"""What every lesson begins with: its data, its backbone, and the format of its pictures."""

import os

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.load import load_backbone
from zsp_lite.course.samples import sample_data
from zsp_lite.course.widgets.common import show as show  # lessons import it from here
from zsp_lite.data.co3d import Co3D


def open_lesson(device: str = "cpu") -> tuple[Co3D, Backbone]:
    """Return the data and the backbone of a lesson: the samples and zsp-tiny, or those that the
    environment names.

    Figures of the notebook are stored as JPEG from now on, which is smaller than PNG.
    """
    # A package of Jupyter, which only the lessons need.
    from matplotlib_inline.backend_inline import set_matplotlib_formats

    set_matplotlib_formats("jpeg", pil_kwargs={"quality": 85})
    dataset = Co3D(os.environ.get("ZSP_LITE_DATA") or sample_data())
    return dataset, load_backbone(os.environ.get("ZSP_LITE_BACKBONE") or "zsp-tiny", device)
