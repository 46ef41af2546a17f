"""Results published in the paper (Goodwin et al., ECCV 2022), for comparison only.

They were measured on CO3D (20 categories with 100 pairs each) with DINO ViT-S/8. These are other data than those of the
synthetic benchmark, so the tables show them in separate columns.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedTable:
    """A published table: its columns, and by label of a row one value per column."""

    columns: tuple[str, ...]
    rows: dict[str, tuple[float, ...]]


ACCURACIES = ("Acc30 (%)", "Acc15 (%)")
FIGURES = ("Med. err. (°)", *ACCURACIES)
CATEGORIES = ("bicycle", "hydrant", "motorcycle", "teddybear", "toaster")  # of Table 1, with their Acc30

TABLE_1 = PublishedTable(
    (*FIGURES, *(f"{category} Acc30" for category in CATEGORIES)),
    {
        "ICP": (111.8, 3.8, 0.7, 3.0, 6.0, 1.0, 1.0, 7.0),
        "SIFT": (129.4, 4.0, 1.5, 3.0, 11.0, 1.0, 1.0, 0.0),
        "SWaV": (123.1, 7.5, 3.3, 13.0, 9.0, 8.0, 5.0, 7.0),
        "ICP+BV": (109.3, 5.4, 1.2, 6.0, 5.0, 8.0, 5.0, 5.0),
        "PoseContrast": (111.5, 6.9, 1.1, 2.0, 4.0, 13.0, 4.0, 12.0),
        "Ours (K=30)": (60.2, 43.5, 29.0, 63.0, 24.0, 80.0, 33.0, 39.0),
        "Ours (K=50)": (53.8, 46.3, 31.1, 71.0, 26.0, 82.0, 39.0, 42.0),
    },
)

TABLE_2 = PublishedTable(
    FIGURES,
    {
        "Ours-BV (N=1)": (92.8, 12.6, 3.7),
        "Ours-BV (N=3)": (69.5, 26.1, 8.0),
        "Ours-BV (N=5)": (61.1, 35.4, 10.6),
        "Ours (N=1)": (97.3, 23.8, 13.4),
        "Ours (N=3)": (63.9, 38.9, 26.2),
        "Ours (N=5)": (53.8, 46.3, 31.1),
    },
)

TABLE_3 = PublishedTable(
    FIGURES,
    {
        "CyclicalDistIoU": (94.7, 22.3, 13.1),
        "GlobalSim": (71.9, 36.8, 23.7),
        "SaliencyIoU": (87.0, 29.1, 18.1),
        "CorrespondSim": (53.8, 46.3, 31.1),
    },
)

TARGETS = PublishedTable(
    tuple(f"{method}: {figure}" for method in ("best view", "full") for figure in ACCURACIES),
    {
        "1": (12.6, 3.7, 23.8, 13.4),
        "3": (26.1, 8.0, 38.9, 26.2),
        "5": (35.4, 10.6, 46.3, 31.1),
        "10": (45.0, 16.2, 52.5, 38.2),
        "20": (47.0, 18.6, 52.1, 38.3),
    },
)

MATCHERS = PublishedTable(
    FIGURES,
    {
        "Optimal transport": (54.6, 44.8, 29.1),
        "Dual softmax": (54.0, 44.5, 30.1),
        "Cyclical distances": (53.8, 46.3, 31.1),
    },
)

CORRESPONDENCES = PublishedTable(
    tuple(f"{method}: {figure}" for method in ("without k-means", "with k-means") for figure in ACCURACIES),
    {"30": (38.7, 25.2, 43.5, 29.0), "50": (42.0, 28.6, 46.3, 31.1), "70": (43.4, 30.4, 47.1, 30.8)},
)

DEPTH = PublishedTable(
    FIGURES,
    {
        "No depth (essential matrix)": (81.7, 23.6, 6.8),
        "Ours-BV": (61.1, 35.4, 10.6),
        "Ours": (53.8, 46.3, 31.1),
    },
)

TRIALS = PublishedTable(("Acc30 (%)",), {"500": (45.8,), "1000": (46.3,), "2000": (46.6,)})
