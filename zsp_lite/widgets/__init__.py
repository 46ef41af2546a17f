"""Widgets for the notebooks: one function each, from computed data to sliders above a figure (see `common`).

In the repository, `tools/widget_examples.py` builds every widget on sample data.
"""
