"""Table of the estimates of a pair, for the terminal and the report."""

from collections.abc import Sequence

from zsp_lite.scans.pair_result import PairResult

COLUMNS = ("category", "solver", "view", "inliers", "error", "confidence", "time")
_MEANINGS = {
    "view": "the target view that the pose leads to",
    "inliers": "matches of that view that agree with the pose, which the "
    "verified solver does not need",
    "error": "angle to the labelled rotation",
    "confidence": "probability of an error below 30°, calibrated on renderings",
}


def table_rows(result: PairResult) -> list[tuple[str, ...]]:
    """Format the estimate of each solver (see `COLUMNS`)."""
    rows = []
    for solver, estimate in result.estimates.items():
        view = f"{estimate.view + 1} of {len(estimate.target_views)}"
        inliers = f"{int(estimate.inliers.sum())} of {len(estimate.inliers)}"
        error = f"{result.errors[solver]:.1f}°" if solver in result.errors else "–"
        confidence = "–" if estimate.confidence is None else f"{estimate.confidence:.2f}"
        seconds = f"{sum(estimate.timings.values()):.2f} s"
        rows.append((result.title, solver, view, inliers, error, confidence, seconds))
    return rows


def legend(columns: Sequence[str] = COLUMNS) -> str:
    """Explain the columns of a table of estimates in one line of text."""
    return "; ".join(f"{name}: {_MEANINGS[name]}" for name in columns if name in _MEANINGS) + "."
