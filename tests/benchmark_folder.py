"""For the tests of the benchmark: a small CO3D folder, a user's methods that run on it, and runs
whose results are made up."""

import atexit
import functools
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from synthetic_views import CoordinateBackbone, look_at, render

from zsp_lite.alignment import Sim3, ransac
from zsp_lite.benchmark.run import evaluate
from zsp_lite.benchmark.runs import SETTINGS, Call, Settings, add_lines, read_run
from zsp_lite.data.co3d import Pair
from zsp_lite.data.labels import PoseLabel, read_labels
from zsp_lite.data.writing import SequenceData, write_co3d, write_label
from zsp_lite.estimates import PoseEstimate, match_points
from zsp_lite.io.files import write_atomic

SEQUENCES = ("100_a", "200_b", "300_c")
FRAMES = 8  # of each sequence


@functools.cache
def small_folder() -> Path:
    """The folder, made once: two categories of three sequences of eight frames of one object,
    which has another orientation in the world of each sequence."""
    root = Path(tempfile.mkdtemp(prefix="co3d-"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    for offset, category in enumerate(("lump", "pebble")):
        sequences = []
        for index, name in enumerate(SEQUENCES):
            # Some rotation for each other sequence of each category.
            turn = (
                np.eye(3) if index == 0 else look_at(np.eye(3)[index] + (0.3, 0.2, 0.1 + offset)).R
            )
            in_world = Sim3(1.0, turn, np.zeros(3))  # from the object to the world
            # Every sequence has viewpoints of its own.
            angles = np.linspace(0, 2 * np.pi, FRAMES, endpoint=False) + 0.3 * index
            # Upright cameras around the object; then the world is turned with them.
            views = [
                look_at((np.cos(a), np.sin(a), 0.4), size=(90, 100), focal=120.0) for a in angles
            ]
            cameras = [replace(camera, R=camera.R @ turn.T) for camera in views]
            frames = tuple(
                render(camera, in_world, f"{name}/{i}") for i, camera in enumerate(cameras)
            )
            times = tuple(map(float, range(FRAMES)))
            cloud = np.eye(3)  # three points, not of the object
            colours = np.zeros((3, 3), np.uint8)
            sequences.append(SequenceData(name, frames, times, cloud, colours))
            trans = np.eye(4)
            trans[:3, :3] = turn
            write_label(root, category, PoseLabel(trans, name, SEQUENCES[0]))
        write_co3d(root, category, sequences, quality=100)
    return root


@dataclass(frozen=True)
class SlowBackbone(CoordinateBackbone):
    """A backbone that takes some seconds for each image, so that a test can interrupt it, and may
    have weights that are large to send."""

    name = "slow"
    seconds: float = 0.05
    weights: np.ndarray | None = None

    def __call__(self, images):
        time.sleep(self.seconds * len(images))
        return super().__call__(images)


BACKBONE = CoordinateBackbone(grid=8)
QUICK = SlowBackbone(grid=8, seconds=0)


def run_rows(
    rows, out, pairs: int = 1, targets: int = 2, category: str = "lump", backbone=BACKBONE
):
    """Run the benchmark on one category; returns the figures by row."""
    return evaluate(small_folder(), backbone, rows, {category: pairs}, targets, out)["methods"]


def own_method(problem):
    """A user's row: the first target view as it is."""
    return np.eye(3), 0


@dataclass  # without a hash: a row needs none
class OwnEstimator:
    """A user's estimator: turns the reference by 90 degrees."""

    def estimate(self, reference, targets):
        return look_at((0, 1, 0)).R.T @ look_at((1, 0, 0)).R, len(targets) - 1


own_estimator = OwnEstimator()


def own_matcher(similarity, on_reference, on_target):
    """A user's matcher of patches: the nearest neighbour of each patch."""
    score, partner = similarity.max(dim=1)
    return partner, score.double()


def own_keypoints(first, second):
    """A user's matcher of pixels: every tenth pixel matches that at the same place."""
    side = min(*first.shape[:2], *second.shape[:2])
    grid = np.stack(np.mgrid[:side:10, :side:10], -1).reshape(-1, 2) + 0.5
    return grid, grid, np.ones(len(grid))


@dataclass  # without a hash
class OwnSolver:
    """A user's solver: the pose in the first target view."""

    def __call__(self, reference, targets, matched, *, seed=0, threshold=0.2):
        first, second = match_points(reference, targets[0], matched[0].matches)
        scores = np.zeros(len(targets))
        sim3, inliers = ransac(first, second, threshold=threshold, seed=seed)
        return PoseEstimate(sim3, 0, matched[0].matches, inliers, scores, reference, tuple(targets))


own_solver = OwnSolver()


def placement(category, sequence) -> Sim3:
    """The map from the world of the first sequence to that of another one, by its label."""
    trans = read_labels(small_folder(), category)[sequence].trans
    return Sim3(1.0, trans[:3, :3], trans[:3, 3])


CATEGORIES = ("bicycle", "hydrant", "motorcycle", "teddybear", "toaster", "chair")
PAIRS = 8  # of each category
# All that a result of a pair can have.
RESULT = {
    "error": 10.0,
    "symmetric_error": 5.0,
    "translation": 0.5,
    "scale": 1.1,
    "view": 1,
    "inliers": 9,
    "seconds": 2.0,
    "note": "flat",
    "confidence": 0.7,
    "rotation": np.eye(3).ravel().tolist(),
    "position": [1.0, 2.0, 3.0],
}


def write_run(out, rows, categories=CATEGORIES, backbone="none 0123456789abcdef"):
    """Write a run's folder with results by row and pair; `backbone` is a name and a hash."""
    call = Call("now", [], {}, list(rows), dict.fromkeys(categories, PAIRS))
    library = [{"version": "0", "commit": None}]
    methods = dict.fromkeys(rows, "x")
    settings = Settings("made up", backbone, 5, library, methods, [call])  # 5 target views
    write_atomic(Path(out) / SETTINGS, msgspec.json.encode(settings))
    for name, results in rows.items():
        add_lines(out, ({"pair": key, "results": {name: found}} for key, found in results.items()))
    return read_run(out)


def made_up_run(out, rows):
    """A run with random errors of pairs that share a few objects."""
    rng = np.random.default_rng(0)
    found = {}
    for name in dict.fromkeys(rows):
        # A row NAME-n3 has three target views, others have five.
        targets = tuple(range(int((re.findall(r"-n(\d+)$", name) or [5])[0])))
        pairs = [
            Pair(category, f"{i}", i, f"{(i * i + 1) % PAIRS}", targets)
            for category in CATEGORIES
            for i in range(PAIRS)
        ]
        found[name] = {
            pair.key: {"error": round(rng.uniform(0, 180), 4), "view": 0, "inliers": 9}
            for pair in pairs
        }
    return write_run(out, found)


def after_each_save(act: Callable[[], None]) -> Callable[..., None]:
    """Return a substitute of `execution.add_lines` that calls `act` after it has added pairs."""

    def add_and_act(out, lines):
        add_lines(out, lines)
        act()

    return add_and_act


# A run that a test can kill: it prints a line after each save.
if __name__ == "__main__":
    from zsp_lite.benchmark import execution, run

    data, out, workers = sys.argv[1:]
    execution.add_lines = after_each_save(lambda: print(flush=True))
    # 6 pairs of each category, 3 target views.
    run.evaluate(data, SlowBackbone(grid=8), ("ours", "ours-bv"), 6, 3, out, int(workers))
