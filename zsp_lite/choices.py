"""Names that a user chooses from.

The command line offers them without importing what they stand for.
"""

from typing import Literal, get_args

# Solvers of a pair, each with those that it runs.
SOLVERS = {"paper": ("paper",), "verified": ("verified",), "both": ("paper", "verified")}
# Ways to match patches: the paper's, and the alternatives of its supplement.
MATCHERS = ("cyclical", "mutual", "dual softmax", "optimal transport")
# Activation of a transformer block that describes a patch (compared by Amir et al. 2021): an input
# of its attention, or its output, not normalised ("token").
Facet = Literal["key", "query", "value", "token"]
FACETS = get_args(Facet)
# Where object masks come from: with the frames, GrabCut from a box, or depth.
MASKS = ("given", "box", "auto")
# Figures of a benchmark row by their names in a summary, with their titles.
METRICS = {
    "mean_category_median": "Med. err. (°)",
    "acc30": "Acc30 (%)",
    "acc15": "Acc15 (%)",
    "auc30": "AUC@30 (%)",
    "above150": "above 150° (%)",
    "median": "pooled med. err. (°)",
    "symmetric_acc30": "Acc30 up to symmetries (%)",
    "translation": "transl. err. (diameters)",
    "scale": "scale ratio",
    "milliseconds": "ms per pair",
}
# Figures that are shown by default: the paper's three, and AUC@30.
METRICS_SHOWN = ("mean_category_median", "acc30", "acc15", "auc30")
