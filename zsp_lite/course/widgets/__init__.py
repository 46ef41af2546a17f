"""Widgets for the notebooks: one function each, from computed data to sliders above a figure (see
`common`).

`self_check` shows questions with instant feedback. `tools/widget_examples.py` builds every widget
on sample data.
"""

from zsp_lite.course.widgets.quiz import self_check

__all__ = ["self_check"]
