"""Widgets for the notebooks: one function each, from computed data to sliders above a figure (see `common`).

`examples` builds every widget on sample data. `python -m zsp_lite.widgets` measures their latency.
"""
