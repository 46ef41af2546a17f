"""Tables of the paper (Goodwin et al., ECCV 2022): which rows of a run they show, and the published figures.

They were measured on CO3D (20 categories with 100 pairs each) with DINO ViT-S/8: other data than the synthetic ones.
TABLE_1 and so on hold, by label, the row of a run for each group of columns, then the published figures. "ROW-n5" is
also the row ROW of a run with 5 target views.
"""

from dataclasses import dataclass

ACCURACIES = ("Acc30 (%)", "Acc15 (%)")
FIGURES = ("Med. err. (°)", *ACCURACIES)
CATEGORIES = ("bicycle", "hydrant", "motorcycle", "teddybear", "toaster")  # of Table 1, with their Acc30

TABLE_1 = {
    "ICP": ("icp", 111.8, 3.8, 0.7, 3.0, 6.0, 1.0, 1.0, 7.0),
    "SIFT": ("sift", 129.4, 4.0, 1.5, 3.0, 11.0, 1.0, 1.0, 0.0),
    "SWaV": ("swav", 123.1, 7.5, 3.3, 13.0, 9.0, 8.0, 5.0, 7.0),
    "ICP+BV": ("icp-bv", 109.3, 5.4, 1.2, 6.0, 5.0, 8.0, 5.0, 5.0),
    "PoseContrast": ("posecontrast", 111.5, 6.9, 1.1, 2.0, 4.0, 13.0, 4.0, 12.0),
    "Ours (K=30)": ("ours-k30", 60.2, 43.5, 29.0, 63.0, 24.0, 80.0, 33.0, 39.0),
    "Ours (K=50)": ("ours", 53.8, 46.3, 31.1, 71.0, 26.0, 82.0, 39.0, 42.0),
}
TABLE_2 = {
    "Ours-BV (N=1)": ("ours-bv-n1", 92.8, 12.6, 3.7),
    "Ours-BV (N=3)": ("ours-bv-n3", 69.5, 26.1, 8.0),
    "Ours-BV (N=5)": ("ours-bv-n5", 61.1, 35.4, 10.6),
    "Ours (N=1)": ("ours-n1", 97.3, 23.8, 13.4),
    "Ours (N=3)": ("ours-n3", 63.9, 38.9, 26.2),
    "Ours (N=5)": ("ours-n5", 53.8, 46.3, 31.1),
}
TABLE_3 = {
    "CyclicalDistIoU": ("ours-cyclicaliou", 94.7, 22.3, 13.1),
    "GlobalSim": ("ours-globalsim", 71.9, 36.8, 23.7),
    "SaliencyIoU": ("ours-saliencyiou", 87.0, 29.1, 18.1),
    "CorrespondSim": ("ours", 53.8, 46.3, 31.1),
}
TARGETS = {
    "1": ("ours-bv-n1", "ours-n1", 12.6, 3.7, 23.8, 13.4),
    "3": ("ours-bv-n3", "ours-n3", 26.1, 8.0, 38.9, 26.2),
    "5": ("ours-bv-n5", "ours-n5", 35.4, 10.6, 46.3, 31.1),
    "10": ("ours-bv-n10", "ours-n10", 45.0, 16.2, 52.5, 38.2),
    "20": ("ours-bv-n20", "ours-n20", 47.0, 18.6, 52.1, 38.3),
}
MATCHERS = {
    "Optimal transport": ("ours-transport", 54.6, 44.8, 29.1),
    "Dual softmax": ("ours-dualsoftmax", 54.0, 44.5, 30.1),
    "Cyclical distances": ("ours", 53.8, 46.3, 31.1),
}
CORRESPONDENCES = {
    "30": ("ours-k30-nokmeans", "ours-k30", 38.7, 25.2, 43.5, 29.0),
    "50": ("ours-k50-nokmeans", "ours", 42.0, 28.6, 46.3, 31.1),
    "70": ("ours-k70-nokmeans", "ours-k70", 43.4, 30.4, 47.1, 30.8),
}
TRIALS = {"500": ("ours-trials500", 45.8), "1000": ("ours", 46.3), "2000": ("ours-trials2000", 46.6)}
DEPTH = {
    "No depth (essential matrix)": ("ours-nodepth", 81.7, 23.6, 6.8),
    "Ours-BV": ("ours-bv", 61.1, 35.4, 10.6),
    "Ours": ("ours", 53.8, 46.3, 31.1),
}
_CYCLES = {
    "Cycle from the reference (paper)": ("ours",),
    "Cycle from the target (published code)": ("ours-published",),
}
_VERIFIED = {str(n): (f"ours-n{n}", f"verified-n{n}", f"verified-mask-n{n}") for n in (1, 3, 5, 10)}


@dataclass(frozen=True, eq=False)
class PaperTable:
    """A table of the paper, or one that extends it."""

    name: str  # stem of its files
    title: str
    rows: dict[str, tuple]  # as TABLE_1
    published: tuple[str, ...] = FIGURES  # titles of the published figures
    groups: tuple[str, ...] = ("",)  # of the run's columns
    figures: tuple[str, ...] = FIGURES  # of the run, in each group
    unit: str = ""  # of the labels
    prefix: str = ""  # a run has the table if it has two of the rows with this prefix


_TABLE_1_FIGURES = (*FIGURES, *(f"{category} Acc30" for category in CATEGORIES))
_VIEWS = ("best view only", "full method")
VIEWS_FIGURES = ("best view: Acc30 (%)", "best view: Acc15 (%)", "full: Acc30 (%)", "full: Acc15 (%)")
_KMEANS = ("without k-means", "with k-means")
_KMEANS_FIGURES = tuple(f"{group}: {figure}" for group in _KMEANS for figure in ACCURACIES)
_CORRESPONDENCES_TITLE = "Supplement. Number and diversity of correspondences"
_SOLVERS = ("the paper's", "verified", "verified, true mask")
_VERIFIED_TITLE = "Beyond the paper. All views tested: the verified solver"

PAPER_TABLES = (
    PaperTable("table_1", "Table 1. Baselines and our method", TABLE_1, _TABLE_1_FIGURES),
    PaperTable("table_2", "Table 2. Number of target views", TABLE_2),
    PaperTable("table_3", "Table 3. How to choose the view", TABLE_3),
    PaperTable(
        "table_a_targets", "Supplement. More target views", TARGETS, VIEWS_FIGURES, _VIEWS, ACCURACIES, unit="views"
    ),
    PaperTable("table_a_matchers", "Supplement. Correspondence method", MATCHERS),
    PaperTable(
        "table_a_correspondences",
        _CORRESPONDENCES_TITLE,
        CORRESPONDENCES,
        _KMEANS_FIGURES,
        _KMEANS,
        ACCURACIES,
        unit="K",
    ),
    PaperTable("table_a_trials", "Supplement. RANSAC trials", TRIALS, ("Acc30 (%)",), unit="trials"),
    PaperTable("table_a_depth", "Supplement. Without depth", DEPTH),
    PaperTable("published_code", "Start and mask of the cycles", _CYCLES, ()),
)
VERIFIED_TARGETS = PaperTable(
    "verified_targets", _VERIFIED_TITLE, _VERIFIED, (), _SOLVERS, ACCURACIES, unit="views", prefix="verified"
)
