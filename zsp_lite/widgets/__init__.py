"""Widgets for the notebooks: one function each, from computed data to sliders over a picture (see `common`).

`WIDGETS` names every widget with the function that builds it on sample data, as "module:function" below this package,
so that this module needs no ipywidgets. `python -m zsp_lite.widgets` measures how fast each of them answers.
"""

WIDGETS: dict[str, str] = {}
