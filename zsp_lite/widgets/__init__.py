"""Widgets for the notebooks: one function each, from computed data to sliders over a picture (see `common`).

`WIDGETS` names every widget with the function that builds it on sample data, as "module:function" below this package,
so that this module needs no ipywidgets. `python -m zsp_lite.widgets` measures how fast each of them answers.
"""

WIDGETS: dict[str, str] = {
    "attention": "features:example_attention",
    "facets": "features:example_facets",
    "context": "features:example_context",
    "saliency": "features:example_saliency",
    "cycle": "matching:example_cycle",
    "matches": "matching:example_matches",
    "best_view": "views:example_best_view",
    "ransac_settings": "alignment:example_ransac_settings",
    "one_outlier": "alignment:example_one_outlier",
    "measured_accuracy": "metrics:example_measured_accuracy",
    "symmetry_turn": "metrics:example_symmetry_turn",
    "ranked_hypotheses": "verified:example_ranked_hypotheses",
    "box_to_mask": "masks:example_box_to_mask",
    "label_poses": "labelling:example_label_poses",
}
