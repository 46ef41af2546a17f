"""What a measured accuracy says, to be played with: how far apart methods must be, and what symmetry does to errors."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Real
from sklearn.neighbors import NearestNeighbors

from zsp_lite.errors import InputError
from zsp_lite.viz.plots import BLUE, ORANGE
from zsp_lite.widgets.common import choice, explorer, slider

if TYPE_CHECKING:
    from ipywidgets import VBox

_STEP = 5  # degrees between the turns whose distances are worked out beforehand


def binomial(n: int, p: float) -> Float[np.ndarray, " _"]:
    """Chances (n + 1,) of 0 to n successes in n trials of chance p each."""
    if n < 1 or not 0 <= p <= 1:
        raise InputError(f"binomial: n={n}, p={p}, expected n >= 1 and p in [0, 1]")
    if p in (0, 1):
        return np.eye(n + 1)[round(n * p)]
    # Logarithms: comb(1000, 500) alone is beyond what a float holds.
    k = np.arange(n + 1)
    steps = np.log((n - k[:-1]) / k[1:] * p / (1 - p))
    return np.exp(n * np.log1p(-p) + np.concatenate([[0.0], np.cumsum(steps)]))


def order_chances(n: int, first: float, second: float) -> tuple[float, float]:
    """Chances that the second method's accuracy comes out above, and below, the first's, each on n pairs of its own.

    first, second: their true accuracies, shares in [0, 1].
    """
    a, b = binomial(n, first), binomial(n, second)
    below = np.concatenate([[0.0], np.cumsum(a)[:-1]])  # chance of a < k
    above = 1 - np.cumsum(a)  # chance of a > k
    return float(b @ below), float(b @ above)


def measured_accuracy() -> "VBox":
    """Widget: how Acc30 of two methods scatters, measured on so many pairs each, and how often their order is right.

    Controls: pairs, the first method's true accuracy, and what the second has more.
    """
    figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
    lines = [
        axis.plot([], [], color=colour, linestyle=style, linewidth=2, label=label)[0]
        for colour, style, label in ((BLUE, "-", "first method"), (ORANGE, "--", "second method"))
    ]
    axis.set(xlim=(0, 100), xlabel="measured Acc30 (%)", ylabel="chance density (1/%)")
    axis.legend(fontsize=8, loc="upper right")

    def update(pairs: int, accuracy: int, gain: int) -> str:
        shares = accuracy / 100, min(accuracy + gain, 100) / 100
        top = 0.0
        for line, share in zip(lines, shares, strict=True):
            density = binomial(pairs, share) * pairs / 100
            line.set_data(100 * np.arange(pairs + 1) / pairs, density)
            top = max(top, density.max())
        axis.set_ylim(0, 1.08 * top)
        half = 196 * np.sqrt(shares[0] * (1 - shares[0]) / pairs)
        right, wrong = order_chances(pairs, *shares)
        return (
            f"On {pairs} pairs the first method's 95 % interval is about ± {half:.1f} points; the second comes out "
            f"above in {100 * right:.0f} % of all benchmarks, below in {100 * wrong:.0f} %."
        )

    controls = {
        "pairs": slider("pairs", 20, 2000, 100, 20),
        "accuracy": slider("Acc30 of the first (%)", 5, 90, 46),
        "gain": slider("the second has more (points)", 0, 10, 4),
    }
    alt = "The distributions of the accuracies that two methods would be measured to have"
    return explorer(figure, controls, update, alt)


def turned_distance(
    cloud: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "m 3"], degrees: Real[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Mean distance from the cloud's points, turned about the z axis, to the nearest points of the other cloud.

    With the cloud itself as the other it is the symmetric objects' metric of Hinterstoisser et al. for a pose that is
    wrong by such a turn. In the clouds' unit.
    """
    cloud, other = np.asarray(cloud, np.float64), np.asarray(other, np.float64)
    search = NearestNeighbors(n_neighbors=1).fit(other)
    return np.array([search.kneighbors(_turn(cloud, angle))[0].mean() for angle in np.asarray(degrees, np.float64)])


def symmetry_turn(clouds: Mapping[str, Float[np.ndarray, "n 3"]]) -> "VBox":
    """Widget: an object turned by a wrong angle over itself, its rotation error and its closest-point distance.

    clouds: by name, centred, z up, in scene units; a thousand points each are plenty.  Controls: which, and the turn.
    Raises InputError for no cloud.
    """
    if not clouds:
        raise InputError("no clouds, expected at least one")
    turns = np.arange(0, 181, _STEP)
    curves = {name: turned_distance(cloud, cloud, turns) for name, cloud in clouds.items()}
    figure, (above, graph) = plt.subplots(1, 2, figsize=(8, 3.3), width_ratios=(1, 1.3), layout="constrained")
    still = above.scatter([], [], s=5, color=ORANGE, marker="D", linewidths=0, label="true pose")
    moved = above.scatter([], [], s=5, color=BLUE, linewidths=0, label="turned")
    reach = 1.05 * max(np.linalg.norm(np.asarray(cloud)[:, :2], axis=1).max() for cloud in clouds.values())
    above.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", title="from above (scene units)")
    above.tick_params(labelsize=8)
    above.legend(fontsize=8, loc="upper right", markerscale=2)
    (line,) = graph.plot(turns, turns, color="0.3")
    (dot,) = graph.plot([], [], "o", color=BLUE, markersize=9, clip_on=False)
    graph.set(xlim=(-4, 184), ylim=(0, 1.1 * max(curve.max() for curve in curves.values())), xticks=range(0, 181, 45))
    graph.set(xlabel="turn = rotation error (degrees)", ylabel="closest-point distance (scene units)")
    for axis in (above, graph):
        axis.title.set_fontsize(9)

    def update(cloud: str, turn: int) -> str:
        points = np.asarray(clouds[cloud])
        still.set_offsets(points[:, :2])
        moved.set_offsets(_turn(points, turn)[:, :2])
        line.set_ydata(curves[cloud])
        distance = float(np.interp(turn, turns, curves[cloud]))
        dot.set_data([turn], [distance])
        return (
            f"{cloud}, turned by {turn}°: rotation error {turn}°, closest-point distance {distance:.2f}, "
            f"{100 * distance / curves[cloud].max():.0f} % of the worst turn's."
        )

    controls = {
        "cloud": choice("object", list(clouds)),
        "turn": slider("turned by (degrees)", 0, 180, 180, 5),
    }
    alt = "A cloud from above over itself turned, and the closest-point distance over the angle of the turn"
    return explorer(figure, controls, update, alt)


def _turn(points: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def example_measured_accuracy() -> "VBox":
    """`measured_accuracy`; it needs no data."""
    return measured_accuracy()


def example_symmetry_turn() -> "VBox":
    """`symmetry_turn` on a sheet and a cross, seen from above."""
    along = np.linspace(-1, 1, 400)
    sheet = np.column_stack([along, 0.1 * along, 0 * along])
    return symmetry_turn({"sheet": sheet, "cross": np.vstack([sheet, sheet @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]])})
