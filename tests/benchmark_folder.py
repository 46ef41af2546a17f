"""A small CO3D folder for the tests of the benchmark, made once; and what separate processes run on it."""

import atexit
import functools
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from synthetic_views import CoordinateBackbone, look_at, render

from zsp_lite.alignment import Sim3
from zsp_lite.data.co3d import SequenceData, write_co3d
from zsp_lite.data.labels import PoseLabel, write_label

SEQUENCES = ("100_a", "200_b", "300_c")
FRAMES = 8


@functools.cache
def small_folder() -> Path:
    """Two categories of three sequences of eight frames: one object, put into each sequence's world in its own way."""
    root = Path(tempfile.mkdtemp(prefix="co3d-"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    for offset, category in enumerate(("lump", "pebble")):
        sequences = []
        for index, name in enumerate(SEQUENCES):
            turn = np.eye(3) if index == 0 else look_at(np.eye(3)[index] + (0.3, 0.2, 0.1 + offset)).R
            placement = Sim3(1.0, turn, np.zeros(3))
            angles = np.linspace(0, 2 * np.pi, FRAMES, endpoint=False) + 0.3 * index
            # Upright cameras around the object; the world they stand in is turned.
            views = [look_at((np.cos(a), np.sin(a), 0.4), size=(90, 100), focal=120.0) for a in angles]
            cameras = [replace(camera, R=camera.R @ turn.T) for camera in views]
            frames = tuple(render(camera, placement, f"{name}/{i}") for i, camera in enumerate(cameras))
            times, cloud, colours = tuple(map(float, range(FRAMES))), np.eye(3), np.zeros((3, 3), np.uint8)
            sequences.append(SequenceData(name, frames, times, cloud, colours))
            trans = np.eye(4)
            trans[:3, :3] = turn
            write_label(root, category, PoseLabel(trans, name, SEQUENCES[0]))
        write_co3d(root, category, sequences, quality=100)
    return root


@dataclass(frozen=True)
class SlowBackbone(CoordinateBackbone):
    """Takes its time, so that a test can come in between."""

    name = "slow"
    _seconds: float = 0.05

    def __call__(self, images):
        time.sleep(self._seconds * len(images))
        return super().__call__(images)


def own_method(problem):
    """A user's row: the first target view as it is."""
    return np.eye(3), 0


if __name__ == "__main__":
    from zsp_lite.benchmark.run import evaluate

    def report(done: int, total: int) -> None:
        print(done, flush=True)

    data, out, workers = sys.argv[1:]
    evaluate(data, SlowBackbone(grid=8), ("ours", "ours-bv"), 6, 3, out=out, progress=report, workers=int(workers))
