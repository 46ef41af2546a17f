"""Widgets for the notebooks: one function each, from computed data to sliders above a figure (see
`common`), and questions with instant feedback, `self_check`."""

from zsp_lite.course.widgets.quiz import self_check

__all__ = ["self_check"]
